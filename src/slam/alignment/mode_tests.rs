//! The effect of common errors of depth on a pose: H against a second alignment, against the reference and against the
//! keyframe's unit.

use nalgebra::{Matrix6, SMatrix, Vector3, Vector6};

use crate::slam::alignment::align::{Aligner, Alignment, AlignmentParams};
use crate::slam::alignment::normal_equations::UNKNOWNS;
use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::residual::{Evaluation, accumulate_reference};
use crate::slam::alignment::scatter::GradientScatter;
use crate::slam::alignment::scene::{small_camera, small_plane};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::SumPyramid;
use crate::slam::kernel::Kernel;
use crate::slam::keyframe::Keyframe;
use crate::slam::modes::{ModeCovariance, NUM_MODES};
use crate::slam::pose::Brightness;

const LEVELS: usize = 4;
const LEVEL: usize = 1;

fn pyramid(pixels: &[u8]) -> SumPyramid {
    let camera = small_camera();
    let mut pyramid = SumPyramid::with_size(camera.width, camera.height, LEVELS, LEVEL);
    pyramid.fill(pixels);
    pyramid
}

/// A keyframe with relief, and a frame of it.
fn keyframe_and_frame(current_from_keyframe: &SE3) -> (Keyframe, SumPyramid) {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 1, 0.02);
    let image = plane.render(&camera, &current_from_keyframe.inverse(), 2.0, (1.0, 0.0), 8);
    (keyframe, pyramid(&image))
}

fn sideways() -> SE3 {
    SE3::exp(&Vector6::new(0.12, 0.05, -0.08, 0.02, -0.03, 0.01))
}

/// The keyframe with a common error m of its relative inverse depth that leaves the mean at `centre` unchanged.
fn with_error(keyframe: &Keyframe, m: &Vector3<f64>, centre: &Vector3<f64>) -> Keyframe {
    let mut changed = keyframe.clone();
    let camera = keyframe.intrinsics;
    for point in &mut changed.points {
        let x = (f64::from(point.u) - camera.cx) / camera.fx;
        let y = (f64::from(point.v) - camera.cy) / camera.fy;
        let phi = Vector3::new(x, y, f64::from(point.inverse_depth).ln());
        point.inverse_depth *= (phi - centre).dot(m).exp() as f32;
    }
    changed
}

/// An aligner that iterates to full convergence.
fn patient() -> Aligner {
    Aligner::new(AlignmentParams {
        step_tolerance: 1e-4,
        energy_tolerance: 1.0,
        ..AlignmentParams::default()
    })
}

fn aligned(keyframe: &Keyframe, frame: &SumPyramid) -> (Reference, Alignment) {
    let reference = Reference::prepare(keyframe);
    let (start, brightness) = (SE3::identity(), Brightness::default());
    let alignment = patient().align(&reference, frame, &start, brightness, &mut |_| true);
    (reference, alignment)
}

fn moved_per_mode(reference: &Reference, alignment: &Alignment) -> SMatrix<f64, 6, NUM_MODES> {
    let translation = &alignment.state.current_from_keyframe.translation;
    let centre = reference.level(LEVEL).centre();
    alignment.scatter.d_pose_d_modes(&alignment.state.sums, translation, &centre).unwrap()
}

/// When depth with a common error is aligned again, the pose moves by −M⁻¹ H m.
#[test]
fn a_pose_on_tilted_or_flattened_depth_moves_as_predicted() {
    let (keyframe, frame) = keyframe_and_frame(&sideways());
    let (reference, alignment) = aligned(&keyframe, &frame);
    let (centre, per_mode) =
        (reference.level(LEVEL).centre(), moved_per_mode(&reference, &alignment));
    for mode in 0..NUM_MODES {
        let mut m = Vector3::zeros();
        // Large enough that rounding of the grey values does not matter.
        m[mode] = 0.03;
        let solved = |sign: f64| {
            let (_, other) = aligned(&with_error(&keyframe, &(sign * m), &centre), &frame);
            other.state.current_from_keyframe
        };
        let measured = (solved(1.0) * solved(-1.0).inverse()).log() * 0.5;
        let predicted = per_mode * m;
        let off = (measured - predicted).norm() / measured.norm();
        assert!(off < 0.1, "mode {mode}: off by {off}: {measured} and {predicted}");
        assert!(predicted.norm() > 1e-4, "mode {mode} moves nothing");
    }
}

