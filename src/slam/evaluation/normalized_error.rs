//! Pose errors against the reported covariance: normalised estimation errors squared (NEES).
//!
//! e = log(T_est T_true⁻¹), T = current_from_keyframe with its translation in keyframe units. With a correct covariance
//! eᵀ Σ⁻¹ e is χ² distributed: mean 6, and 3 for translation or rotation alone, and below 12.6 in 95 % of the frames.
//! The same for `map_from_camera`, whose errors are its left increments.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3, Vector6};

use crate::slam::evaluation::association::nearest;
use crate::slam::evaluation::statistics::median;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::pose::{PoseEstimate, full_covariance};
use crate::slam::trajectory::StampedPose;

/// The 95 % quantile of χ²₆.
pub const CHI_SQUARE_BOUND: f64 = 12.6;

/// Frames on a keyframe below which the fit of its scale would absorb their error.
pub(super) const MIN_FRAMES: usize = 5;

/// Normalised errors over many frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormalizedErrors {
    /// Frames compared.
    pub frames: usize,
    /// Mean over all six unknowns; 6 is right.
    pub mean: f64,
    /// Median over all six; 5.3 is right.
    pub median: f64,
    /// Mean of the translation alone; 3 is right.
    pub translation: f64,
    /// Mean of the rotation alone; 3 is right.
    pub rotation: f64,
    /// Share of the frames below [`CHI_SQUARE_BOUND`].
    pub below_bound: f64,
}

impl NormalizedErrors {
    /// Statistics over the (all, translation, rotation) errors of each frame; `None` for no frames.
    pub fn of(errors: &[[f64; 3]]) -> Option<Self> {
        let mean = |part: usize| errors.iter().map(|e| e[part]).sum::<f64>() / errors.len() as f64;
        let all: Vec<f64> = errors.iter().map(|error| error[0]).collect();
        let below = all.iter().filter(|&&error| error < CHI_SQUARE_BOUND).count();
        Some(Self {
            frames: errors.len(),
            median: median(&all)?,
            mean: mean(0),
            translation: mean(1),
            rotation: mean(2),
            below_bound: below as f64 / errors.len() as f64,
        })
    }
}

/// eᵀ Σ⁻¹ e of (all six, translation, rotation) for an error (translation, rotation) and the upper triangle, row by
/// row, of its covariance; `None` where a block cannot be inverted.
pub fn normalized(error: &Vector6<f64>, covariance: &[f64; 21]) -> Option<[f64; 3]> {
    let covariance = full_covariance(covariance);
    let all = error.dot(&(covariance.try_inverse()? * error));
    let part = |start: usize| {
        let block = covariance.fixed_view::<3, 3>(start, start).into_owned();
        let error = error.fixed_rows::<3>(start).into_owned();
        Some(error.dot(&(block.try_inverse()? * error)))
    };
    let errors = [all, part(0)?, part(3)?];
    errors.iter().all(|error| error.is_finite()).then_some(errors)
}

/// Normalised errors of `estimates` (tracked frames of one epoch), whose keyframes are given as (id, stamp), against
/// `truth`. The length of each keyframe's unit is the one that fits the true translations best in the least-squares
/// sense; keyframes with fewer than five frames are left out. `None` where nothing can be compared.
pub fn normalized_errors(
    estimates: &[&PoseEstimate],
    keyframes: &[(u64, i64)],
    truth: &[StampedPose],
    max_difference_nanos: i64,
) -> Option<NormalizedErrors> {
    let true_pose = |nanos: i64| {
        nearest(truth, nanos, max_difference_nanos).map(|index| truth[index].world_from_camera)
    };
    let mut by_keyframe: BTreeMap<u64, Vec<(&PoseEstimate, SE3)>> = BTreeMap::new();
    let places: BTreeMap<u64, SE3> =
        keyframes.iter().filter_map(|&(id, nanos)| Some((id, true_pose(nanos)?))).collect();
    for &estimate in estimates {
        let place = places.get(&estimate.keyframe_id).copied();
        if let (Some(keyframe), Some(camera)) = (place, true_pose(estimate.capture_nanos)) {
            let frames = by_keyframe.entry(estimate.keyframe_id).or_default();
            frames.push((estimate, camera.inverse() * keyframe));
        }
    }
    let of_keyframe = |frames: &Vec<(&PoseEstimate, SE3)>| {
        let unit = unit_length(frames).filter(|_| frames.len() >= MIN_FRAMES);
        let errors = frames.iter().filter_map(|(estimate, current_from_keyframe)| {
            let mut true_pose = *current_from_keyframe;
            true_pose.translation /= unit?;
            let error = (estimate.keyframe_from_camera.inverse() * true_pose.inverse()).log();
            normalized(&error, &estimate.covariance)
        });
        errors.collect::<Vec<_>>()
    };
    let errors: Vec<[f64; 3]> = by_keyframe.values().flat_map(of_keyframe).collect();
    NormalizedErrors::of(&errors)
}

