//! Whether the images of a run fit their calibration, according to the residuals.

use crate::service::results::record::RecordedPose;
use crate::slam::evaluation::statistics::percentiles;

/// Fewest tracked frames for the residuals to be conclusive: a second of video.
const MIN_FRAMES: usize = 30;

/// Median whitened residual above which the calibration is doubted. Six recordings with their own calibration have 0.86
/// to 1.10, and one of a car at 10 Hz 1.43: a false warning is worse than a missing one. With wrong ones they have up to
/// 1.53.
const DOUBTED_RESIDUAL: f64 = 1.5;

/// Median over the tracked frames of the root mean square residual over its standard deviation; 1 where everything is
/// as modelled. `None` for too few frames.
pub fn whitened_residual_median(poses: &[RecordedPose]) -> Option<f64> {
    let tracked = poses.iter().filter(|pose| pose.estimate.state.is_tracked());
    let residuals = tracked.map(|pose| pose.estimate.quality.whitened_rmse).filter(|r| *r > 0.0);
    let [median] = percentiles(residuals.clone(), [0.5])?;
    (residuals.count() >= MIN_FRAMES).then_some(median)
}

/// A warning where the images do not fit as well as with the right calibration: by the residual, or by maps that
/// contradicted themselves. That is none in 36 replays of six recordings with their own calibration, and at least one in
/// eight of 48 with wrong ones.
pub fn calibration_warning(
    whitened_residual_median: Option<f64>,
    num_rejections: usize,
) -> Option<String> {
    let residual = whitened_residual_median.filter(|residual| *residual > DOUBTED_RESIDUAL);
    let found = match (residual, num_rejections) {
        (Some(residual), _) => {
            format!("the images fit the map badly (whitened residual {residual:.2}, 1 is expected)")
        }
        (None, 0) => return None,
        (None, 1) => "the map contradicted itself and was begun again".to_owned(),
        (None, times) => format!("the map contradicted itself {times} times and was begun again"),
    };
    Some(format!(
        "{found}: check that the rig belongs to this camera and image size; strong blur or a rolling shutter has the \
         same effect"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_large_residuals_and_contradictions_give_a_warning() {
        assert_eq!(calibration_warning(None, 0), None);
        assert_eq!(calibration_warning(Some(1.46), 0), None);
        assert!(calibration_warning(Some(1.53), 0).unwrap().contains("1.53"));
        assert!(calibration_warning(Some(1.1), 1).unwrap().contains("itself and was"));
        assert!(calibration_warning(None, 2).unwrap().contains("itself 2 times"));
        assert_eq!(whitened_residual_median(&[]), None);
    }
}
