//! Predicts the camera's pose: constant velocity in the world, and alternatives.
//!
//! Poses are kept in the world, so that a new keyframe or refined depth does not affect them; where the map is
//! corrected they follow their keyframe.

use nalgebra::Vector6;

use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;

/// The last good pose and the velocity before it.
#[derive(Debug, Clone, Default)]
pub struct Motion {
    /// Stamp, nanoseconds, and `world_from_camera`.
    last: Option<(i64, SE3)>,
    /// Twist of `last_from_next` per interval, and the interval in nanoseconds.
    velocity: Option<(Vector6<f64>, f64)>,
    /// Frames since the last good pose, if all of them repeat its image.
    repeats: Option<u32>,
}

/// Repeats of an image during which the camera is taken to move on: as many as in a video at three times its rate. After
/// them it stands still.
const MAX_REPEATS: u32 = 2;

/// Longest extrapolation of a velocity, in intervals over which it was measured.
const LONGEST_EXTRAPOLATION: f64 = 3.0;

impl Motion {
    /// Begins a frame, which may repeat the image of the previous one.
    pub fn begin_frame(&mut self, is_repeat: bool) {
        self.repeats = self.repeats.filter(|_| is_repeat).map(|repeats| repeats.saturating_add(1));
    }

    /// Whether the frame repeats the image of the last good pose, and the camera is taken to move on.
    pub fn is_repeat(&self) -> bool {
        self.repeats.is_some_and(|repeats| (1..=MAX_REPEATS).contains(&repeats))
    }

    /// Records a good pose. That of a repeated image shows no motion, and is left out.
    pub fn observe(&mut self, nanos: i64, world_from_camera: &SE3) {
        if self.is_repeat() {
            return;
        }
        self.velocity = self.last.and_then(|(before, last)| {
            let interval = nanos.checked_sub(before).filter(|&interval| interval > 0)?;
            let twist = (last.inverse() * *world_from_camera).log();
            Some((twist, interval as f64))
        });
        self.last = Some((nanos, *world_from_camera));
        self.repeats = Some(0);
    }

    /// Moves the poses with the keyframe that they are relative to.
    pub fn follow(&mut self, before: &Sim3, after: &Sim3) {
        if before == after {
            return;
        }
        if let Some((_, last)) = &mut self.last {
            *last = after.transform_pose(&before.inverse_transform_pose(last));
        }
        if let Some((twist, _)) = &mut self.velocity {
            let factor = after.scale / before.scale;
            twist.fixed_rows_mut::<3>(0).scale_mut(factor);
        }
    }

    /// Forgets the velocity: after a loss only the position is used.
    pub fn stop(&mut self) {
        (self.velocity, self.repeats) = (None, None);
    }

    /// The last step: twist of `before_from_last`, world units and radians, and its duration in seconds; `None` where
    /// unknown.
    pub fn last_step(&self) -> Option<(Vector6<f64>, f64)> {
        self.velocity.map(|(twist, interval)| (twist, interval * 1e-9))
    }

    /// The camera's last speed, world units per second; `None` where unknown.
    pub fn speed(&self) -> Option<f64> {
        /// Nanoseconds in a second.
        const SECOND: f64 = 1e9;
        let (twist, interval) = self.velocity?;
        Some(twist.fixed_rows::<3>(0).norm() * SECOND / interval)
    }

    /// Scale for the deviation of the next frame, at `nanos`, from constant motion: the intervals of 30 Hz since the
    /// last pose (at least one), and the predicted step; `None` where unknown.
    pub fn step(&self, nanos: i64) -> Option<(f64, SE3)> {
        /// A frame at 30 Hz, nanoseconds.
        const INTERVAL: f64 = 1e9 / 30.0;
        self.velocity?;
        let (before, last) = self.last?;
        let intervals = nanos.saturating_sub(before) as f64 / INTERVAL;
        let predicted = self.predict(nanos, 1.0)?;
        Some((intervals.max(1.0), last.inverse() * predicted))
    }

    /// The last good pose, `None` before the first.
    pub fn last(&self) -> Option<SE3> {
        self.last.map(|(_, last)| last)
    }

    /// The last good pose with its stamp, nanoseconds.
    pub fn last_seen(&self) -> Option<(i64, SE3)> {
        self.last
    }

    /// The pose at `nanos` if the camera continues with `factor` times its velocity, the last one if its image is repeated;
    /// `None` before the first pose.
    pub fn predict(&self, nanos: i64, factor: f64) -> Option<SE3> {
        let (before, last) = self.last?;
        let moving = self.velocity.filter(|_| self.repeats.is_none_or(|repeats| repeats == 0));
        let Some((twist, interval)) = moving else { return Some(last) };
        let elapsed = nanos.saturating_sub(before) as f64;
        let share = (elapsed / interval).clamp(0.0, LONGEST_EXTRAPOLATION);
        Some(last * SE3::exp(&(twist * (factor * share))))
    }
}

/// Factors on the velocity that are tried when constant motion fits badly.
const VELOCITY_FACTORS: [f64; 3] = [0.0, 0.5, 2.0];

/// Other possible poses of the camera at `nanos`: with other factors on its velocity, and rotated by `rotation_rad`
/// about each axis either way from its last pose.
pub fn hypotheses(motion: &Motion, nanos: i64, rotation_rad: f64) -> impl Iterator<Item = SE3> {
    let speeds = VELOCITY_FACTORS.map(|factor| motion.predict(nanos, factor));
    let last = motion.last();
    let turns = (0..6).map(move |index| {
        let mut twist = Vector6::zeros();
        twist[3 + index / 2] = if index % 2 == 0 { rotation_rad } else { -rotation_rad };
        last.map(|last| last * SE3::exp(&twist))
    });
    speeds.into_iter().chain(turns).flatten()
}

