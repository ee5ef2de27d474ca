//! The keyframes' depth against the source's true depth.

use crate::capture::source::FrameSource;
use crate::capture::source_error::SourceError;
use crate::service::results::record::RunRecord;
use crate::slam::evaluation::depth_error::{DepthErrors, DepthStatistics, KeyframeDepth};
use crate::slam::keyframe::{Keyframe, MapState};

/// How good the depth maps are.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthEvaluation {
    /// Statistics over all keyframes with true depth; `None` where there is none.
    pub statistics: Option<DepthStatistics>,
    /// What the depth of each has in common, of all keyframes that have true depth.
    pub keyframes: Vec<KeyframeDepth>,
}

/// Compares every established keyframe that has true depth.
pub fn evaluate_depth(
    record: &RunRecord,
    source: &mut dyn FrameSource,
) -> Result<DepthEvaluation, SourceError> {
    let mut errors = DepthErrors::default();
    for keyframe in record.map.keyframes.iter().filter(|k| is_evaluated(k)) {
        let true_depth = match source.depth_at(keyframe.capture_nanos) {
            // One damaged file is no reason to lose the results.
            Err(error) if error.is_passing() => {
                tracing::warn!("a keyframe is not compared with its true depth: {error}");
                None
            }
            depth => depth?,
        };
        if let Some(true_depth) = true_depth {
            errors.add(keyframe, &true_depth, record.depth_scale);
        }
    }
    Ok(DepthEvaluation { statistics: errors.statistics(), keyframes: errors.into_keyframes() })
}

/// Whether a keyframe's depth is proven and still held.
fn is_evaluated(keyframe: &Keyframe) -> bool {
    keyframe.map_state == MapState::Established && !keyframe.points.is_empty()
}
