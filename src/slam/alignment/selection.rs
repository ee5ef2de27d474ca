//! Selects the points of a level that are aligned if there are more than the budget.
//!
//! The image is divided into tiles; each tile gets a share of the budget that grows with the square root of its number
//! of points (between equal and proportional shares), and keeps its most informative ones.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::fusion::LevelPoint;
use crate::slam::image::buffer::Image;
use crate::slam::image::noise::ImageNoise;
use crate::slam::image::sums::grey_per_sum;
use crate::slam::parameter::{ParameterError, check_range};

/// How the points of a level are chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SelectionParams {
    /// The camera's noise, configured once for all modules; it determines how strong a gradient must be to count.
    #[serde(skip)]
    pub noise: ImageNoise,
    /// Translation, relative to the mean depth, at which noise in the image and in the depth are weighed against each
    /// other. A keyframe is replaced at about a third.
    pub typical_translation: f32,
}

impl Default for SelectionParams {
    fn default() -> Self {
        Self { noise: ImageNoise::default(), typical_translation: 0.1 }
    }
}

impl SelectionParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("typical_translation", self.typical_translation, 0.0..=10.0)
    }
}

/// Side of a tile, pixels of the level: small enough for an even spread, large enough that a tile with points gets at
/// least a few.
const TILE_PX: usize = 16;

/// Chooses points, in reusable memory.
#[derive(Debug, Clone, Default)]
pub struct Selection {
    ranked: Vec<(u64, u32)>,
    tile_starts: Vec<u32>,
    by_tile: Vec<u64>,
    is_chosen: Vec<bool>,
    chosen: Vec<u32>,
}

impl Selection {
    /// Indices, ascending, of at most `budget` of the `candidates` on `image`, the sums of `level`.
    /// `focal_times_depth`: focal length of the level times mean depth, which converts a variance of inverse depth into
    /// pixels² for a translation of one mean depth.
    pub fn choose(
        &mut self,
        params: &SelectionParams,
        candidates: &[LevelPoint],
        image: &Image<u16>,
        level: usize,
        focal_times_depth: f64,
        budget: usize,
    ) -> &[u32] {
        self.chosen.clear();
        // One more than the number chosen, see `fill_quotas`.
        self.chosen.reserve(budget.min(candidates.len()) + 1);
        if candidates.len() <= budget {
            self.chosen.extend(0..candidates.len() as u32);
            return &self.chosen;
        }
        let pixels_per_inverse_depth = focal_times_depth as f32 * params.typical_translation;
        self.rank_all(params, candidates, image, level, pixels_per_inverse_depth);
        let num_tiles = self.sort_into_tiles();
        self.fill_quotas(num_tiles, budget);
        &self.chosen
    }

    /// Ranks the candidates by their information about a shift along the gradient, 1/pixels²: 1/(σ²/|g|² + (∂u/∂d)² V),
    /// and counts those in each tile.
    fn rank_all(
        &mut self,
        params: &SelectionParams,
        candidates: &[LevelPoint],
        image: &Image<u16>,
        level: usize,
        pixels_per_inverse_depth: f32,
    ) {
        let grey = 0.5 * grey_per_sum(level);
        let noise = params.noise.variance(level);
        let from_depth = pixels_per_inverse_depth * pixels_per_inverse_depth;
        let (width, pixels) = (image.width(), image.pixels());
        let (right, bottom) = (width - 1, image.height() - 1);
        let columns = width.div_ceil(TILE_PX);
        self.tile_starts.clear();
        self.tile_starts.resize(columns * image.height().div_ceil(TILE_PX) + 1, 0);
        self.ranked.clear();
        let points = candidates.iter().zip(0..);
        self.ranked.extend(points.map(|(candidate, index)| {
            let (u, v) = (usize::from(candidate.u), usize::from(candidate.v));
            let row = v * width;
            let at = |index: usize| f32::from(pixels[index]);
            let beside = [at(row + u.saturating_sub(1)), at(row + (u + 1).min(right))];
            let below = if v < bottom { row + width } else { row };
            let across = [at(row.saturating_sub(width) + u), at(below + u)];
            let [gx, gy] = [beside, across].map(|[before, after]| (after - before) * grey);
            // Next to pixels without data there is no gradient.
            let has_data = beside[0] * beside[1] * (across[0] * across[1]) > 0.0;
            let squared_gradient = if has_data { gx * gx + gy * gy } else { 0.0 };
            let score =
                squared_gradient / (noise + squared_gradient * from_depth * candidate.variance);
            let tile = (v / TILE_PX) * columns + u / TILE_PX;
            self.tile_starts[tile + 1] += 1;
            (rank(score, index), tile as u32)
        }));
    }

