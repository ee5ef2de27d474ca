//! Velocity errors against the reported covariance: normalised estimation errors squared, as for poses.
//!
//! The true velocity at a frame's stamp is the mean of those over the interval before it and over an equally long one
//! after it, each log(T₀⁻¹ T₁)/Δt of true poses in the camera's axes: the interval before alone, which is what is
//! estimated, would hide the acceleration up to the stamp. Its linear part is divided by the length of a world unit,
//! one per keyframe: a velocity does not contain the error of the scale, just as a pose on a keyframe does not.

use std::collections::BTreeMap;

use nalgebra::Vector6;

use crate::slam::evaluation::association::nearest;
use crate::slam::evaluation::normalized_error::{
    MIN_FRAMES, NormalizedErrors, normalized, unit_length,
};
use crate::slam::geometry::se3::SE3;
use crate::slam::pose::PoseEstimate;
use crate::slam::trajectory::StampedPose;

/// Normalised errors of the velocities of `estimates` (tracked frames of one epoch, in order), whose keyframes are
/// given as (id, stamp), against `truth`; keyframes with fewer than five frames are left out. `None` where nothing can
/// be compared.
pub fn velocity_normalized_errors(
    estimates: &[&PoseEstimate],
    keyframes: &[(u64, i64)],
    truth: &[StampedPose],
    max_difference_nanos: i64,
) -> Option<NormalizedErrors> {
    let at = |nanos: i64| nearest(truth, nanos, max_difference_nanos).map(|index| truth[index]);
    let units = world_units(estimates, keyframes, |nanos| Some(at(nanos)?.world_from_camera));
    let error = |pair: &[&PoseEstimate]| {
        let [before, now] = pair else { return None };
        let velocity = now.velocity?;
        let interval = now.capture_nanos.checked_sub(before.capture_nanos)?;
        let after = at(now.capture_nanos.checked_add(interval)?)?;
        let (before, at_stamp) = (at(before.capture_nanos)?, at(now.capture_nanos)?);
        let exact = 0.5 * (true_velocity(&before, &at_stamp)? + true_velocity(&at_stamp, &after)?);
        let mut error = -exact;
        let mut linear = error.fixed_rows_mut::<3>(0);
        linear /= *units.get(&now.keyframe_id)?;
        linear += velocity.linear;
        let mut angular = error.fixed_rows_mut::<3>(3);
        angular += velocity.angular;
        normalized(&error, &velocity.covariance)
    };
    NormalizedErrors::of(&estimates.windows(2).filter_map(error).collect::<Vec<_>>())
}

/// Units and radians per second; `None` for equal stamps.
fn true_velocity(before: &StampedPose, now: &StampedPose) -> Option<Vector6<f64>> {
    let nanos = now.nanos.checked_sub(before.nanos).filter(|&nanos| nanos > 0)?;
    Some((before.world_from_camera.inverse() * now.world_from_camera).log() / (nanos as f64 * 1e-9))
}

/// Length of a world unit in the truth's, on each keyframe: that of a keyframe unit over its number of world units.
fn world_units(
    estimates: &[&PoseEstimate],
    keyframes: &[(u64, i64)],
    true_pose: impl Fn(i64) -> Option<SE3>,
) -> BTreeMap<u64, f64> {
    let mut by_keyframe: BTreeMap<u64, Vec<&PoseEstimate>> = BTreeMap::new();
    for estimate in estimates {
        by_keyframe.entry(estimate.keyframe_id).or_default().push(estimate);
    }
    let mut steps: BTreeMap<u64, Vec<[&PoseEstimate; 2]>> = BTreeMap::new();
    for pair in estimates.windows(2) {
        let &[before, now] = pair else { continue };
        if before.keyframe_id == now.keyframe_id {
            steps.entry(now.keyframe_id).or_default().push([before, now]);
        }
    }
    let unit = |&(id, nanos): &(u64, i64)| {
        let frames = by_keyframe.get(&id).filter(|frames| frames.len() >= MIN_FRAMES)?;
        let keyframe = true_pose(nanos)?;
        let known = frames.iter().filter_map(|estimate| {
            Some((*estimate, true_pose(estimate.capture_nanos)?.inverse() * keyframe))
        });
        let in_truth = unit_length(&known.collect::<Vec<_>>())?;
        Some((id, in_truth / world_units_of(steps.get(&id)?)?))
    };
    keyframes.iter().filter_map(unit).collect()
}

