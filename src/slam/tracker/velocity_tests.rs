//! Velocities of a camera on a known path, with errors as reported, and cases without a velocity.

use nalgebra::{Matrix6, Matrix6x3, Vector3, Vector6};

use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::scene::{Noise, Plane, small_camera, small_plane};
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::modes::ModeCovariance;
use crate::slam::pose::full_covariance;
use crate::slam::pose::{PoseEstimate, Velocity};
use crate::slam::tracker::velocity::{PoseErrors, VelocityMemory};
use crate::slam::tracker::{Tracker, TrackerParams};

/// Between frames at 30 Hz, seconds.
const INTERVAL: f64 = 1.0 / 30.0;
/// Of six degrees of freedom 99.9 % are below.
const RARE: f64 = 22.5;

/// The camera's steady motion per frame.
fn step() -> Vector6<f64> {
    Vector6::new(0.010, -0.004, 0.007, 0.003, 0.004, -0.005)
}

fn path(index: u64) -> SE3 {
    SE3::exp(&(step() * index as f64))
}

fn nanos(index: u64) -> i64 {
    (index as f64 * INTERVAL * 1e9) as i64
}

struct Camera {
    plane: Plane,
    tracker: Tracker,
}

impl Camera {
    fn on(keyframe: &Keyframe) -> Self {
        let mut tracker = Tracker::new(small_camera(), TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(keyframe)));
        Self { plane: small_plane(), tracker }
    }

    /// The frame `index` of the path, at a stamp.
    fn see_at(&mut self, index: u64, nanos: i64) -> PoseEstimate {
        let image = self.plane.render(&small_camera(), &path(index), 2.0, (1.0, 0.0), 100 + index);
        let frame = FrameView::new(&small_camera(), index, nanos, &image);
        let estimate = self.tracker.track(&frame, &mut |_| true);
        assert!(estimate.state.is_tracked(), "frame {index}: {:?}", estimate.state);
        estimate
    }

    fn see(&mut self, index: u64) -> Option<Velocity> {
        self.see_at(index, nanos(index)).velocity
    }

    fn see_nothing(&mut self, index: u64) {
        let camera = small_camera();
        let grey = vec![128; camera.width * camera.height];
        let frame = FrameView::new(&camera, index, nanos(index), &grey);
        let estimate = self.tracker.track(&frame, &mut |_| true);
        assert!(!estimate.state.is_tracked() && estimate.velocity.is_none());
    }
}

fn keyframe() -> Keyframe {
    small_plane().keyframe(&small_camera(), 2, 0.02)
}

fn twist(velocity: &Velocity) -> Vector6<f64> {
    let [v, w] = [velocity.linear, velocity.angular];
    Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z)
}

fn normalized(velocity: &Velocity, exact: &Vector6<f64>) -> f64 {
    let error = twist(velocity) - exact;
    error.dot(&(full_covariance(&velocity.covariance).try_inverse().unwrap() * error))
}

#[test]
fn a_steady_camera_has_its_velocity_within_the_covariance() {
    let mut camera = Camera::on(&keyframe());
    assert_eq!(camera.see(0), None, "there is no pose before the first");
    for index in 1..=12 {
        let velocity = camera.see(index).unwrap();
        let exact = step() / INTERVAL;
        assert!(normalized(&velocity, &exact) < RARE, "frame {index}: {velocity:?}");
        // Noise of a small image, at most a tenth of the speed.
        assert!((velocity.linear - exact.fixed_rows::<3>(0)).norm() < 0.04, "{velocity:?}");
        assert!((velocity.angular - exact.fixed_rows::<3>(3)).norm() < 0.04, "{velocity:?}");
    }
}

#[test]
fn a_camera_whose_images_are_repeated_moves_at_half_the_speed_and_does_not_stop() {
    let mut camera = Camera::on(&keyframe());
    camera.see(0);
    for index in 1..=12 {
        let velocity = camera.see_at(index, nanos(2 * index)).velocity.unwrap();
        let exact = step() / (2.0 * INTERVAL);
        assert!(normalized(&velocity, &exact) < RARE, "frame {index}: {velocity:?}");
        assert_eq!(camera.see_at(index, nanos(2 * index + 1)).velocity, None);
    }
}

