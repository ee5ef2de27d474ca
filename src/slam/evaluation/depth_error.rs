//! Semi-dense depth against true depth, and the reported variances against the errors made.

use serde::{Deserialize, Serialize};

use crate::slam::evaluation::depth_modes::DepthModes;
use crate::slam::evaluation::statistics::{largest_over_smallest, median};
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;

/// Where a keyframe's scale comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthScale {
    /// The median ratio of true to estimated depth: the map is not metric.
    #[default]
    MedianRatio,
    /// The keyframe's pose: the given poses were in metres.
    Given,
}

/// Errors common to the whole of one keyframe's depth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct KeyframeDepth {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Its stamp, nanoseconds.
    pub capture_nanos: i64,
    /// Map units per true metre: the same for every keyframe of a map without scale drift.
    pub units_per_metre: f64,
    /// Relative depth error per unit of the ray coordinate along columns, along rows, and per unit of ln d (relief), as
    /// [`DepthModes`] defines them; `None` with too few points.
    pub modes: Option<[f64; 3]>,
}

/// Ratio of the largest to the smallest map unit of the keyframes; `None` for fewer than two.
pub fn depth_scale_ratio(keyframes: &[KeyframeDepth]) -> Option<f64> {
    largest_over_smallest(keyframes.iter().map(|of| of.units_per_metre))
}

/// Depth errors over the pixels of one or more keyframes that have true depth.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthErrors {
    /// The common errors of each keyframe that was compared, in their order.
    pub keyframes: Vec<KeyframeDepth>,
    /// `|z·s − z_true| / z_true`.
    relative_error: Vec<f64>,
    /// σ/d as reported.
    relative_std_dev: Vec<f64>,
    /// |d − d_true| / σ.
    whitened_error: Vec<f64>,
    /// Magnitudes of the common errors over their standard deviations, of each keyframe that has enough points.
    whitened_modes: Vec<[f64; 3]>,
    /// Points, with or without true depth.
    points: usize,
    /// Pixels of all keyframes.
    pixels: usize,
}

/// Statistics of depth errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthStatistics {
    /// Pixels compared.
    pub compared: usize,
    /// Median of `|z·s − z_true| / z_true` over all pixels with depth.
    pub relative_error_median: f64,
    /// The same over the half with the smallest σ/d.
    pub relative_error_median_best_half: f64,
    /// Share of the pixels whose inverse depth is within 1, 2 and 3 reported σ of the truth.
    pub coverage: [f64; 3],
    /// Share of the keyframes' pixels that have depth.
    pub density: f64,
    /// Medians over the keyframes of the absolute tilt of depth along columns and rows and of the absolute error of its
    /// relief, as [`DepthModes`] defines them; `None` where no keyframe has enough points.
    pub modes: Option<[f64; 3]>,
    /// The same, divided by the standard deviation that each keyframe reports: 0.67 is right, more is overconfident.
    pub whitened_modes: Option<[f64; 3]>,
}

impl DepthErrors {
    /// Adds the points of one keyframe. `true_depth` is in metres, 0 or not finite where unknown, rectified like the
    /// keyframe; an image of another size adds nothing.
    pub fn add(&mut self, keyframe: &Keyframe, true_depth: &Image<f32>, scale: DepthScale) {
        let (width, height) = (true_depth.width(), true_depth.height());
        if (width, height) != (keyframe.intrinsics.width, keyframe.intrinsics.height) {
            return;
        }
        self.points += keyframe.points.len();
        self.pixels += width * height;
        let compared: Vec<Compared> = keyframe
            .points
            .iter()
            .filter(|p| usize::from(p.u) < width && usize::from(p.v) < height)
            .filter_map(|p| {
                let z_true = f64::from(true_depth.at(usize::from(p.u), usize::from(p.v)));
                let d = f64::from(p.inverse_depth);
                let sigma = f64::from(p.variance).sqrt();
                let usable = z_true > 0.0 && z_true.is_finite() && d > 0.0 && sigma.is_finite();
                usable.then_some(Compared { z_true, d, sigma })
            })
            .collect();
        let Some(s) = metres_per_unit(keyframe, &compared, scale) else { return };
        let modes = DepthModes::of(keyframe, true_depth, s);
        self.keyframes.push(KeyframeDepth {
            keyframe_id: keyframe.keyframe_id,
            capture_nanos: keyframe.capture_nanos,
            units_per_metre: keyframe.map_from_keyframe.scale / s,
            modes: modes.map(|of| [of.column, of.row, of.relief]),
        });
        if let Some(modes) = modes {
            let (errors, std_devs) = (modes.magnitudes(), keyframe.mode_covariance.std_devs());
            let whitened = std::array::from_fn(|mode| errors[mode] / std_devs[mode]);
            // A keyframe that reports no uncertainty, such as one with a sensor's depth, is left out here.
            self.whitened_modes.extend(whitened.iter().all(|e| e.is_finite()).then_some(whitened));
        }
        for Compared { z_true, d, sigma } in compared {
            self.relative_error.push((s / d - z_true).abs() / z_true);
            self.relative_std_dev.push(sigma / d);
            // In keyframe units the true inverse depth is s / z_true.
            self.whitened_error.push((d - s / z_true).abs() / sigma.max(f64::MIN_POSITIVE));
        }
    }

