//! Finds the blocks that each tile of the image can see, so that a ray tests only a few of them.

use nalgebra::Vector3;

use crate::capture::simulator::lens::{LANES, Lens, NEAREST_M};
use crate::capture::simulator::scene::{Block, Scene};
use crate::slam::geometry::se3::SE3;

/// Side of a tile, pixels: few blocks per tile, and few enough tiles to sort.
const TILE_PX: usize = 16;
/// Rays that are cast together share one list.
const _: () = assert!(TILE_PX.is_multiple_of(LANES));

/// A block that may be visible, and a lower bound on its depth, metres.
#[derive(Debug, Clone, Copy)]
pub struct NearBlock {
    /// Index into [`Scene::blocks`].
    pub block: u32,
    /// No ray meets it nearer than this.
    pub nearest: f32,
}

/// For every tile, the blocks that may be visible in it, nearest first.
#[derive(Debug, Default)]
pub struct TileLists {
    columns: usize,
    /// Start of each tile's part of `blocks`, and the end of the last.
    starts: Vec<usize>,
    blocks: Vec<NearBlock>,
    boxes: Vec<(NearBlock, Bounds)>,
}

/// Bounds in x and y at z = 1.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: [f32; 2],
    high: [f32; 2],
}

impl Bounds {
    const EMPTY: Self = Self { low: [f32::INFINITY; 2], high: [f32::NEG_INFINITY; 2] };

    fn include(&mut self, at: [f32; 2]) {
        for k in 0..2 {
            self.low[k] = self.low[k].min(at[k]);
            self.high[k] = self.high[k].max(at[k]);
        }
    }

    fn overlaps(&self, other: &Self) -> bool {
        (0..2).all(|k| self.low[k] <= other.high[k] && other.low[k] <= self.high[k])
    }
}

impl TileLists {
    /// Blocks that the ray of a pixel can meet.
    #[inline]
    pub fn of_pixel(&self, u: usize, v: usize) -> &[NearBlock] {
        let tile = v / TILE_PX * self.columns + u / TILE_PX;
        &self.blocks[self.starts[tile]..self.starts[tile + 1]]
    }

    /// Fills the lists for the camera poses of all image rows.
    pub fn fill(
        &mut self,
        scene: &Scene,
        lens: &Lens,
        pose_of_row: &dyn Fn(usize) -> SE3,
        is_global: bool,
    ) {
        self.columns = lens.width.div_ceil(TILE_PX);
        self.starts.clear();
        self.blocks.clear();
        for band in 0..lens.height.div_ceil(TILE_PX) {
            let rows = band * TILE_PX..((band + 1) * TILE_PX).min(lens.height);
            if band == 0 || !is_global {
                let ends = [pose_of_row(rows.start), pose_of_row(rows.end - 1)];
                self.project(scene, if is_global { &ends[..1] } else { &ends });
            }
            for column in 0..self.columns {
                self.starts.push(self.blocks.len());
                let columns = column * TILE_PX..((column + 1) * TILE_PX).min(lens.width);
                let tile = tile_bounds(lens, columns, rows.clone());
                let seen = self.boxes.iter().filter(|(_, bounds)| bounds.overlaps(&tile));
                self.blocks.extend(seen.map(|&(candidate, _)| candidate));
            }
        }
        self.starts.push(self.blocks.len());
    }

    /// Projects all blocks from the given poses (the ends of a short motion) and sorts them.
    fn project(&mut self, scene: &Scene, world_from_cameras: &[SE3]) {
        self.boxes.clear();
        for (index, block) in scene.blocks.iter().enumerate() {
            let (mut bounds, mut nearest) = (Bounds::EMPTY, f32::INFINITY);
            for pose in world_from_cameras {
                nearest = nearest.min(include_block(block, &pose.inverse(), &mut bounds));
            }
            if nearest < f32::INFINITY {
                self.boxes.push((NearBlock { block: index as u32, nearest }, bounds));
            }
        }
        self.boxes
            .sort_by(|(a, _), (b, _)| a.nearest.total_cmp(&b.nearest).then(a.block.cmp(&b.block)));
    }
}

/// Bounds of the rays of a tile with a margin of a pixel on every side: the lens bends lines, and between two rows'
/// poses a block moves.
fn tile_bounds(
    lens: &Lens,
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    for v in rows.clone() {
        for u in [columns.start, columns.end - 1] {
            bounds.include(lens.ray(v * lens.width + u).at);
        }
    }
    for u in columns.clone() {
        for v in [rows.start, rows.end - 1] {
            bounds.include(lens.ray(v * lens.width + u).at);
        }
    }
    let ray = lens.ray(rows.start * lens.width + columns.start);
    for k in 0..2 {
        let spare = 1.5 * (ray.du[k].abs() + ray.dv[k].abs());
        bounds.low[k] -= spare;
        bounds.high[k] += spare;
    }
    bounds
}

/// Extends `bounds` by the projection of the part of a block in front of the camera; returns its nearest depth,
/// infinite if all of it is behind.
fn include_block(block: &Block, camera_from_world: &SE3, bounds: &mut Bounds) -> f32 {
    let (sin, cos) = block.turn;
    let corners: [Vector3<f64>; 8] = std::array::from_fn(|i| {
        let sign = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        let (x, y, z) = (sign(0) * block.half[0], sign(1) * block.half[1], sign(2) * block.half[2]);
        let in_world = [
            block.centre[0] + cos * x - sin * y,
            block.centre[1] + sin * x + cos * y,
            block.centre[2] + z,
        ];
        *camera_from_world * Vector3::from(in_world.map(f64::from))
    });
    /// Keeps the bound below the depths that rays find, which are rounded to f32.
    const SPARE: f64 = 1.0 - 1e-5;
    let near = f64::from(NEAREST_M);
    let mut nearest = f64::INFINITY;
    let mut include = |p: &Vector3<f64>| {
        nearest = nearest.min(p.z);
        bounds.include([(p.x / p.z) as f32, (p.y / p.z) as f32]);
    };
    for (i, from) in corners.iter().enumerate() {
        if from.z >= near {
            include(from);
        }
        // Edges that cross the near plane are clipped there.
        for to in (0..3).map(|bit| &corners[i | 1 << bit]) {
            if (from.z < near) != (to.z < near) {
                let share = (near - from.z) / (to.z - from.z);
                include(&(from + (to - from) * share));
            }
        }
    }
    // A hollow block is met from inside, anywhere in front of the camera.
    if block.is_hollow && nearest.is_finite() { 0.0 } else { (nearest * SPARE) as f32 }
}
