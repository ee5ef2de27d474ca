//! Whether the images of a run fit their calibration, as far as the residuals tell.

use crate::service::results::record::RecordedPose;
use crate::slam::evaluation::statistics::percentiles;

/// Tracked frames from which the residuals tell anything: a second of video.
const MIN_FRAMES: usize = 30;

/// Median whitened residual above which the calibration is doubted. Six recordings with their own
/// calibration have 0.72 to 1.03 and a seventh, which was not looked at when the figure was chosen, 1.30: a
/// warning that is false is worse than one that is missing. Above 1.3 are four of six with focal lengths
/// twice as long, three with half of them, and ten of twelve with another distortion.
const DOUBTED_RESIDUAL: f64 = 1.4;

/// Median over the tracked frames of the root mean square residual over its standard deviation; 1 where
/// everything is as modelled. `None` of few frames.
pub fn whitened_residual_median(poses: &[RecordedPose]) -> Option<f64> {
    let tracked = poses.iter().filter(|pose| pose.estimate.state.is_tracked());
    let residuals = tracked.map(|pose| pose.estimate.quality.whitened_rmse).filter(|r| *r > 0.0);
    let [median] = percentiles(residuals.clone(), [0.5])?;
    (residuals.count() >= MIN_FRAMES).then_some(median)
}

/// A warning where the images do not fit as they do with the right calibration.
pub fn calibration_warning(whitened_residual_median: Option<f64>) -> Option<String> {
    let residual = whitened_residual_median.filter(|residual| *residual > DOUBTED_RESIDUAL)?;
    Some(format!(
        "the images fit the map badly (whitened residual {residual:.2}, 1 is expected): check that the rig belongs to this \
         camera and image size; strong blur or a rolling shutter look the same"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_large_residuals_are_doubted() {
        assert_eq!(calibration_warning(None), None);
        assert_eq!(calibration_warning(Some(1.31)), None);
        assert!(calibration_warning(Some(1.46)).unwrap().contains("1.46"));
        assert_eq!(whitened_residual_median(&[]), None);
    }
}
