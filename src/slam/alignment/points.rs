//! Points of one pyramid level in blocks of lanes.

use nalgebra::Vector3;

/// Points per block: one register of AVX-512, two of AVX2, four of NEON.
pub const LANES: usize = 16;

/// Sixteen points, each quantity contiguous and aligned to a cache line.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub struct PointBlock {
    /// x of the ray (x, y, 1) through the pixel.
    pub ray_x: [f32; LANES],
    /// y of the ray.
    pub ray_y: [f32; LANES],
    /// Inverse depth, 1/keyframe units.
    pub inverse_depth: [f32; LANES],
    /// Variance of the inverse depth.
    pub variance: [f32; LANES],
    /// Inverse depth of the surroundings, excluding the point itself: where the Jacobian is evaluated.
    pub surrounding_inverse_depth: [f32; LANES],
    /// Brightness of the keyframe there, grey levels.
    pub intensity: [f32; LANES],
    /// Gradient of the keyframe along u there, grey levels per pixel of the level.
    pub gradient_x: [f32; LANES],
    /// Gradient along v.
    pub gradient_y: [f32; LANES],
}

/// A ray so flat that no camera sees it: the padding of the last block is never in view.
const PADDING_RAY: f32 = 1.0e6;

impl PointBlock {
    const PADDING: Self = Self {
        ray_x: [PADDING_RAY; LANES],
        ray_y: [PADDING_RAY; LANES],
        inverse_depth: [1.0; LANES],
        variance: [1.0; LANES],
        surrounding_inverse_depth: [1.0; LANES],
        intensity: [0.0; LANES],
        gradient_x: [0.0; LANES],
        gradient_y: [0.0; LANES],
    };
}

/// One point before it is packed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// x of the ray (x, y, 1) through the pixel.
    pub ray_x: f32,
    /// y of the ray.
    pub ray_y: f32,
    /// Inverse depth, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance of the inverse depth.
    pub variance: f32,
    /// Inverse depth of the surroundings, excluding the point itself: where the Jacobian is evaluated.
    pub surrounding_inverse_depth: f32,
    /// Brightness of the keyframe there, grey levels.
    pub intensity: f32,
    /// Gradient of the keyframe along u there, grey levels per pixel of the level.
    pub gradient_x: f32,
    /// Gradient along v.
    pub gradient_y: f32,
}

/// Consecutive points of one block that lie in one tile of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TileRun {
    /// The block.
    pub block: u32,
    /// The tile.
    pub tile: u16,
    /// Lane of the first point.
    pub first: u8,
    /// Lane after the last.
    pub end: u8,
}

/// The points of one level.
#[derive(Debug, Clone, Default)]
pub struct LevelPoints {
    blocks: Vec<PointBlock>,
    /// ln d by block, stored separately: only the statistics of a frame's final state need it.
    log_inverse_depths: Vec<[f32; LANES]>,
    /// Sums of x, y and ln d.
    sums: [f64; 3],
    runs: Vec<TileRun>,
    len: usize,
}

impl LevelPoints {
    /// Removes the points and keeps the memory.
    pub fn clear(&mut self) {
        self.blocks.clear();
        self.log_inverse_depths.clear();
        self.sums = [0.0; 3];
        self.runs.clear();
        self.len = 0;
    }

    /// Reserves memory for this many points, however they lie: each may start a run.
    pub fn reserve(&mut self, points: usize) {
        let missing = |len: usize, wanted: usize| wanted.saturating_sub(len);
        let blocks = points.div_ceil(LANES);
        self.blocks.reserve(missing(self.blocks.len(), blocks));
        self.log_inverse_depths.reserve(missing(self.log_inverse_depths.len(), blocks));
        self.runs.reserve(missing(self.runs.len(), points));
    }

    /// Adds a point that lies in `tile` of the image.
    #[inline]
    pub fn push(&mut self, point: Point, tile: u16) {
        let lane = self.len % LANES;
        if lane == 0 {
            self.blocks.push(PointBlock::PADDING);
            self.log_inverse_depths.push([0.0; LANES]);
        }
        let log_inverse_depth = point.inverse_depth.max(f32::MIN_POSITIVE).ln();
        let place = [point.ray_x, point.ray_y, log_inverse_depth];
        for (sum, coordinate) in self.sums.iter_mut().zip(place) {
            *sum += f64::from(coordinate);
        }
        if let Some(block) = self.log_inverse_depths.last_mut() {
            block[lane] = log_inverse_depth;
        }
        if let Some(block) = self.blocks.last_mut() {
            block.ray_x[lane] = point.ray_x;
            block.ray_y[lane] = point.ray_y;
            block.inverse_depth[lane] = point.inverse_depth;
            block.variance[lane] = point.variance;
            block.surrounding_inverse_depth[lane] = point.surrounding_inverse_depth;
            block.intensity[lane] = point.intensity;
            block.gradient_x[lane] = point.gradient_x;
            block.gradient_y[lane] = point.gradient_y;
            self.len += 1;
        }
        let (block, first) = ((self.blocks.len() - 1) as u32, lane as u8);
        match self.runs.last_mut() {
            Some(run) if run.block == block && run.tile == tile => run.end = first + 1,
            _ => self.runs.push(TileRun { block, tile, first, end: first + 1 }),
        }
    }

    /// Runs of points in their order, each within one block and one tile.
    pub fn runs(&self) -> &[TileRun] {
        &self.runs
    }

    /// The blocks; lanes beyond [`LevelPoints::len`] are never in view.
    pub fn blocks(&self) -> &[PointBlock] {
        &self.blocks
    }

    /// ln d of the points, by block.
    pub fn log_inverse_depths(&self) -> &[[f32; LANES]] {
        &self.log_inverse_depths
    }

    /// Mean of (x, y, ln d) over the points: a common error of depth, a plane over these three, leaves the mean depth
    /// unchanged when centred here.
    pub fn centre(&self) -> Vector3<f64> {
        Vector3::from(self.sums) / self.len.max(1) as f64
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The points one by one.
    pub fn iter(&self) -> impl Iterator<Item = Point> + '_ {
        let lanes = self.blocks.iter().flat_map(|block| {
            (0..LANES).map(|lane| Point {
                ray_x: block.ray_x[lane],
                ray_y: block.ray_y[lane],
                inverse_depth: block.inverse_depth[lane],
                variance: block.variance[lane],
                surrounding_inverse_depth: block.surrounding_inverse_depth[lane],
                intensity: block.intensity[lane],
                gradient_x: block.gradient_x[lane],
                gradient_y: block.gradient_y[lane],
            })
        });
        lanes.take(self.len)
    }
}