/// Normalised errors of the published `map_from_camera` of `estimates` (tracked frames of one epoch) against `truth` in
/// the map: rotated by the mean of the rotations between the two, then scaled and translated by least squares on the
/// positions. `None` where nothing can be compared.
pub fn map_normalized_errors(
    estimates: &[&PoseEstimate],
    truth: &[StampedPose],
    max_difference_nanos: i64,
) -> Option<NormalizedErrors> {
    let matched = estimates.iter().filter_map(|estimate| {
        let index = nearest(truth, estimate.capture_nanos, max_difference_nanos)?;
        let exact = truth[index].world_from_camera;
        Some((estimate.map_from_camera, exact, estimate.map_covariance))
    });
    let matched: Vec<(SE3, SE3, [f64; 21])> = matched.collect();
    let map_from_truth = similarity(matched.iter().map(|of| (of.0, of.1)))?;
    let errors = matched.iter().filter_map(|(found, exact, covariance)| {
        let exact = map_from_truth.transform_pose(exact);
        normalized(&(exact * found.inverse()).log(), covariance)
    });
    NormalizedErrors::of(&errors.collect::<Vec<_>>())
}

/// `found_from_exact` of poses of one camera. Positions alone leave the rotation about a straight path open, and rotate
/// the map by a multiple of their errors over its length, far beyond the uncertainty of the rotations.
fn similarity(poses: impl Iterator<Item = (SE3, SE3)> + Clone) -> Option<Sim3> {
    let count = poses.clone().count() as f64;
    let turned = |(found, exact): (SE3, SE3)| (found * exact.inverse()).rotation_matrix();
    let svd = poses.clone().map(turned).sum::<Matrix3<f64>>().svd(true, true);
    let rotation = Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
    let means = poses.clone().fold([Vector3::zeros(); 2], |[one, other], (found, exact)| {
        [one + found.translation / count, other + exact.translation / count]
    });
    let (mut product, mut squared) = (0.0, 0.0);
    for (found, exact) in poses {
        let exact = rotation * (exact.translation - means[1]);
        product += exact.dot(&(found.translation - means[0]));
        squared += exact.norm_squared();
    }
    let scale = product / squared;
    let translation = means[0] - rotation * means[1] * scale;
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Sim3::new(SE3 { rotation, translation }, scale)).filter(Sim3::is_valid)
}

