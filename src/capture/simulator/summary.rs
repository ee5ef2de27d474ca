//! Figures of a sequence: length and speed of the camera's path, and how much texture it sees.

use serde::Serialize;

use crate::slam::trajectory::StampedPose;

/// Summary of a path.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct PathSummary {
    /// Length of the path through all frames, metres.
    pub path_length_m: f64,
    /// Largest side of the axis-aligned box around the path, metres.
    pub extent_m: f64,
    /// Sum of the angles between consecutive frames, degrees.
    pub rotation_deg: f64,
    /// Path length over duration, metres per second.
    pub mean_speed_m_s: f64,
    /// Time from first to last stamp, seconds.
    pub duration_s: f64,
}

/// Summarises a trajectory.
pub fn summarize(poses: &[StampedPose]) -> PathSummary {
    let mut summary = PathSummary::default();
    let (Some(first), Some(last)) = (poses.first(), poses.last()) else { return summary };
    let (mut low, mut high) =
        (first.world_from_camera.translation, first.world_from_camera.translation);
    for pair in poses.windows(2) {
        let (from, to) = (&pair[0].world_from_camera, &pair[1].world_from_camera);
        summary.path_length_m += (to.translation - from.translation).norm();
        summary.rotation_deg += from.rotation.angle_to(&to.rotation).to_degrees();
        low = low.inf(&to.translation);
        high = high.sup(&to.translation);
    }
    summary.extent_m = (high - low).max();
    summary.duration_s = (last.nanos - first.nanos) as f64 * 1e-9;
    if summary.duration_s > 0.0 {
        summary.mean_speed_m_s = summary.path_length_m / summary.duration_s;
    }
    summary
}

/// Share of the inner pixels whose gradient (central difference, grey levels per pixel) is at least `threshold`; 0 for
/// images without inner pixels.
pub fn gradient_share(pixels: &[u8], width: usize, threshold: f64) -> f64 {
    let height = pixels.len().checked_div(width).unwrap_or(0);
    if width < 3 || height < 3 {
        return 0.0;
    }
    let mut strong = 0usize;
    for v in 1..height - 1 {
        for u in 1..width - 1 {
            let at = |u: usize, v: usize| f64::from(pixels[v * width + u]);
            let gx = 0.5 * (at(u + 1, v) - at(u - 1, v));
            let gy = 0.5 * (at(u, v + 1) - at(u, v - 1));
            strong += usize::from(gx * gx + gy * gy >= threshold * threshold);
        }
    }
    strong as f64 / ((width - 2) * (height - 2)) as f64
}