/// A constant error is the unit: it only affects the translation, in proportion, whatever the images are.
#[test]
fn a_constant_error_only_scales_the_translation() {
    let (keyframe, frame) = keyframe_and_frame(&sideways());
    let (reference, alignment) = aligned(&keyframe, &frame);
    let translation = alignment.state.current_from_keyframe.translation;
    let at = |centre: &Vector3<f64>| {
        alignment.scatter.d_pose_d_modes(&alignment.state.sums, &translation, centre).unwrap()
    };
    let shifted = at(&(reference.level(LEVEL).centre() + Vector3::x()));
    let difference = shifted.column(0) - moved_per_mode(&reference, &alignment).column(0);
    assert!((difference.fixed_rows::<3>(0) - translation).norm() < 1e-9);
    assert!(difference.fixed_rows::<3>(3).norm() < 1e-12);
    // The same when the scaled depth is aligned again.
    let mut nearer = keyframe.clone();
    for point in &mut nearer.points {
        point.inverse_depth *= 1.05;
        point.variance *= 1.05 * 1.05;
    }
    let (_, other) = aligned(&nearer, &frame);
    let scaled = other.state.current_from_keyframe.translation * 1.05;
    assert!((scaled - translation).norm() < 1e-3 * translation.norm());
}

#[test]
fn every_kernel_gives_the_modes_of_the_reference() {
    let (keyframe, frame) = keyframe_and_frame(&sideways());
    let reference = Reference::prepare(&keyframe);
    let params = AlignmentParams::default();
    let (points, image) = (reference.level(LEVEL), frame.level(LEVEL));
    let camera = small_camera().at_level(LEVEL);
    // Near the solution, and with many points outside the image.
    for pose in [sideways(), SE3::exp(&Vector6::new(0.3, 0.1, 0.1, 0.05, 0.2, -0.1))] {
        let brightness = Brightness { a: -0.1, b: 3.0 };
        let at = Evaluation::new(&camera, LEVEL, &pose, brightness, &params, &pose.translation);
        let expected = GradientScatter::reference(points, image, &at).d_gradient_d_modes;
        let sums = accumulate_reference(points, image, &at);
        assert!(sums.in_view > 200);
        let constant = sums.information.fixed_columns::<3>(0) * pose.translation;
        for kernel in Kernel::available() {
            let found = kernel.scatter(points, image, &at).d_gradient_d_modes;
            for mode in 0..NUM_MODES {
                for i in 0..UNKNOWNS {
                    // Sums of both signs: their size is that of the unit's column.
                    let scale = constant[i].abs() + sums.information[(i, i)].sqrt();
                    let (a, b) = (found[(i, mode)], expected[(i, mode)]);
                    assert!((a - b).abs() <= 2e-3 * scale, "{kernel:?} {i} {mode}: {a} {b}");
                }
            }
        }
    }
}

/// The published covariance covers the pose estimated on depth with such an error; without the modes it would not.
#[test]
fn the_covariance_covers_a_pose_on_tilted_depth() {
    /// The 99.9 % quantile of χ²₆.
    const RARE: f64 = 22.5;
    let (keyframe, frame) = keyframe_and_frame(&sideways());
    let normalized = |error: &Vector6<f64>, covariance: &Matrix6<f64>| {
        error.dot(&(covariance.try_inverse().unwrap() * error))
    };
    let centre = Reference::prepare(&keyframe).level(LEVEL).centre();
    for m in [Vector3::new(0.05, 0.0, 0.0), Vector3::new(0.0, -0.06, 0.0), Vector3::repeat(0.04)] {
        let mut tilted = with_error(&keyframe, &m, &centre);
        tilted.mode_covariance = ModeCovariance::of_std_devs([0.05; 3]);
        let (reference, alignment) = aligned(&tilted, &frame);
        let error = (alignment.state.current_from_keyframe * sideways().inverse()).log();
        let alone = alignment.covariance(&patient().params).unwrap();
        let whole = alone + alignment.covariance_from_modes(&reference).unwrap();
        let (without, with) = (normalized(&error, &alone), normalized(&error, &whole));
        assert!(without > 2.0 * RARE, "{m}: the error is one of the modes: {without}");
        assert!(with < RARE, "{m}: {with}");
    }
}

/// A coarse tolerance could leave far more than the claimed standard deviation.
#[test]
fn the_remaining_step_is_small_against_the_claimed_uncertainty() {
    let left = |step_tolerance: f64| {
        let mut worst = 0.0f64;
        for seed in 0..8 {
            let turn = 0.004 * f64::from(seed);
            let pose = SE3::exp(&Vector6::new(0.1, 0.02 + turn, -0.05, turn, -0.03, 0.01));
            let (keyframe, frame) = keyframe_and_frame(&pose);
            let reference = Reference::prepare(&keyframe);
            let params = AlignmentParams {
                step_tolerance,
                energy_tolerance: 1.0,
                ..AlignmentParams::default()
            };
            let (start, brightness) = (SE3::identity(), Brightness::default());
            let aligner = Aligner::new(params);
            let sums =
                aligner.align(&reference, &frame, &start, brightness, &mut |_| true).state.sums;
            worst = worst.max(sums.decrement(&sums.damped_step(0.0).unwrap()));
        }
        worst
    };
    let (usual, coarse) = (left(AlignmentParams::default().step_tolerance), left(10.0));
    assert!(usual < 0.3 && coarse > 2.0 * usual, "{usual} {coarse}");
}
