//! Smoothing of a pixel's depth over the neighbouring pixels.
//!
//! A pixel's own noise is averaged over the neighbours that may be on the same surface; errors common to all of them
//! remain. Once only, for depth that is final: a mean is no observation.

use crate::slam::keyframe::DepthPoint;

/// Standard deviation of the change of inverse depth from a pixel to the next on a slanted surface, relative to it.
const SLANT: f64 = 0.005;
/// Neighbours whose inverse depth differs by more than this many standard deviations are on another surface.
const MAX_DEVIATIONS: f64 = 2.0;
/// Neighbours are at most this far in columns and in rows …
const REACH_PX: usize = 2;
/// … and this far in all, squared: the twenty around a pixel, without the corners.
const MAX_SQUARED_DISTANCE: usize = 5;
/// Adjacent pixels that err together: their patterns share most samples.
const PIXELS_TOGETHER: f64 = 3.0;

/// The estimate of a pixel's inverse depth from that pixel alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Single {
    /// Inverse depth.
    pub inverse_depth: f64,
    /// Part of the variance that is the pixel's own.
    pub own: f64,
    /// Part that it shares with neighbouring pixels.
    pub common: f64,
    /// Upper bound of the variance of both.
    pub most: f64,
}

/// Points and the separate estimate of each, in the same order.
pub struct Neighbourhood<'a> {
    points: &'a [DepthPoint],
    singles: &'a [Single],
    places: Places,
}

impl<'a> Neighbourhood<'a> {
    /// Creates the neighbourhood of points in an image of this width.
    pub fn new(points: &'a [DepthPoint], singles: &'a [Single], width: usize) -> Self {
        Self { points, singles, places: Places::new(points, width) }
    }

    /// Returns a point as the mean of itself and its neighbours in the image.
    ///
    /// A pixel at a depth edge, with neighbours on another surface, is less certain by their share: it may be on either
    /// surface.
    pub fn smoothed(&self, place: usize) -> DepthPoint {
        let (point, single) = (&self.points[place], &self.singles[place]);
        let (mut sum, mut weights, mut others, mut apart) = (0.0, 0.0, 0.0f64, 0.0);
        for (place, squared_distance) in self.places.around(point) {
            let neighbour = &self.singles[place];
            let squared = (neighbour.inverse_depth - single.inverse_depth).powi(2);
            let slant = (SLANT * single.inverse_depth).powi(2) * squared_distance;
            let weight = 1.0 / (neighbour.own + slant);
            let is_sure = weight > 0.0 && weight.is_finite();
            others += 1.0;
            if !(is_sure
                && squared <= MAX_DEVIATIONS * MAX_DEVIATIONS * (neighbour.most + single.most))
            {
                apart += 1.0;
                continue;
            }
            sum += weight * neighbour.inverse_depth;
            weights += weight;
        }
        let own = single.own.min(PIXELS_TOGETHER / weights);
        let doubt = 1.0 + apart / others;
        let variance = (own + single.common).min(single.most) * doubt * doubt;
        let inverse_depth = (sum / weights) as f32;
        let is_sane = inverse_depth > 0.0
            && inverse_depth.is_finite()
            && single.own > 0.0
            && variance > 0.0
            && variance.is_finite();
        match is_sane {
            true => DepthPoint { inverse_depth, variance: variance as f32, ..*point },
            false => *point,
        }
    }
}

/// Finds the points of a pixel and of its neighbours in a list.
struct Places {
    /// Index of each pixel's point, with a border of [`REACH_PX`], row by row; the number of points if it has none.
    places: Vec<u32>,
    stride: usize,
    num_points: u32,
    /// For a pixel and its neighbours, row by row: the offset from the first in `places`, and the squared distance in
    /// pixels.
    near: Vec<(usize, f64)>,
}

impl Places {
    fn new(points: &[DepthPoint], width: usize) -> Self {
        const SIDE: usize = 2 * REACH_PX + 1;
        let stride = width + 2 * REACH_PX;
        let rows = points.iter().map(|point| usize::from(point.v) + 1 + 2 * REACH_PX).max();
        let rows = rows.unwrap_or_default();
        let num_points = points.len() as u32;
        let mut places = vec![num_points; stride * rows];
        for (point, place) in points.iter().zip(0..) {
            if usize::from(point.u) < width {
                let row = usize::from(point.v) + REACH_PX;
                places[row * stride + usize::from(point.u) + REACH_PX] = place;
            }
        }
        let near = (0..SIDE * SIDE).filter_map(|k| {
            let (row, column) = (k / SIDE, k % SIDE);
            let squared = row.abs_diff(REACH_PX).pow(2) + column.abs_diff(REACH_PX).pow(2);
            (squared <= MAX_SQUARED_DISTANCE).then_some((row * stride + column, squared as f64))
        });
        Self { places, stride, num_points, near: near.collect() }
    }

