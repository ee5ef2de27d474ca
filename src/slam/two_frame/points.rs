//! The points of the first frame: their positions, their patches at each level, and their neighbours.

use crate::slam::depth::candidate::{CandidateParams, CandidateSelector};
use crate::slam::depth::gradient_image::GradientImage;
use crate::slam::depth::pattern::{PATTERN, sample_weight};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::image::pyramid::Pyramid;
use crate::slam::two_frame::lanes::{LANES, Lanes};

/// Neighbours that smooth a point's depth.
pub const NUM_NEIGHBOURS: usize = 8;

/// A block of points at one pyramid level.
#[derive(Debug, Clone, Copy)]
pub struct PatchBlock {
    /// Columns at the level.
    pub u: Lanes,
    /// Rows at the level.
    pub v: Lanes,
    /// Brightness at the samples of the pattern.
    pub intensities: [Lanes; 8],
    /// Weights of the samples; all 0 where the patch does not fit into the level, or includes pixels without data.
    pub weights: [Lanes; 8],
    /// Sum of a point's weights.
    pub weight: Lanes,
}

/// The nearest other points of a block of points: for each neighbour the lanes' indices.
pub type NeighbourBlock = [[u32; LANES]; NUM_NEIGHBOURS];

/// The points of the first frame.
#[derive(Debug, Default)]
pub struct Points {
    /// Column and row, level 0.
    pub pixels: Vec<(u16, u16)>,
    /// The points' patches, finest level first.
    pub patches: Vec<Vec<PatchBlock>>,
    /// The nearest other points of each point.
    pub neighbours: Vec<NeighbourBlock>,
    selector: CandidateSelector,
}

impl Points {
    /// Chooses the points of a frame and takes their patches; returns their number.
    pub fn choose(
        &mut self,
        image: &GradientImage,
        pyramid: &Pyramid,
        params: &CandidateParams,
    ) -> usize {
        let mut chosen = Vec::new();
        self.selector.choose(image, params, &mut chosen);
        self.pixels.clear();
        self.pixels.extend(chosen.iter().map(|c| (c.u, c.v)));
        self.patches.resize(pyramid.levels().len(), Vec::new());
        let levels = self.patches.iter_mut().zip(pyramid.levels());
        for (level, (patches, image)) in levels.enumerate() {
            patches.clear();
            let block = |pixels: &[_]| patches_at(image, level, pixels);
            patches.extend(self.pixels.chunks(LANES).map(block));
        }
        self.neighbours.clear();
        if self.pixels.len() <= NUM_NEIGHBOURS {
            return 0;
        }
        for first in (0..self.pixels.len()).step_by(LANES) {
            let mut block = [[0; LANES]; NUM_NEIGHBOURS];
            for l in 0..LANES.min(self.pixels.len() - first) {
                for (lanes, neighbour) in block.iter_mut().zip(nearest(&self.pixels, first + l)) {
                    lanes[l] = neighbour;
                }
            }
            self.neighbours.push(block);
        }
        self.pixels.len()
    }
}

/// The patches of a block; unused lanes have no weight.
fn patches_at(image: &Image<f32>, level: usize, pixels: &[(u16, u16)]) -> PatchBlock {
    let empty = [0.0; LANES];
    let mut block = PatchBlock {
        u: empty,
        v: empty,
        intensities: [empty; 8],
        weights: [empty; 8],
        weight: empty,
    };
    for (l, &pixel) in pixels.iter().enumerate() {
        fill_lane(&mut block, l, image, level, pixel);
    }
    block
}

fn fill_lane(
    block: &mut PatchBlock,
    l: usize,
    image: &Image<f32>,
    level: usize,
    (u, v): (u16, u16),
) {
    /// The pattern extends 2 pixels, its gradient 1.
    const REACH_PX: f32 = 3.0;
    let shrink = f32::powi(0.5, level as i32);
    let (u, v) = ((f32::from(u) + 0.5) * shrink - 0.5, (f32::from(v) + 0.5) * shrink - 0.5);
    (block.u[l], block.v[l]) = (u, v);
    let columns = REACH_PX..image.width() as f32 - 1.0 - REACH_PX;
    let rows = REACH_PX..image.height() as f32 - 1.0 - REACH_PX;
    if !columns.contains(&u) || !rows.contains(&v) {
        return;
    }
    let samples = PATTERN.map(|(x, y)| {
        let (x, y) = (u + x as f32, v + y as f32);
        let gu = 0.5 * (image.bilinear(x + 1.0, y) - image.bilinear(x - 1.0, y));
        let gv = 0.5 * (image.bilinear(x, y + 1.0) - image.bilinear(x, y - 1.0));
        (image.bilinear(x, y), sample_weight(gu, gv))
    });
    if samples.iter().any(|(intensity, weight)| intensity.is_nan() || weight.is_nan()) {
        return;
    }
    for (k, (intensity, weight)) in samples.into_iter().enumerate() {
        block.intensities[k][l] = intensity;
        block.weights[k][l] = weight;
        block.weight[l] += weight;
    }
}

/// The nearest other points, by distance, ties by index. There are more than [`NUM_NEIGHBOURS`] points.
fn nearest(pixels: &[(u16, u16)], i: usize) -> [u32; NUM_NEIGHBOURS] {
    let mut found = [(u32::MAX, 0); NUM_NEIGHBOURS];
    let (u, v) = (i32::from(pixels[i].0), i32::from(pixels[i].1));
    for (j, pixel) in pixels.iter().enumerate() {
        let (du, dv) = (i32::from(pixel.0) - u, i32::from(pixel.1) - v);
        let distance = (du * du + dv * dv) as u32;
        if j == i || distance >= found[NUM_NEIGHBOURS - 1].0 {
            continue;
        }
        let place = found.partition_point(|f| f.0 <= distance);
        found[place..].rotate_right(1);
        found[place] = (distance, j as u32);
    }
    found.map(|f| f.1)
}

/// Levels down to about 80 pixels across: a tenth of the image then moves by a few pixels. The shorter side limits only
/// strips: a car's camera is four times as wide as high, and at 1.2 m per frame the road needs all levels.
pub(super) fn num_levels(intrinsics: &Intrinsics) -> usize {
    const MIN_LONG_SIDE: usize = 64;
    const MIN_SHORT_SIDE: usize = 20;
    const MAX_LEVELS: usize = 6;
    let (width, height) = (intrinsics.width, intrinsics.height);
    let (long, short) = (width.max(height), width.min(height));
    let fits = |l: &usize| long >> l >= MIN_LONG_SIDE && short >> l >= MIN_SHORT_SIDE;
    (0..MAX_LEVELS).take_while(fits).count().max(1)
}