#[test]
fn there_is_no_velocity_without_two_poses_in_a_row() {
    let mut camera = Camera::on(&keyframe());
    let known = |camera: &mut Camera, index: u64| camera.see(index).is_some();
    assert_eq!([0, 1, 2].map(|index| known(&mut camera, index)), [false, true, true]);
    camera.see_nothing(3);
    assert_eq!([4, 5].map(|index| known(&mut camera, index)), [false, true], "after a loss");
    assert!(camera.see(8).is_some(), "two frames are missing");
    let repeated = camera.see_at(9, nanos(8));
    assert_eq!(repeated.velocity, None, "a stamp that does not advance");
    assert!(camera.see(10).is_some());
    assert_eq!(camera.see_at(11, nanos(10) - 5).velocity, None, "a stamp that goes back");
    assert_eq!(camera.see_at(12, nanos(10) + 600_000_000).velocity, None, "a long gap");
    camera.tracker.resume_at(nanos(12), &path(12));
    assert_eq!([13, 14].map(|index| known(&mut camera, index)), [false, true], "resumed");
}

#[test]
fn there_is_no_velocity_across_epochs_and_on_a_rejected_map() {
    let mut camera = Camera::on(&keyframe());
    assert_eq!([0, 1].map(|index| camera.see(index).is_some()), [false, true]);
    let next = Keyframe { keyframe_id: 7, epoch: 1, sequence: 1, ..keyframe() };
    camera.tracker.adopt(Box::new(Reference::prepare(&next)));
    assert_eq!([2, 3].map(|index| camera.see(index).is_some()), [false, true]);
    let rejected = Keyframe { map_state: MapState::Rejected, ..next };
    camera.tracker.adopt(Box::new(Reference::prepare(&rejected)));
    let image = small_plane().render(&small_camera(), &path(4), 2.0, (1.0, 0.0), 104);
    let frame = FrameView::new(&small_camera(), 4, nanos(4), &image);
    assert_eq!(camera.tracker.track(&frame, &mut |_| true).velocity, None);
}

/// The map's unit is scaled between two frames, and the keyframe moves.
#[test]
fn velocity_follows_the_unit_of_the_map() {
    let with_unit = |unit: f64| {
        let mut camera = Camera::on(&keyframe());
        (0..4).for_each(|index| _ = camera.see(index));
        let moved = SE3::exp(&Vector6::new(0.3, 0.1, -0.2, 0.2, -0.1, 0.4));
        let revised =
            Keyframe { world_from_keyframe: Sim3::new(moved, unit), revision: 2, ..keyframe() };
        camera.tracker.adopt(Box::new(Reference::prepare(&revised)));
        [4, 5].map(|index| camera.see(index).unwrap())
    };
    for (one, other) in with_unit(1.0).iter().zip(&with_unit(2.5)) {
        assert!((one.linear * 2.5 - other.linear).norm() < 1e-9, "{one:?} {other:?}");
        assert!((one.angular - other.angular).norm() < 1e-9, "{one:?} {other:?}");
        let scale = Matrix6::from_diagonal(&[2.5, 2.5, 2.5, 1.0, 1.0, 1.0].into());
        let [one, other] = [one, other].map(|of| full_covariance(&of.covariance));
        let expected = scale * one * scale;
        assert!((expected - other).norm() < 1e-9 * other.norm(), "{expected} {other}");
    }
}

/// Poses with independent errors, with errors shared by all poses on a keyframe, and with those of its common depth.
struct Errors {
    noise: Noise,
    /// Standard deviation of each pose; a quarter of its variance is independent.
    of_pose: Vector6<f64>,
    shared: Vector6<f64>,
    modes: ModeCovariance,
    of_keyframe: Vector3<f64>,
}

impl Errors {
    /// `of_depth` is the standard deviation of the share of the motion lost to the keyframe's depth.
    fn new(seed: u64, of_depth: f64) -> Self {
        let modes = ModeCovariance::of_std_devs([of_depth; 3]);
        let of_pose = Vector6::new(8e-4, 6e-4, 12e-4, 4e-4, 6e-4, 2e-4);
        let mut noise = Noise(seed);
        let shared = of_pose.map(|std_dev| 0.75f64.sqrt() * std_dev * noise.normal());
        let of_keyframe = Vector3::from_fn(|_, _| of_depth * noise.normal());
        Self { noise, of_pose, shared, modes, of_keyframe }
    }

