//! Whether the images of a run fit their calibration, according to the residuals.

use crate::service::results::record::RecordedPose;
use crate::slam::evaluation::statistics::percentiles;

/// Fewest tracked frames for the residuals to be conclusive: a second of video.
const MIN_FRAMES: usize = 30;

/// Median whitened residual above which the calibration is doubted. Six recordings with their own calibration have 0.72
/// to 1.03, and a seventh, which was not used to choose the figure, 1.30: a false warning is worse than a missing one.
/// Above 1.3 are four of six with focal lengths twice as long, three with half of them, and ten of twelve with another
/// distortion.
const DOUBTED_RESIDUAL: f64 = 1.4;

/// Median over the tracked frames of the root mean square residual over its standard deviation; 1 where everything is
/// as modelled. `None` for too few frames.
pub fn whitened_residual_median(poses: &[RecordedPose]) -> Option<f64> {
    let tracked = poses.iter().filter(|pose| pose.estimate.state.is_tracked());
    let residuals = tracked.map(|pose| pose.estimate.quality.whitened_rmse).filter(|r| *r > 0.0);
    let [median] = percentiles(residuals.clone(), [0.5])?;
    (residuals.count() >= MIN_FRAMES).then_some(median)
}

/// A warning where the images do not fit as well as with the right calibration.
pub fn calibration_warning(whitened_residual_median: Option<f64>) -> Option<String> {
    let residual = whitened_residual_median.filter(|residual| *residual > DOUBTED_RESIDUAL)?;
    Some(format!(
        "the images fit the map badly (whitened residual {residual:.2}, 1 is expected): check that the rig belongs to this \
         camera and image size; strong blur or a rolling shutter has the same effect"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_large_residuals_give_a_warning() {
        assert_eq!(calibration_warning(None), None);
        assert_eq!(calibration_warning(Some(1.31)), None);
        assert!(calibration_warning(Some(1.46)).unwrap().contains("1.46"));
        assert_eq!(whitened_residual_median(&[]), None);
    }
}
