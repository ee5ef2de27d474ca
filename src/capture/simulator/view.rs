//! The blocks of a scene as one camera sees them: where rays meet them, many rays at a time.

use nalgebra::{Matrix3, Vector3};

use crate::capture::simulator::lens::{ALL_LANES, LANES, NEAREST_M};
use crate::capture::simulator::scene::Block;
use crate::slam::kernel::lanes_kernel::{Lanes, Register};
use crate::slam::kernel::{Floats, Instructions};

/// No surface. Surfaces are numbered block × 8 + face, and kept as `f32` among other numbers.
pub const NO_SURFACE: f32 = -1.0;

/// A block as one camera sees it: everything that does not change from ray to ray.
#[derive(Debug, Clone, Copy)]
pub struct LocalView {
    /// Camera centre in the block's axes, from its centre.
    pub origin: [f32; 3],
    /// Rows of the rotation from camera to block.
    pub rows: [[f32; 3]; 3],
    /// Half sides, metres.
    pub half: [f32; 3],
    is_hollow: bool,
}

impl LocalView {
    /// A block seen from a camera pose, metres.
    pub fn new(block: &Block, rotation: &Matrix3<f64>, camera_in_world: &Vector3<f64>) -> Self {
        let (sin, cos) = (f64::from(block.turn.0), f64::from(block.turn.1));
        let block_from_world = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
        let centre = Vector3::from(block.centre.map(f64::from));
        let origin = block_from_world * (camera_in_world - centre);
        let m = block_from_world * rotation;
        Self {
            origin: [origin.x as f32, origin.y as f32, origin.z as f32],
            rows: std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)] as f32)),
            half: block.half,
            is_hollow: block.is_hollow,
        }
    }

    /// The direction of rays along one of the block's axes.
    #[inline(always)]
    pub fn direction<I: Instructions>(
        &self,
        lanes: I,
        axis: usize,
        [x, y]: [Floats<I>; 2],
    ) -> Floats<I> {
        let row = &self.rows[axis];
        lanes.splat(row[0]) * x + lanes.splat(row[1]) * y + lanes.splat(row[2])
    }

    /// Depths at which rays enter (a hollow block: leave); infinite where they miss.
    #[inline(always)]
    pub fn depth<I: Instructions>(&self, lanes: I, at: [Floats<I>; 2]) -> Floats<I> {
        let infinite = lanes.splat(f32::INFINITY);
        let (mut enter, mut leave) = (lanes.splat(f32::NEG_INFINITY), infinite);
        for k in 0..3 {
            let inverse = lanes.splat(1.0) / self.direction(lanes, k, at);
            let middle = lanes.splat(-self.origin[k]) * inverse;
            let reach = (lanes.splat(self.half[k]) * inverse).abs();
            enter = (middle - reach).max(enter);
            leave = (middle + reach).min(leave);
        }
        let depth = if self.is_hollow { leave } else { enter };
        let met = leave.greater(enter).select(depth, infinite);
        met.greater(lanes.splat(NEAREST_M)).select(met, infinite)
    }

    /// The faces that rays meet at `depth`: 2 × axis, plus 1 on the positive side.
    #[inline(always)]
    pub fn face<I: Instructions>(
        &self,
        lanes: I,
        at: [Floats<I>; 2],
        depth: Floats<I>,
    ) -> Floats<I> {
        let (mut outermost, mut face) = (lanes.splat(f32::NEG_INFINITY), lanes.splat(0.0));
        for k in 0..3 {
            let place = lanes.splat(self.origin[k]) + depth * self.direction(lanes, k, at);
            let outside = place.abs() - lanes.splat(self.half[k]);
            let (low, high) = (lanes.splat((2 * k) as f32), lanes.splat((2 * k + 1) as f32));
            let side = place.greater(lanes.splat(0.0)).select(high, low);
            face = outside.greater(outermost).select(side, face);
            outermost = outside.max(outermost);
        }
        face
    }
}

/// The nearest surfaces that rays meet.
#[derive(Debug, Clone, Copy)]
pub struct Nearest<R> {
    /// Depth along the optical axis, metres; infinite where there is no surface.
    pub depth: Lanes<R>,
    block: Lanes<R>,
}

impl<R: Register> Nearest<R> {
    /// No surface.
    #[inline(always)]
    pub fn nothing<I: Instructions<Register = R>>(lanes: I) -> Self {
        Self { depth: lanes.splat(f32::INFINITY), block: lanes.splat(NO_SURFACE) }
    }

    /// Returns this or, where it is nearer, one more block.
    #[inline(always)]
    pub fn or_block<I: Instructions<Register = R>>(
        self,
        lanes: I,
        views: &[LocalView],
        block: u32,
        at: [Lanes<R>; 2],
    ) -> Self {
        let met = views[block as usize].depth(lanes, at);
        let index = lanes.splat(block as f32);
        Self {
            depth: met.min(self.depth),
            block: self.depth.greater(met).select(index, self.block),
        }
    }

    /// The surfaces that the rays meet.
    #[inline(always)]
    pub fn surfaces<I: Instructions<Register = R>>(
        self,
        lanes: I,
        views: &[LocalView],
        at: [Lanes<R>; 2],
    ) -> Lanes<R> {
        let blocks = self.block.to_array::<LANES>();
        let mut surfaces = lanes.splat(NO_SURFACE);
        let mut left = !self.block.equal(surfaces).bits() & ALL_LANES;
        while left != 0 {
            let block = blocks[left.trailing_zeros() as usize];
            let face = views[block as usize].face(lanes, at, self.depth);
            let surface = lanes.splat(8.0 * block) + face;
            let here = lanes.splat(block);
            surfaces = self.block.equal(here).select(surface, surfaces);
            left &= !self.block.equal(here).bits();
        }
        surfaces
    }
}
