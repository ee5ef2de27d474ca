//! The inverse depth around a point, excluding the point itself: where its Jacobian is evaluated.
//!
//! Noise in the depth of a point changes its residual. If the Jacobian were evaluated at the same depth, both would
//! carry the same noise, their product would not average out, and the translation would be biased towards zero, by far
//! more than its standard deviation where rotation and translation look alike (7 % on a plane with 10 % of noise). A
//! Jacobian from the neighbours' depth, an instrumental variable, has the same zero without that bias, whatever the
//! noise and its assumed size.

use crate::slam::alignment::fusion::LevelPoint;

/// Side of a tile, pixels of the level: large enough that only a few of the neighbours share the noise of a point, and
/// small enough that surfaces hardly bend within.
const TILE_PX: usize = 8;

/// Weight of the mean of the whole level against the points of a tile: it decides where a point is alone.
const LEVEL_COUNT: f32 = 0.5;

/// Share of a tile's information below which the rest without a point is rounding error.
const MIN_REMAINDER: f32 = 1.0e-3;

/// Sums of inverse depth over tiles, in reusable memory.
#[derive(Debug, Clone, Default)]
pub struct Surroundings {
    columns: usize,
    mean: f32,
    mean_information: f32,
    tiles: Vec<Tile>,
}

/// Sums over one tile, weighted by information 1/V.
#[derive(Debug, Clone, Copy, Default)]
struct Tile {
    weighted: f32,
    information: f32,
}

impl Surroundings {
    /// Sums the candidates of a level of `width * height` pixels.
    pub fn measure(&mut self, candidates: &[LevelPoint], width: usize, height: usize) {
        self.columns = width.div_ceil(TILE_PX);
        self.tiles.clear();
        self.tiles.resize(self.columns * height.div_ceil(TILE_PX), Tile::default());
        let mut total = Tile::default();
        for candidate in candidates {
            let index = self.tile_of(candidate);
            let Some(tile) = self.tiles.get_mut(index) else { continue };
            let information = 1.0 / candidate.variance;
            for sums in [tile, &mut total] {
                sums.weighted += information * candidate.inverse_depth;
                sums.information += information;
            }
        }
        let is_some = total.information > 0.0;
        self.mean = if is_some { total.weighted / total.information } else { 1.0 };
        self.mean_information = total.information / candidates.len().max(1) as f32;
    }

    /// Mean inverse depth around `candidate`, one of those measured, excluding its own.
    pub fn mean_excluding(&self, candidate: &LevelPoint) -> f32 {
        let tile = self.tiles.get(self.tile_of(candidate)).copied().unwrap_or_default();
        let own = 1.0 / candidate.variance;
        // Rounding must not leave a remainder where the point is alone.
        let others = tile.information - own;
        let others = if others > MIN_REMAINDER * tile.information { others } else { 0.0 };
        let level = LEVEL_COUNT * self.mean_information;
        let mean = if others > 0.0 {
            (tile.weighted - own * candidate.inverse_depth).max(0.0) / others
        } else {
            self.mean
        };
        (others * mean + level * self.mean) / (others + level)
    }

    fn tile_of(&self, candidate: &LevelPoint) -> usize {
        usize::from(candidate.v) / TILE_PX * self.columns + usize::from(candidate.u) / TILE_PX
    }
}

#[cfg(test)]
mod tests {
    use crate::slam::alignment::fusion::DepthFusion;
    use crate::slam::alignment::surroundings::Surroundings;
    use crate::slam::keyframe::DepthPoint;

    #[test]
    fn a_point_does_not_count_in_its_own_surroundings() {
        let depth = |u: u16, v: u16, inverse_depth: f32| DepthPoint {
            u,
            v,
            inverse_depth,
            variance: 1.0,
            intensity: 0.0,
        };
        let mut fusion = DepthFusion::default();
        // Two in one tile, one alone in another.
        fusion.fuse(&[depth(1, 1, 1.0), depth(6, 3, 2.0), depth(40, 9, 6.0)], 64, 32, 1, 0);
        let level = fusion.level(0);
        let mut surroundings = Surroundings::default();
        surroundings.measure(level, 64, 32);
        // The mean of all, 3, has the weight of half a point.
        let expected = [(2.0 + 1.5) / 1.5, (1.0 + 1.5) / 1.5, 3.0];
        for (index, expected) in expected.into_iter().enumerate() {
            let found = surroundings.mean_excluding(&level[index]);
            assert!((found - expected).abs() < 1e-6, "point {index}: {found}, not {expected}");
        }
    }
}
