//! Displacement of image tiles relative to the keyframe's points at the estimated pose.
//!
//! Noise of single pixels displaces a tile by the amount its information predicts. Any excess displaces whole tiles:
//! errors in the shape of the depth, residual distortion, a rolling shutter. The part common to all tiles has been
//! absorbed by the pose and cannot be observed; the remainder between the tiles indicates how large it may be.

use crate::slam::alignment::tiles::{NUM_TILES, TileSum};
use crate::slam::upper_median::upper_median;

/// Displacement of tiles along the direction in which each is determined best.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TileMisfit {
    /// Variance of the displacement, robustly from its median square, radians².
    pub variance: f64,
    /// Variance expected from noise of single pixels if σ_r is correct, radians².
    pub noise: f64,
}

/// Median of χ² with one degree of freedom.
const CHI_SQUARE_MEDIAN: f64 = 0.455;

impl TileMisfit {
    /// Computes the displacement from the sums of all tiles; zero if none has information.
    pub fn of(tiles: &[TileSum; NUM_TILES]) -> Self {
        let (mut squares, mut noises) = ([0.0; NUM_TILES], [0.0; NUM_TILES]);
        let mut count = 0;
        for (square, noise) in tiles.iter().filter_map(best_determined) {
            (squares[count], noises[count]) = (square, noise);
            count += 1;
        }
        let median = |values: &mut [f64]| upper_median(values, f64::total_cmp).unwrap_or(0.0);
        Self {
            variance: median(&mut squares[..count]) / CHI_SQUARE_MEDIAN,
            noise: median(&mut noises[..count]),
        }
    }

    /// Variance of the displacement beyond the noise of single pixels, radians². `mean_energy` is the mean whitened
    /// squared residual: the ratio of the noise to its prediction by σ_r.
    pub fn beyond_noise(&self, mean_energy: f64) -> f64 {
        let beyond = self.variance - mean_energy * self.noise;
        if beyond.is_finite() { beyond.max(0.0) } else { 0.0 }
    }
}

/// Squared displacement of a tile along the direction in which it is determined best, and its variance, radians²: with
/// the largest eigenvalue λ of its information and the unit eigenvector e, ((e·g)/λ)² and 1/λ.
fn best_determined(tile: &TileSum) -> Option<(f64, f64)> {
    let [xx, xy, yy] = tile.information.map(f64::from);
    let gradient = [tile.gradient[3], tile.gradient[4]].map(f64::from);
    let half_difference = 0.5 * (xx - yy);
    let largest = 0.5 * (xx + yy) + half_difference.hypot(xy);
    if !(largest > 0.0 && largest.is_finite()) {
        return None;
    }
    // The longer of two expressions for the same eigenvector; one of them may vanish.
    let along = match half_difference > 0.0 {
        true => [largest - yy, xy],
        false => [xy, largest - xx],
    };
    let length = along[0].hypot(along[1]);
    // A tile that is determined equally in all directions has no best one.
    let along = if length > 0.0 { along.map(|x| x / length) } else { [1.0, 0.0] };
    let displacement = (along[0] * gradient[0] + along[1] * gradient[1]) / largest;
    Some((displacement * displacement, 1.0 / largest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::alignment::scene::Noise;

    /// Tiles whose displacement is determined to 1/√100 along one direction and half as well across it, each displaced
    /// by `std_dev` in addition to that noise.
    fn tiles(std_dev: f64) -> [TileSum; NUM_TILES] {
        let mut noise = Noise(5);
        std::array::from_fn(|_| {
            let (sin, cos) = (3.0 * noise.uniform()).sin_cos();
            let (best, other) = (100.0, 25.0);
            let information = [
                best * cos * cos + other * sin * sin,
                (best - other) * cos * sin,
                best * sin * sin + other * cos * cos,
            ];
            let displaced = |information: f64, noise: &mut Noise| {
                information * (std_dev * noise.normal() + noise.normal() / information.sqrt())
            };
            let along = displaced(best, &mut noise);
            let across = displaced(other, &mut noise);
            let mut tile = TileSum { weight: 1.0, ..TileSum::default() };
            tile.gradient[3] = (along * cos - across * sin) as f32;
            tile.gradient[4] = (along * sin + across * cos) as f32;
            tile.information = information.map(|x| x as f32);
            tile
        })
    }

    #[test]
    fn displaced_tiles_are_distinguished_from_noise() {
        let of = |std_dev: f64| TileMisfit::of(&tiles(std_dev)).beyond_noise(1.0).sqrt();
        assert!(of(0.0) < 0.05, "{}", of(0.0));
        for std_dev in [0.2, 1.0] {
            assert!((of(std_dev) / std_dev - 1.0).abs() < 0.2, "{std_dev}: {}", of(std_dev));
        }
        assert!((TileMisfit::of(&tiles(0.0)).noise - 0.01).abs() < 1e-6);
    }

    #[test]
    fn tiles_without_information_give_no_misfit() {
        assert_eq!(TileMisfit::of(&[TileSum::default(); NUM_TILES]), TileMisfit::default());
        let broken = TileSum { information: [f32::NAN; 3], ..TileSum::default() };
        assert_eq!(TileMisfit::of(&[broken; NUM_TILES]), TileMisfit::default());
        assert_eq!(TileMisfit { variance: f64::NAN, noise: 0.0 }.beyond_noise(1.0), 0.0);
    }
}