/// World units per keyframe unit, from the camera's motion in `steps` on that keyframe: within a visit. Between two
/// visits the world may have drifted.
fn world_units_of(steps: &[[&PoseEstimate; 2]]) -> Option<f64> {
    let length = |of: fn(&PoseEstimate) -> &SE3| {
        let moved =
            |[before, now]: &[&PoseEstimate; 2]| of(now).translation - of(before).translation;
        steps.iter().map(|step| moved(step).norm_squared()).sum::<f64>().sqrt()
    };
    let units =
        length(|frame| &frame.world_from_camera) / length(|frame| &frame.keyframe_from_camera);
    (units.is_finite() && units > 0.0).then_some(units)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::slam::alignment::scene::Noise;
    use crate::slam::frame::FrameView;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::pose::Velocity;

    /// Lengths of a world unit in metres, and of the units of two keyframes in world units.
    const WORLD_M: f64 = 0.4;
    const UNITS: [f64; 2] = [1.0, 3.0];
    const STD_DEV: [f64; 6] = [3e-2, 2e-2, 4e-2, 1e-2, 2e-2, 1e-2];
    const FRAMES: u64 = 400;

    fn nanos(frame: u64) -> i64 {
        frame as i64 * 40_000_000
    }

    fn exact(frame: u64) -> SE3 {
        let t = frame as f64 * 0.04;
        SE3::exp(&Vector6::new(0.3 * t, 0.2 * t.sin(), 0.1 * t, 0.5 * t.sin(), 0.02 * t, 0.1))
    }

    fn covariance(factor: f64) -> [f64; 21] {
        let (mut triangle, mut index) = ([0.0; 21], 0);
        for (row, std_dev) in STD_DEV.iter().enumerate() {
            triangle[index] = factor * std_dev * std_dev;
            index += 6 - row;
        }
        triangle
    }

    /// Two hundred frames on each of two keyframes, in a world placed elsewhere.
    fn run(noise: &mut Noise) -> Vec<PoseEstimate> {
        let twist = Vector6::new(4.0, -2.0, 1.0, 0.5, -1.0, 0.3);
        let world_from_truth = Sim3::new(SE3::exp(&twist), 1.0 / WORLD_M);
        let estimate = |frame: u64| {
            let keyframe = frame * 2 / FRAMES;
            let place = |frame: u64| world_from_truth.transform_pose(&exact(frame));
            let world_from_keyframe =
                Sim3::new(place(keyframe * FRAMES / 2), UNITS[keyframe as usize]);
            let moved = |from: u64| (exact(from).inverse() * exact(from + 1)).log() / 0.04;
            let mut velocity = 0.5 * (moved(frame.saturating_sub(1)) + moved(frame));
            velocity.fixed_rows_mut::<3>(0).unscale_mut(WORLD_M);
            velocity += Vector6::from_fn(|row, _| STD_DEV[row] * noise.normal());
            let view = FrameView {
                sequence: frame,
                capture_nanos: nanos(frame),
                exposure_nanos: 0,
                width: 0,
                height: 0,
                pixels: &[],
            };
            PoseEstimate {
                keyframe_id: keyframe,
                world_from_camera: place(frame),
                keyframe_from_camera: world_from_keyframe.inverse_transform_pose(&place(frame)),
                velocity: (frame > 0).then(|| Velocity {
                    linear: velocity.fixed_rows::<3>(0).into_owned(),
                    angular: velocity.fixed_rows::<3>(3).into_owned(),
                    covariance: covariance(1.0),
                }),
                ..PoseEstimate::unknown(&view)
            }
        };
        (0..FRAMES).map(estimate).collect()
    }

    #[test]
    fn a_keyframe_revisited_after_drift_has_one_unit() {
        let mut estimates = run(&mut Noise(3));
        let to_first = exact(0).inverse() * exact(FRAMES / 2);
        for estimate in estimates.iter_mut().filter(|estimate| estimate.sequence >= FRAMES * 3 / 4)
        {
            estimate.keyframe_id = 0;
            let on_second = Sim3::new(to_first, UNITS[1] * WORLD_M);
            let first_unit = Sim3::new(SE3::identity(), UNITS[0] * WORLD_M);
            estimate.keyframe_from_camera = first_unit
                .inverse_transform_pose(&on_second.transform_pose(&estimate.keyframe_from_camera));
            estimate.world_from_camera.translation += Vector3::new(40.0, 0.0, 0.0);
        }
        let truth: Vec<_> = (0..FRAMES)
            .map(|frame| StampedPose { nanos: nanos(frame), world_from_camera: exact(frame) })
            .collect();
        let keyframes = [(0, nanos(0)), (1, nanos(FRAMES / 2))];
        let estimates: Vec<&PoseEstimate> = estimates.iter().collect();
        let errors = velocity_normalized_errors(&estimates, &keyframes, &truth, 1_000_000).unwrap();
        assert!((errors.translation - 3.0).abs() < 0.4, "{errors:?}");
    }

    #[test]
    fn errors_of_the_reported_size_have_a_mean_of_six_whatever_the_units() {
        let mut estimates = run(&mut Noise(3));
        let truth: Vec<_> = (0..FRAMES)
            .map(|frame| StampedPose { nanos: nanos(frame), world_from_camera: exact(frame) })
            .collect();
        let keyframes = [(0, nanos(0)), (1, nanos(FRAMES / 2))];
        let measure = |estimates: &[PoseEstimate], truth: &[StampedPose]| {
            let estimates: Vec<&PoseEstimate> = estimates.iter().collect();
            velocity_normalized_errors(&estimates, &keyframes, truth, 1_000_000)
        };
        let errors = measure(&estimates, &truth).unwrap();
        // The first frame has no velocity, the last has no truth after it.
        assert_eq!(errors.frames, FRAMES as usize - 2);
        assert!((errors.mean - 6.0).abs() < 0.6, "{errors:?}");
        assert!((errors.translation - 3.0).abs() < 0.4, "{errors:?}");
        assert!((errors.rotation - 3.0).abs() < 0.4, "{errors:?}");
        assert_eq!(measure(&estimates, &[]), None);
        assert_eq!(measure(&estimates[..1], &truth), None, "one frame has no velocity");
        for estimate in &mut estimates {
            if let Some(velocity) = &mut estimate.velocity {
                velocity.linear += Vector3::new(0.3, 0.0, 0.0);
            }
        }
        let wrong = measure(&estimates, &truth).unwrap();
        assert!(wrong.translation > 90.0 && wrong.rotation < 3.4, "{wrong:?}");
        estimates.iter_mut().for_each(|estimate| estimate.velocity = None);
        assert_eq!(measure(&estimates, &truth), None);
    }
}