    /// The estimate of a camera at a true pose, and its errors.
    fn of(&mut self, index: u64) -> (SE3, PoseErrors) {
        let current_from_keyframe = path(index).inverse();
        // A common error of depth scales the translation.
        let mut by_mode = Matrix6x3::zeros();
        let along = current_from_keyframe.translation * Vector3::repeat(1.0).transpose();
        by_mode.fixed_view_mut::<3, 3>(0, 0).copy_from(&along);
        let own = self.of_pose.map(|std_dev| 0.5 * std_dev * self.noise.normal());
        let error = self.shared + own + by_mode * self.of_keyframe;
        let estimate = SE3::exp(&error) * current_from_keyframe;
        let errors = PoseErrors {
            keyframe: (1, 0),
            unit: 1.0,
            alignment: Matrix6::from_diagonal(&self.of_pose.map(|of| 0.7 * of * of)),
            displacement: Matrix6::from_diagonal(&self.of_pose.map(|of| 0.3 * of * of)),
            by_mode,
            modes: self.modes,
        };
        (estimate.inverse(), errors)
    }
}

/// Mean normalised error of the velocities in runs of twenty frames, and their mean variance along z.
fn monte_carlo(of_depth: f64) -> (f64, f64) {
    const RUNS: u64 = 300;
    const FRAMES: u64 = 20;
    let (mut sum, mut variance) = (0.0, 0.0);
    for seed in 0..RUNS {
        let mut errors = Errors::new(seed + 1, of_depth);
        let mut memory = VelocityMemory::default();
        let mut before = None;
        for index in 0..FRAMES {
            let (world_from_camera, error) = errors.of(index);
            let motion = before.replace(world_from_camera);
            let motion = motion.map(|last| ((last.inverse() * world_from_camera).log(), INTERVAL));
            // The first steps include the variance of a camera that may just have started to move.
            let velocity = memory.observe(error, motion).filter(|_| index > 1);
            sum += velocity.map_or(0.0, |velocity| normalized(&velocity, &(step() / INTERVAL)));
            variance += velocity.map_or(0.0, |velocity| velocity.covariance[11]);
        }
    }
    let count = (RUNS * (FRAMES - 2)) as f64;
    (sum / count, variance / count)
}

#[test]
fn shared_errors_of_two_poses_cancel_and_independent_ones_count_twice() {
    for of_depth in [0.0, 0.02, 0.1] {
        let (error, variance) = monte_carlo(of_depth);
        // Steady motion is never certain to be steady: somewhat below 6.
        assert!((3.0..6.5).contains(&error), "{of_depth}: {error}");
        // If the poses' common errors were independent it would be that of the whole path, not of a step.
        let of_noise = 2.0 * 6e-4f64.powi(2);
        let of_step = 3.0 * (of_depth * step()[2]).powi(2);
        let expected = (of_noise + of_step) / (INTERVAL * INTERVAL);
        assert!((0.9 * expected..2.5 * expected).contains(&variance), "{of_depth}: {variance}");
    }
}

#[test]
fn points_of_another_keyframe_have_independent_errors() {
    let variance = |keyframe: u64| {
        let mut memory = VelocityMemory::default();
        let mut errors = Errors::new(1, 0.0);
        let mut said = None;
        for (index, keyframe) in [(0, 1), (1, 1), (2, keyframe)] {
            let error = PoseErrors { keyframe: (keyframe, 0), ..errors.of(index).1 };
            said = memory.observe(error, Some((step(), INTERVAL)));
        }
        said.unwrap().covariance[0]
    };
    let ratio = variance(2) / variance(1);
    assert!((ratio - (0.7 + 0.25 * 0.3) / 0.25).abs() < 0.05, "{ratio}");
}

#[test]
fn a_changing_velocity_is_less_certain() {
    // Each frame moves by a third more than the previous one.
    let deviation = |accelerates: bool| {
        let mut memory = VelocityMemory::default();
        let mut errors = Errors::new(1, 0.0);
        let (mut said, mut speed) = (None, 1.0);
        for index in 0..8 {
            let (_, error) = errors.of(index);
            said = memory.observe(error, Some((step() * speed, INTERVAL)));
            speed *= if accelerates { 1.33 } else { 1.0 };
        }
        let velocity = said.unwrap();
        (velocity.covariance[0].sqrt(), velocity.linear.norm())
    };
    let ((steady, _), (unsteady, speed)) = (deviation(false), deviation(true));
    // From the middle of its last interval it gained an eighth of its speed, over three axes together.
    assert!(unsteady > steady + 0.03 * speed, "{steady} {unsteady} {speed}");
}