    /// Counting sort of the ranks by tile; returns the number of tiles.
    fn sort_into_tiles(&mut self) -> usize {
        let num_tiles = self.tile_starts.len() - 1;
        for tile in 0..num_tiles {
            self.tile_starts[tile + 1] += self.tile_starts[tile];
        }
        self.by_tile.clear();
        self.by_tile.resize(self.ranked.len(), 0);
        // Each start moves to the end of its tile, which is the start of the next …
        for &(rank, tile) in &self.ranked {
            let at = &mut self.tile_starts[tile as usize];
            self.by_tile[*at as usize] = rank;
            *at += 1;
        }
        // … and all move back into place.
        self.tile_starts.copy_within(0..num_tiles, 1);
        self.tile_starts[0] = 0;
        num_tiles
    }

    /// Takes the best points of each tile, up to its share of the budget, and lists them in ascending order.
    fn fill_quotas(&mut self, num_tiles: usize, budget: usize) {
        let tile = |starts: &[u32], tile: usize| starts[tile] as usize..starts[tile + 1] as usize;
        let share = |count: usize| (count as f64).sqrt();
        let mut factor = 0.0;
        // The surplus of full tiles goes to the others: three rounds leave a few per mille.
        for _ in 0..3 {
            let (mut open, mut taken) = (0.0, 0.0);
            for index in 0..num_tiles {
                let count = tile(&self.tile_starts, index).len();
                if factor * share(count) >= count as f64 && factor > 0.0 {
                    taken += count as f64;
                } else {
                    open += share(count);
                }
            }
            factor = (budget as f64 - taken).max(0.0) / f64::max(open, 1.0);
        }
        let (mut carried, mut taken) = (0.0, 0);
        self.is_chosen.clear();
        self.is_chosen.resize(self.ranked.len(), false);
        for index in 0..num_tiles {
            let range = tile(&self.tile_starts, index);
            if range.is_empty() {
                continue;
            }
            carried += (factor * share(range.len())).min(range.len() as f64);
            let quota = (carried as usize).min(range.len()).min(budget - taken);
            carried -= quota as f64;
            if quota == 0 {
                continue;
            }
            let ranks = &mut self.by_tile[range];
            if quota < ranks.len() {
                ranks.select_nth_unstable(quota - 1);
            }
            for &rank in &ranks[..quota] {
                self.is_chosen[index_of(rank)] = true;
            }
            taken += quota;
        }
        // One more than the number taken: every index is written, and the next overwrites one that is not chosen.
        self.chosen.resize(taken + 1, 0);
        let mut count = 0;
        for (index, &is_chosen) in self.is_chosen.iter().enumerate() {
            self.chosen[count] = index as u32;
            count += usize::from(is_chosen);
        }
        self.chosen.truncate(taken);
    }
}

/// Orders candidates from best to worst, ties by index: a score is never negative, so that the order of its bits is
/// that of its values.
fn rank(score: f32, index: u32) -> u64 {
    u64::from(!score.to_bits()) << 32 | u64::from(index)
}

/// The candidate index of a [`rank`].
fn index_of(rank: u64) -> usize {
    rank as u32 as usize
}