/// Length of a keyframe unit in the truth's unit: s of min Σ |s t_est − t_true|²; `None` where it is not positive.
pub(super) fn unit_length(frames: &[(&PoseEstimate, SE3)]) -> Option<f64> {
    let (mut product, mut squared) = (0.0, 0.0);
    for (estimate, current_from_keyframe) in frames {
        let estimated = estimate.keyframe_from_camera.inverse().translation;
        product += estimated.dot(&current_from_keyframe.translation);
        squared += estimated.norm_squared();
    }
    let unit = product / squared;
    (unit.is_finite() && unit > 0.0).then_some(unit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::alignment::scene::Noise;
    use crate::slam::frame::FrameView;
    use crate::slam::pose::TrackingState;

    /// Length of a keyframe unit in metres.
    const UNIT_M: f64 = 2.5;
    const STD_DEV: [f64; 6] = [3e-3, 2e-3, 4e-3, 1e-3, 2e-3, 1e-3];

    fn covariance(factor: f64) -> [f64; 21] {
        let mut triangle = [0.0; 21];
        let mut index = 0;
        for row in 0..6 {
            triangle[index] = factor * STD_DEV[row] * STD_DEV[row];
            index += 6 - row;
        }
        triangle
    }

    /// Truth, and estimates with errors of the standard deviations on keyframes of twenty frames each.
    fn run(keyframes: u64) -> (Vec<StampedPose>, Vec<PoseEstimate>, Vec<(u64, i64)>) {
        let mut noise = Noise(3);
        let true_pose = |i: u64| {
            let t = i as f64 * 0.1;
            SE3::exp(&Vector6::new(0.3 * t, 0.2 * t.sin(), 0.1 * t, 0.05 * t.sin(), 0.02 * t, 0.0))
        };
        let nanos = |i: u64| i as i64 * 33_000_000;
        let frames = 20 * keyframes;
        let truth = (0..frames)
            .map(|i| StampedPose { nanos: nanos(i), world_from_camera: true_pose(i) })
            .collect();
        let estimate = |i: u64| {
            let mut exact = true_pose(i).inverse() * true_pose(i / 20 * 20);
            exact.translation /= UNIT_M;
            let error = Vector6::from_fn(|row, _| STD_DEV[row] * noise.normal());
            let frame = FrameView {
                sequence: i,
                capture_nanos: nanos(i),
                exposure_nanos: 0,
                width: 0,
                height: 0,
                pixels: &[],
            };
            PoseEstimate {
                keyframe_id: i / 20,
                state: TrackingState::Tracking,
                keyframe_from_camera: (SE3::exp(&error) * exact).inverse(),
                covariance: covariance(1.0),
                ..PoseEstimate::unknown(&frame)
            }
        };
        let estimates = (0..frames).map(estimate).collect();
        (truth, estimates, (0..keyframes).map(|id| (id, nanos(20 * id))).collect())
    }

    #[test]
    fn errors_of_the_reported_size_have_a_mean_of_six() {
        let (truth, mut estimates, keyframes) = run(40);
        let measure = |estimates: &[PoseEstimate], truth: &[StampedPose]| {
            let estimates: Vec<&PoseEstimate> = estimates.iter().collect();
            normalized_errors(&estimates, &keyframes, truth, 1_000_000)
        };
        let errors = measure(&estimates, &truth).unwrap();
        assert_eq!(errors.frames, 800);
        assert!((errors.mean - 6.0).abs() < 0.5, "{errors:?}");
        assert!((errors.median - 5.35).abs() < 0.5, "{errors:?}");
        assert!((errors.translation - 3.0).abs() < 0.3, "{errors:?}");
        assert!((errors.rotation - 3.0).abs() < 0.3, "{errors:?}");
        assert!((errors.below_bound - 0.95).abs() < 0.03, "{errors:?}");
        estimates.iter_mut().for_each(|estimate| estimate.covariance = covariance(0.25));
        assert!((measure(&estimates, &truth).unwrap().mean - 24.0).abs() < 2.0);
        assert_eq!(measure(&estimates, &[]), None);
        estimates.iter_mut().for_each(|estimate| estimate.covariance = [0.0; 21]);
        assert_eq!(measure(&estimates, &truth), None, "no covariance, no norm");
    }

    #[test]
    fn map_pose_errors_have_a_mean_of_six_wherever_the_map_lies() {
        let (truth, mut estimates, _) = run(40);
        let twist = Vector6::new(4.0, -2.0, 1.0, 0.5, -1.0, 0.3);
        let map_from_truth = Sim3::new(SE3::exp(&twist), 0.4);
        let mut noise = Noise(5);
        for (estimate, exact) in estimates.iter_mut().zip(&truth) {
            let error = Vector6::from_fn(|row, _| STD_DEV[row] * noise.normal());
            estimate.map_from_camera = SE3::exp(&error).inverse()
                * map_from_truth.transform_pose(&exact.world_from_camera);
            estimate.map_covariance = covariance(1.0);
        }
        let measure = |estimates: &[PoseEstimate], truth: &[StampedPose]| {
            let estimates: Vec<&PoseEstimate> = estimates.iter().collect();
            map_normalized_errors(&estimates, truth, 1_000_000)
        };
        let errors = measure(&estimates, &truth).unwrap();
        assert_eq!(errors.frames, 800);
        assert!((errors.mean - 6.0).abs() < 0.5, "{errors:?}");
        estimates.iter_mut().for_each(|estimate| estimate.map_covariance = covariance(0.25));
        assert!((measure(&estimates, &truth).unwrap().mean - 24.0).abs() < 2.0);
        assert_eq!(measure(&estimates, &[]), None);
        assert_eq!(measure(&estimates[..1], &truth), None, "one place has no scale");
    }
}
