//! The blocks of a scene as one camera sees them: where rays meet them, many at a time.

use nalgebra::{Matrix3, Vector3};

use crate::capture::simulator::lanes_kernel::{ALL_LANES, Lanes};
use crate::capture::simulator::lens::NEAREST_M;
use crate::capture::simulator::scene::Block;

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
    pub fn direction<L: Lanes>(&self, lanes: L, axis: usize, [x, y]: [L::F; 2]) -> L::F {
        let row = &self.rows[axis];
        lanes.splat(row[0]) * x + lanes.splat(row[1]) * y + lanes.splat(row[2])
    }

    /// Depths at which rays enter (a hollow block: leave); infinite where they miss.
    #[inline(always)]
    pub fn depth<L: Lanes>(&self, lanes: L, at: [L::F; 2]) -> L::F {
        let infinite = lanes.splat(f32::INFINITY);
        let (mut enter, mut leave) = (lanes.splat(f32::NEG_INFINITY), infinite);
        for k in 0..3 {
            let inverse = lanes.splat(1.0) / self.direction(lanes, k, at);
            let middle = lanes.splat(-self.origin[k]) * inverse;
            let reach = lanes.abs(lanes.splat(self.half[k]) * inverse);
            enter = lanes.max(middle - reach, enter);
            leave = lanes.min(middle + reach, leave);
        }
        let depth = if self.is_hollow { leave } else { enter };
        let met = lanes.if_less(enter, leave, depth, infinite);
        lanes.if_less(lanes.splat(NEAREST_M), met, met, infinite)
    }

    /// The faces that rays meet at `depth`: 2 × axis, plus 1 on the positive side.
    #[inline(always)]
    pub fn face<L: Lanes>(&self, lanes: L, at: [L::F; 2], depth: L::F) -> L::F {
        let (mut outermost, mut face) = (lanes.splat(f32::NEG_INFINITY), lanes.splat(0.0));
        for k in 0..3 {
            let place = lanes.splat(self.origin[k]) + depth * self.direction(lanes, k, at);
            let outside = lanes.abs(place) - lanes.splat(self.half[k]);
            let (low, high) = (lanes.splat((2 * k) as f32), lanes.splat((2 * k + 1) as f32));
            let side = lanes.if_less(lanes.splat(0.0), place, high, low);
            face = lanes.if_less(outermost, outside, side, face);
            outermost = lanes.max(outside, outermost);
        }
        face
    }
}

/// What rays meet first.
#[derive(Debug, Clone, Copy)]
pub struct Nearest<F> {
    /// Depth along the optical axis, metres; infinite where nothing is.
    pub depth: F,
    block: F,
}

impl<F: Copy> Nearest<F> {
    /// Nothing.
    #[inline(always)]
    pub fn nothing<L: Lanes<F = F>>(lanes: L) -> Self {
        Self { depth: lanes.splat(f32::INFINITY), block: lanes.splat(NO_SURFACE) }
    }

    /// This or, where it is nearer, one more block.
    #[inline(always)]
    pub fn or_block<L: Lanes<F = F>>(
        self,
        lanes: L,
        views: &[LocalView],
        block: u32,
        at: [F; 2],
    ) -> Self {
        let met = views[block as usize].depth(lanes, at);
        let index = lanes.splat(block as f32);
        Self {
            depth: lanes.min(met, self.depth),
            block: lanes.if_less(met, self.depth, index, self.block),
        }
    }

    /// The surfaces that the rays meet.
    #[inline(always)]
    pub fn surfaces<L: Lanes<F = F>>(self, lanes: L, views: &[LocalView], at: [F; 2]) -> F
    where
        F: std::ops::Add<Output = F> + std::ops::Mul<Output = F>,
    {
        let blocks = lanes.store(self.block);
        let mut surfaces = lanes.splat(NO_SURFACE);
        let mut left = !lanes.equal_bits(self.block, surfaces) & ALL_LANES;
        while left != 0 {
            let block = blocks[left.trailing_zeros() as usize];
            let face = views[block as usize].face(lanes, at, self.depth);
            let surface = lanes.splat(8.0 * block) + face;
            let here = lanes.splat(block);
            surfaces = lanes.if_equal(self.block, here, surface, surfaces);
            left &= !lanes.equal_bits(self.block, here);
        }
        surfaces
    }
}
