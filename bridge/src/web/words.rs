//! Poses and health as JSON, with states in words.

use nalgebra::Vector3;
use semidense::service::health::{
    ProcessState, cause, percentile_ms, scheduling_name, source, warning,
};
use semidense::slam::pose::{DegradedReason, LostReason, TrackingState};
use semidense::wire::message::HealthMessage;
use serde_json::{Value, json};

use crate::ros::axes::place_covariance;
use crate::session::Pose;

/// A tracking state and its reason in words.
pub fn state_words(state: TrackingState) -> (&'static str, &'static str) {
    match state {
        TrackingState::Initializing => {
            ("initializing", "no map yet: move the camera sideways, with texture in view")
        }
        TrackingState::Tracking => ("tracking", "the pose is accurate to its covariance"),
        TrackingState::Degraded(reason) => ("degraded", degraded_words(reason)),
        TrackingState::Lost(reason) => ("lost", lost_words(reason)),
    }
}

fn degraded_words(reason: DegradedReason) -> &'static str {
    match reason {
        DegradedReason::Budget => "the deadline passed before the finest level was solved",
        DegradedReason::LowOverlap => "few of the keyframe's points are in view",
        DegradedReason::HighResidual => {
            "the image differs from the keyframe by more than noise explains"
        }
        DegradedReason::Gap => "frames before this one are missing",
        DegradedReason::Turning => "known depth is out of view: only the rotation is tracked",
    }
}

fn lost_words(reason: LostReason) -> &'static str {
    match reason {
        LostReason::Diverged => "the alignment diverged: go back to where tracking worked",
        LostReason::TooFewInliers => "too few points match: go back to where tracking worked",
        LostReason::NoPoints => "the keyframe has no usable points",
        LostReason::UnusableFrame => "the image has no contrast, or another size than the keyframe",
        LostReason::MapRejected => "the map contradicts itself: a new one is started",
    }
}

/// A pose as JSON.
pub fn pose_json(pose: &Pose) -> Value {
    let (message, estimate) = (&pose.message, &pose.estimate);
    let (state, reason) = state_words(estimate.state);
    json!({
        "kind": "pose",
        "sequence": message.sequence,
        "t": message.capture_nanos as f64 * 1e-9,
        "epoch": message.epoch,
        "keyframe": message.keyframe_id as u32,
        "code": message.state,
        "state": state,
        "reason": reason,
        // Messages put the quaternion first; the page expects the translation first.
        "place": translation_first(&message.map_from_camera),
        "keyframe_from_camera": translation_first(&message.keyframe_from_camera),
        "covariance": position_covariance(&estimate.map_covariance, &estimate.map_from_camera.translation),
        "latency_ms": message.latency_nanos as f64 * 1e-6,
        "track_ms": message.track_nanos as f64 * 1e-6,
        "in_view": message.in_view_ratio,
        "inliers": message.inlier_ratio,
        "points": message.points,
        "map_revision": message.map_revision,
    })
}

/// Reorders a pose to translation, then quaternion.
fn translation_first([qx, qy, qz, qw, x, y, z]: &[f64; 7]) -> [f64; 7] {
    [*x, *y, *z, *qx, *qy, *qz, *qw]
}

/// Covariance xx, xy, xz, yy, yz, zz of the camera's position, from that of a left increment.
fn position_covariance(upper: &[f64; 21], position: &Vector3<f64>) -> [f64; 6] {
    let of = place_covariance(position, upper);
    [of[(0, 0)], of[(0, 1)], of[(0, 2)], of[(1, 1)], of[(1, 2)], of[(2, 2)]]
}

/// A process's health report as JSON.
pub fn health_json(process: &str, health: &HealthMessage) -> Value {
    let state = ProcessState::from_code(health.state).map_or("unknown", ProcessState::name);
    let times = |counts: &_| json!({ "p50": percentile_ms(counts, 0.5), "p99": percentile_ms(counts, 0.99), "max": percentile_ms(counts, 1.0) });
    json!({
        "process": process,
        "state": state,
        "cause": cause(health),
        "warning": warning(health),
        "source": source(health),
        "rate_hz": health.rate_hz.is_finite().then_some(health.rate_hz),
        "frames": health.frames,
        "dropped": health.dropped,
        "gaps": health.gaps,
        "refused": health.refused,
        "deadline_misses": health.deadline_misses,
        "total": health.total,
        "peak_rss_mb": health.peak_rss_bytes as f64 / f64::from(1 << 20),
        "scheduling": scheduling_name(health.scheduling),
        "memory_locked": health.memory_locked == 1,
        "latency_ms": times(&health.latency_counts),
        "latency_counts": health.latency_counts.to_vec(),
        "work_ms": times(&health.work_counts),
        "adjustments": health.adjustments,
        "adjustments_dropped": health.adjustments_dropped,
        "loops": {
            "searched": health.loop_searches,
            "closed": health.loops_closed,
            "held": health.loops_held,
            "joined": health.epochs_joined,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_about_the_origin_moves_a_distant_camera() {
        let mut upper = [0.0; 21];
        // Variance 1e-4 of the rotation about z: entry (5, 5), the last.
        upper[20] = 1e-4;
        let of = position_covariance(&upper, &Vector3::new(10.0, 0.0, 0.0));
        assert!((of[3] - 1e-2).abs() < 1e-12, "ten units away it is y that errs: {of:?}");
        assert!(of[0].abs() < 1e-12 && of[5].abs() < 1e-12);
    }
}