    /// Indices of the points of a pixel and of its neighbours, with the squared distance in pixels.
    fn around(&self, point: &DepthPoint) -> impl Iterator<Item = (usize, f64)> {
        let first = usize::from(point.v) * self.stride + usize::from(point.u);
        self.near.iter().filter_map(move |&(offset, squared)| {
            let place = *self.places.get(first + offset)?;
            (place < self.num_points).then_some((place as usize, squared))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 40;

    /// A plane of 40 × 30 pixels, inverse depth 1, with noise of 1 %; its right half at inverse depth `right`.
    fn plane(right: f64) -> (Vec<DepthPoint>, Vec<Single>) {
        let at = |k: usize| (k % WIDTH, k / WIDTH);
        let points = (0..WIDTH * 30).map(|k| DepthPoint {
            u: at(k).0 as u16,
            v: at(k).1 as u16,
            inverse_depth: 1.0,
            variance: 1.0,
            ..DepthPoint::default()
        });
        let mut seed = 7u64;
        let mut noise = || {
            seed = seed
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            ((seed >> 33) as f64 / f64::from(1u32 << 31) - 0.5) * 12f64.sqrt() * 0.01
        };
        let singles = (0..WIDTH * 30).map(|k| {
            let inverse_depth = if at(k).0 < WIDTH / 2 { 1.0 } else { right } + noise();
            Single { inverse_depth, own: 1e-4, common: 1e-6, most: 1.01e-4 }
        });
        (points.collect(), singles.collect())
    }

    fn smoothed(points: &[DepthPoint], singles: &[Single], width: usize) -> Vec<DepthPoint> {
        let neighbourhood = Neighbourhood::new(points, singles, width);
        (0..points.len()).map(|place| neighbourhood.smoothed(place)).collect()
    }

    fn rms(points: &[DepthPoint], of: impl Fn(&DepthPoint) -> f64) -> f64 {
        (points.iter().map(|p| of(p).powi(2)).sum::<f64>() / points.len() as f64).sqrt()
    }

    #[test]
    fn noise_on_a_plane_is_averaged_and_common_errors_remain() {
        let (points, singles) = plane(1.0);
        let smooth = smoothed(&points, &singles, WIDTH);
        let left = rms(&smooth, |p| f64::from(p.inverse_depth) - 1.0);
        assert!((0.002..0.003).contains(&left), "{left}");
        let claimed = rms(&smooth, |p| f64::from(p.variance).sqrt());
        assert!(left < claimed && claimed < 0.01, "{left} {claimed}");
        let common = vec![Single { own: 1e-12, common: 1e-4, ..singles[0] }; points.len()];
        let kept = smoothed(&points, &common, WIDTH)[500].variance;
        assert!((kept - 1e-4).abs() < 1e-6, "{kept}");
    }

    #[test]
    fn a_depth_edge_is_preserved_and_less_certain() {
        let (points, singles) = plane(1.2);
        let smooth = smoothed(&points, &singles, WIDTH);
        let of = |side: usize| -> Vec<DepthPoint> {
            smooth.iter().filter(|p| usize::from(p.u) == side).copied().collect()
        };
        let [before, after, inside] = [WIDTH / 2 - 1, WIDTH / 2, WIDTH / 4].map(of);
        assert!(rms(&before, |p| f64::from(p.inverse_depth) - 1.0) < 0.008);
        assert!(rms(&after, |p| f64::from(p.inverse_depth) - 1.2) < 0.008);
        let sure = |points: &[DepthPoint]| rms(points, |p| f64::from(p.variance).sqrt());
        assert!(sure(&before) > 1.2 * sure(&inside), "{} {}", sure(&before), sure(&inside));
    }

    #[test]
    fn a_neighbour_without_a_valid_variance_counts_as_another_surface() {
        let (points, singles) = plane(1.0);
        let with = |single: Single| {
            let mut singles = singles.clone();
            singles[500] = single;
            smoothed(&points, &singles, WIDTH)
        };
        let expected = with(Single { inverse_depth: 100.0, ..singles[500] });
        for own in [-1e-4, -1.0, f64::NAN, f64::INFINITY] {
            let smooth = with(Single { own, ..singles[500] });
            for beside in [459, 460, 461, 499, 501, 539, 540, 541] {
                assert_eq!(smooth[beside], expected[beside], "{own} {beside}");
            }
            // With a variance of any size, its neighbours determine it; without a valid one it stays unchanged.
            assert!(own > 0.0 || smooth[500] == points[500], "{own}");
        }
    }

    #[test]
    fn an_isolated_point_keeps_its_own_estimate() {
        let (points, singles) = plane(1.0);
        let [smooth] = smoothed(&points[77..78], &singles[77..78], WIDTH)[..] else { panic!() };
        assert_eq!(smooth.inverse_depth, singles[77].inverse_depth as f32);
        assert_eq!(smooth.variance, singles[77].most as f32);
    }
}