/// A camera's pose unchanged, panned and tilted by `rotation_rad` either way and both, and rolled: the views from which
/// a coarse alignment finds any viewing direction near it.
pub fn rotations_around(world_from_camera: &SE3, rotation_rad: f64) -> impl Iterator<Item = SE3> {
    /// (tilt, pan, roll) in units of the rotation.
    const TURNS: [[f64; 3]; 11] = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [-1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, -1.0, 0.0],
        [1.0, 1.0, 0.0],
        [1.0, -1.0, 0.0],
        [-1.0, 1.0, 0.0],
        [-1.0, -1.0, 0.0],
        [0.0, 0.0, 1.0],
        [0.0, 0.0, -1.0],
    ];
    let world_from_camera = *world_from_camera;
    TURNS.into_iter().map(move |turn| {
        let [tilt, pan, roll] = turn.map(|share| share * rotation_rad);
        world_from_camera * SE3::exp(&Vector6::new(0.0, 0.0, 0.0, tilt, pan, roll))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(twist: [f64; 6]) -> SE3 {
        SE3::exp(&Vector6::from(twist))
    }

    #[test]
    fn constant_velocity_continues_over_a_missing_frame() {
        let step = pose([0.1, 0.0, 0.02, 0.01, -0.03, 0.02]);
        let mut motion = Motion::default();
        assert_eq!(motion.predict(0, 1.0), None);
        motion.observe(0, &pose([1.0; 6]));
        motion.observe(33, &(pose([1.0; 6]) * step));
        let expected = pose([1.0; 6]) * step * step * step;
        let predicted = motion.predict(99, 1.0).unwrap();
        assert!((predicted.inverse() * expected).log().norm() < 1e-12);
    }

    #[test]
    fn constant_velocity_continues_over_repeated_images_but_not_over_a_rest() {
        let step = pose([0.1, 0.0, 0.02, 0.01, -0.03, 0.02]);
        let mut motion = Motion::default();
        let see = |motion: &mut Motion, nanos: i64, is_repeat: bool, at: &SE3| {
            motion.begin_frame(is_repeat);
            let predicted = motion.predict(nanos, 1.0);
            motion.observe(nanos, at);
            predicted.map(|predicted| (predicted.inverse() * *at).log().norm())
        };
        let at = [SE3::identity(), step, step * step, step * step * step];
        assert_eq!(see(&mut motion, 0, true, &at[0]), None, "nothing was seen before");
        see(&mut motion, 33, true, &at[0]);
        for (k, nanos) in (1..4).zip([66, 132, 198]) {
            let error = see(&mut motion, nanos, false, &at[k]).unwrap();
            assert!(k == 1 || error < 1e-12, "{k}: {error}");
            assert!(see(&mut motion, nanos + 33, true, &at[k]).unwrap() < 1e-12);
        }
        // The same image for long: the camera stands.
        for nanos in [264, 297, 330] {
            assert!(see(&mut motion, nanos, true, &at[3]).unwrap() < 1e-12, "{nanos}");
        }
        assert!(see(&mut motion, 363, false, &at[3]).unwrap() < 1e-12);
        // After a loss the image that was lost counts as seen for the first time.
        motion.stop();
        see(&mut motion, 396, true, &at[1]);
        assert_eq!(motion.last(), Some(at[1]));
    }

    #[test]
    fn the_camera_follows_its_keyframe() {
        let before = Sim3::new(pose([0.3, 0.1, 0.0, 0.1, 0.2, 0.0]), 2.0);
        let after = Sim3::new(pose([-0.1, 0.4, 0.2, 0.0, 0.1, 0.3]), 2.5);
        let relative = [pose([0.0; 6]), pose([0.1, 0.0, 0.02, 0.01, -0.03, 0.02])];
        let seen_from = |keyframe: &Sim3| {
            let mut motion = Motion::default();
            motion.observe(0, &keyframe.transform_pose(&relative[0]));
            motion.observe(33, &keyframe.transform_pose(&relative[1]));
            motion
        };
        let mut moved = seen_from(&before);
        moved.follow(&before, &after);
        let (predicted, expected) = (moved.predict(66, 1.0), seen_from(&after).predict(66, 1.0));
        let error = (predicted.unwrap().inverse() * expected.unwrap()).log().norm();
        assert!(error < 1e-12, "{error}");
    }

    #[test]
    fn invalid_stamps_and_long_gaps_do_not_fling_the_camera_away() {
        let mut motion = Motion::default();
        motion.observe(100, &SE3::identity());
        motion.observe(100, &pose([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]));
        assert_eq!(motion.predict(200, 1.0), motion.last());
        motion.observe(133, &pose([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]));
        let far = motion.predict(i64::MAX, 1.0).unwrap();
        assert!((far.translation.x - 0.5).abs() < 1e-9);
        let back = motion.predict(i64::MIN, 1.0).unwrap();
        assert!((back.translation.x - 0.2).abs() < 1e-9);
    }

    #[test]
    fn hypotheses_are_finite_and_cover_every_axis() {
        let mut motion = Motion::default();
        assert_eq!(hypotheses(&motion, 0, 0.1).count(), 0);
        motion.observe(0, &SE3::identity());
        let all: Vec<_> = hypotheses(&motion, 33, 0.1).collect();
        assert_eq!(all.len(), 9);
        assert!(all.iter().all(SE3::is_finite));
    }
}
