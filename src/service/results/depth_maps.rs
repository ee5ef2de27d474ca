//! The keyframes' depth against the source's true depth.

use crate::capture::source::FrameSource;
use crate::capture::source_error::SourceError;
use crate::service::results::record::RunRecord;
use crate::slam::evaluation::depth_error::DepthErrors;
use crate::slam::keyframe::{Keyframe, MapState};

/// Compares every established keyframe of the run with true depth in one epoch, which has one unit.
pub fn evaluate_depth(
    record: &RunRecord,
    epoch: Option<u32>,
    source: &mut dyn FrameSource,
) -> Result<DepthErrors, SourceError> {
    let mut errors = DepthErrors::default();
    let of_epoch = record.own_keyframes().filter(|k| Some(k.epoch) == epoch);
    for keyframe in of_epoch.filter(|k| is_evaluated(k)) {
        let true_depth = match source.depth_at(keyframe.capture_nanos) {
            // One damaged file must not cost the results.
            Err(error) if error.is_transient() => {
                tracing::warn!("skipping the depth comparison of a keyframe: {error}");
                None
            }
            depth => depth?,
        };
        if let Some(true_depth) = true_depth {
            errors.add(keyframe, &true_depth, record.depth_scale);
        }
    }
    Ok(errors)
}

/// Whether a keyframe's depth is proven and still present.
fn is_evaluated(keyframe: &Keyframe) -> bool {
    keyframe.map_state == MapState::Established && !keyframe.points.is_empty()
}
