//! Short stretches of an estimate: the drift of its scale, and its shape.

use crate::slam::evaluation::trajectory_error::absolute_errors;
use crate::slam::evaluation::umeyama::{TrajectoryAlignment, umeyama};
use crate::slam::trajectory::StampedPose;

/// Matches per window for the scale: 3 s at 30 Hz, long enough for a walk to determine it.
pub const SCALE_WINDOW: usize = 100;

/// Matches per window for the shape: 1 s at 30 Hz, too short for drift to show.
pub const SHAPE_WINDOW: usize = 30;

/// First matches of consecutive windows of `length` among `count` matches. Where a remainder is left, one more window
/// ends at the last match, so that the end of a run counts: it overlaps the one before, as a shorter one would tell
/// less.
fn starts(count: usize, length: usize) -> impl Iterator<Item = usize> {
    let whole = (0..count / length).map(move |i| i * length);
    let has_rest = count > length && !count.is_multiple_of(length);
    whole.chain(has_rest.then(|| count - length))
}

/// Index of the first match and Sim(3) scale of windows of [`SCALE_WINDOW`] matches up to the last one; stationary
/// windows have no scale and are left out.
pub fn scale_windows(estimate: &[StampedPose], truth: &[StampedPose]) -> Vec<(usize, f64)> {
    let scale = |first: usize| {
        let window = first..first + SCALE_WINDOW;
        let (e, t) = (estimate.get(window.clone())?, truth.get(window)?);
        umeyama(e, t, TrajectoryAlignment::Sim3).ok().map(|fit| (first, fit.scale))
    };
    starts(estimate.len(), SCALE_WINDOW).filter_map(scale).collect()
}

/// Position errors in windows of [`SHAPE_WINDOW`] matches up to the last one, each window aligned separately and each
/// match counted once; windows that cannot be aligned are left out.
pub fn shape_errors(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    alignment: TrajectoryAlignment,
) -> Vec<f64> {
    let mut errors = Vec::with_capacity(estimate.len());
    let mut counted = 0;
    for first in starts(estimate.len(), SHAPE_WINDOW) {
        let window = first..first + SHAPE_WINDOW;
        let Some((e, t)) = estimate.get(window.clone()).zip(truth.get(window.clone())) else {
            break;
        };
        if let Ok(fit) = umeyama(e, t, alignment) {
            errors.extend(absolute_errors(e, t, &fit).into_iter().skip(counted - first));
        }
        counted = window.end;
    }
    errors
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::evaluation::statistics::largest_over_smallest;
    use crate::slam::geometry::se3::SE3;

    fn ratio_of(window_scales: &[(usize, f64)]) -> Option<f64> {
        largest_over_smallest(window_scales.iter().map(|&(_, scale)| scale))
    }

    /// A walk on a spiral, `scaled` from match to match.
    fn walk(count: usize, scaled: impl Fn(usize) -> f64) -> (Vec<StampedPose>, Vec<StampedPose>) {
        let at = |i: usize, scale: f64| {
            let t = i as f64 * 0.1;
            let mut world_from_camera = SE3::identity();
            world_from_camera.translation = [t.cos(), t.sin(), 0.1 * t].into();
            world_from_camera.translation *= scale;
            StampedPose { nanos: i as i64, world_from_camera }
        };
        (0..count).map(|i| (at(i, scaled(i)), at(i, 1.0))).unzip()
    }

    #[test]
    fn the_end_of_a_run_counts_even_if_it_fills_no_window() {
        assert_eq!(starts(250, 100).collect::<Vec<_>>(), [0, 100, 150]);
        assert_eq!(starts(200, 100).collect::<Vec<_>>(), [0, 100]);
        assert_eq!(starts(99, 100).count(), 0);
        // The scale doubles in the last 50 of 250 matches: the ratio of whole windows alone is 1.
        let (estimate, truth) = walk(250, |i| if i < 200 { 1.0 } else { 2.0 });
        let ratio = ratio_of(&scale_windows(&estimate, &truth)).unwrap();
        assert!(ratio > 1.2, "{ratio}");
        // Two windows need more matches than one.
        let (estimate, truth) = walk(100, |_| 1.0);
        assert_eq!(ratio_of(&scale_windows(&estimate, &truth)), None);
    }

    #[test]
    fn every_match_counts_once_in_the_shape() {
        // The last 10 of 40 matches are off, which only a window up to the end can show.
        let off = |i: usize| if i < 30 { 1.0 } else { 1.0 + 0.1 * (i % 2) as f64 };
        let (estimate, truth) = walk(40, off);
        let errors = shape_errors(&estimate, &truth, TrajectoryAlignment::Sim3);
        assert_eq!(errors.len(), 40);
        assert!(errors[..30].iter().all(|error| *error < 1e-9), "{errors:?}");
        assert!(errors[30..].iter().all(|error| *error > 1e-4), "{errors:?}");
    }
}