    /// The statistics; `None` where nothing could be compared.
    pub fn statistics(&self) -> Option<DepthStatistics> {
        let compared = self.relative_error.len();
        let mut by_std_dev: Vec<usize> = (0..compared).collect();
        by_std_dev.sort_by(|&i, &j| self.relative_std_dev[i].total_cmp(&self.relative_std_dev[j]));
        let best: Vec<f64> =
            by_std_dev[..compared.div_ceil(2)].iter().map(|&i| self.relative_error[i]).collect();
        let within = |sigmas: f64| {
            let inside = self.whitened_error.iter().filter(|&&e| e <= sigmas).count();
            inside as f64 / compared as f64
        };
        let modes = self.keyframes.iter().filter_map(|of| of.modes);
        let modes: Vec<[f64; 3]> = modes.map(|of| of.map(f64::abs)).collect();
        Some(DepthStatistics {
            compared,
            relative_error_median: median(&self.relative_error)?,
            relative_error_median_best_half: median(&best)?,
            coverage: [within(1.0), within(2.0), within(3.0)],
            density: self.points as f64 / self.pixels as f64,
            modes: medians(&modes),
            whitened_modes: medians(&self.whitened_modes),
        })
    }
}

/// Median of each of three figures over all keyframes.
fn medians(figures: &[[f64; 3]]) -> Option<[f64; 3]> {
    let of = |mode: usize| median(&figures.iter().map(|modes| modes[mode]).collect::<Vec<_>>());
    Some([of(0)?, of(1)?, of(2)?])
}

/// One pixel: true depth (metres), estimated inverse depth and its σ (keyframe units).
struct Compared {
    z_true: f64,
    d: f64,
    sigma: f64,
}

/// Metres per keyframe unit.
fn metres_per_unit(keyframe: &Keyframe, compared: &[Compared], scale: DepthScale) -> Option<f64> {
    match scale {
        DepthScale::Given => Some(keyframe.map_from_keyframe.scale),
        DepthScale::MedianRatio => {
            median(&compared.iter().map(|c| c.z_true * c.d).collect::<Vec<_>>())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::DepthPoint;

    fn keyframe(points: Vec<DepthPoint>, scale: f64) -> Keyframe {
        Keyframe::at(
            Sim3::new(SE3::identity(), scale),
            Intrinsics { fx: 20.0, fy: 20.0, cx: 10.0, cy: 10.0, width: 20, height: 20 },
            points,
            vec![0; 400],
        )
    }

    fn point(u: u16, inverse_depth: f32, variance: f32) -> DepthPoint {
        DepthPoint { u, v: 3, inverse_depth, variance, intensity: 0.0 }
    }

    #[test]
    fn errors_match_values_computed_by_hand() {
        // True depth 4 m everywhere, unit 2 m: the right inverse depth is 0.5.
        let truth = Image::filled(20, 20, 4.0f32);
        let points = vec![
            point(0, 0.5, 0.01),
            point(1, 0.5, 0.01),
            point(2, 0.5, 0.01),
            point(3, 0.625, 0.01), // z = 3.2 m: 20 % off, 1.25 σ
            point(4, 1.0, 0.04),   // z = 2 m: 50 % off, 2.5 σ
            point(500, 1.0, 0.04), // outside
        ];
        for scale in [DepthScale::MedianRatio, DepthScale::Given] {
            let mut errors = DepthErrors::default();
            errors.add(&keyframe(points.clone(), 2.0), &truth, scale);
            let s = errors.statistics().unwrap();
            assert_eq!(s.compared, 5);
            assert!(s.relative_error_median < 1e-9);
            // The smallest σ/d are 0.16 (20 % off) and two of the three of 0.2.
            assert!(s.relative_error_median_best_half < 1e-9);
            assert_eq!(s.coverage, [0.6, 0.8, 1.0]);
            assert!((s.density - 6.0 / 400.0).abs() < 1e-12);
            let [of] = errors.keyframes[..] else { panic!("one keyframe") };
            assert!((of.units_per_metre - 1.0).abs() < 1e-9 && of.modes.is_none(), "{of:?}");
        }
        let mut errors = DepthErrors::default();
        errors.add(&keyframe(points, 1.0), &truth, DepthScale::Given);
        assert!((errors.statistics().unwrap().relative_error_median - 0.5).abs() < 1e-6);
    }

    #[test]
    fn scale_drift_shows_in_the_ratio_of_the_map_units() {
        let truth = Image::filled(20, 20, 4.0f32);
        let mut errors = DepthErrors::default();
        for unit in [2.0, 2.2, 1.6] {
            errors.add(&keyframe(vec![point(0, 0.5, 0.01)], unit), &truth, DepthScale::MedianRatio);
        }
        let keyframes = errors.keyframes;
        assert!((depth_scale_ratio(&keyframes).unwrap() - 2.2 / 1.6).abs() < 1e-9);
        assert!((keyframes[1].units_per_metre - 1.1).abs() < 1e-9);
        assert_eq!(depth_scale_ratio(&keyframes[..1]), None);
    }

    #[test]
    fn pixels_without_truth_and_invalid_values_are_left_out() {
        let mut truth = Image::filled(20, 20, 0.0f32);
        truth.pixels_mut()[3 * 20] = f32::NAN;
        truth.pixels_mut()[3 * 20 + 1] = 2.0;
        let points = vec![point(0, 1.0, 0.1), point(1, f32::NAN, 0.1), point(2, 0.5, 0.1)];
        let mut errors = DepthErrors::default();
        errors.add(&keyframe(points, 1.0), &truth, DepthScale::MedianRatio);
        assert_eq!(errors.statistics(), None);
        errors.add(
            &keyframe(vec![point(1, 0.5, 0.1)], 1.0),
            &Image::filled(4, 4, 2.0),
            DepthScale::Given,
        );
        assert_eq!(errors.statistics(), None);
    }
}
