//! How the estimate does over short stretches: its scale as it wanders, its shape.

use crate::slam::evaluation::statistics::median;
use crate::slam::evaluation::trajectory_error::absolute_errors;
use crate::slam::evaluation::umeyama::{Alignment, umeyama};
use crate::slam::trajectory::StampedPose;

/// Matches of a window whose scale is measured: 3 s at 30 Hz, long enough for a walk to fix it.
pub const SCALE_WINDOW: usize = 100;

/// Matches of a window whose shape is measured: 1 s at 30 Hz, too short for drift to show.
pub const SHAPE_WINDOW: usize = 30;

/// Index of the first match and Sim(3) scale of each whole window of [`SCALE_WINDOW`] consecutive
/// matches; windows that stand still have no scale and are left out.
pub fn scale_windows(estimate: &[StampedPose], truth: &[StampedPose]) -> Vec<(usize, f64)> {
    let windows = estimate.chunks_exact(SCALE_WINDOW).zip(truth.chunks_exact(SCALE_WINDOW));
    let scale = |(i, (e, t)): (usize, (&[StampedPose], &[StampedPose]))| {
        umeyama(e, t, Alignment::Sim3).ok().map(|fit| (i * SCALE_WINDOW, fit.scale))
    };
    windows.enumerate().filter_map(scale).collect()
}

/// Largest over smallest scale; `None` below two windows.
pub fn scale_ratio(window_scales: &[(usize, f64)]) -> Option<f64> {
    if window_scales.len() < 2 {
        return None;
    }
    let scales = window_scales.iter().map(|&(_, scale)| scale);
    Some(scales.clone().fold(0.0, f64::max) / scales.fold(f64::INFINITY, f64::min))
}

/// Median position error over all whole windows of [`SHAPE_WINDOW`] consecutive matches, each
/// aligned by itself; `None` where there is no window that can be aligned.
pub fn window_error(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: Alignment,
) -> Option<f64> {
    let windows = estimate.chunks_exact(SHAPE_WINDOW).zip(truth.chunks_exact(SHAPE_WINDOW));
    let errors = windows
        .filter_map(|(e, t)| umeyama(e, t, alignment).ok().map(|fit| absolute_errors(e, t, &fit)));
    median(&errors.flatten().collect::<Vec<_>>())
}
