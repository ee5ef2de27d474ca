//! The alignment against closed forms: derivatives, the statements of LSD14 fig. 4, invariances.

use nalgebra::Vector6;

use crate::slam::alignment::align::{Aligner, AlignmentParams, Ending};
use crate::slam::alignment::normal_equations::UNKNOWNS;
use crate::slam::alignment::points::{LevelPoints, Point};
use crate::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch};
use crate::slam::alignment::residual::{Evaluation, PointTerms, accumulate_reference, point_terms};
use crate::slam::alignment::scatter::GradientScatter;
use crate::slam::alignment::scene::{Noise, Plane, small_camera, small_plane};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::SumPyramid;
use crate::slam::kernel::{Kernel, SimdMode};
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::Brightness;

pub(super) const LEVELS: usize = 4;
pub(super) const LEVEL: usize = 1;

pub(super) fn pyramid(pixels: &[u8]) -> SumPyramid {
    let camera = small_camera();
    let mut pyramid = SumPyramid::with_size(camera.width, camera.height, LEVELS, LEVEL);
    pyramid.fill(pixels);
    pyramid
}

pub(super) fn evaluation(pose: &SE3, brightness: Brightness) -> Evaluation {
    evaluation_with(&AlignmentParams::default(), pose, brightness)
}

fn evaluation_with(params: &AlignmentParams, pose: &SE3, brightness: Brightness) -> Evaluation {
    let (camera, translation) = (small_camera().at_level(LEVEL), &pose.translation);
    Evaluation::new(&camera, LEVEL, pose, brightness, params, translation)
}

pub(super) fn move_of(seed: u64, size: f64) -> SE3 {
    let mut noise = Noise(seed);
    SE3::exp(&Vector6::from_fn(|_, _| size * noise.uniform()))
}

/// Asserts that `analytic` is the derivative measured by `numeric` over many points: the regression of one on the other
/// is 1 with little scatter.
fn assert_derivative(name: &str, analytic: &[f64], numeric: &[f64]) {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let slope = dot(analytic, numeric) / dot(numeric, numeric);
    let correlation =
        dot(analytic, numeric) / (dot(analytic, analytic) * dot(numeric, numeric)).sqrt();
    assert!(analytic.len() > 1000, "{name}: only {} points", analytic.len());
    assert!((slope - 1.0).abs() < 0.02, "{name}: analytic = {slope} × numeric");
    assert!(correlation > 0.995, "{name}: correlation {correlation}");
}

#[test]
fn jacobians_are_the_central_differences_of_the_residual() {
    // Long waves: the gradients of keyframe and frame agree to the curvature of the texture. No slant: W⁻ᵀ treats the
    // inverse depth as constant around a point.
    let camera = small_camera();
    let plane = Plane::new([0.0, 0.0, 0.95], [60.0, 180.0], &camera);
    let mut keyframe = plane.keyframe(&camera, 1, 0.0);
    // No noise: strong gradients are preferred, even those due to noise.
    keyframe.image = plane.render(&camera, &SE3::identity(), 0.0, (1.0, 0.0), 1).into();
    let reference = Reference::prepare(&keyframe);
    let current_from_keyframe = move_of(4, 0.06);
    let image = plane.render(&camera, &current_from_keyframe.inverse(), 0.0, (0.9, 6.0), 5);
    let pyramid = pyramid(&image);
    let brightness = Brightness { a: 0.9f64.ln(), b: 6.0 };
    let terms = |pose: &SE3, brightness: Brightness, point: &Point| {
        point_terms(pyramid.level(LEVEL), &evaluation(pose, brightness), point)
    };
    let compare = |name: &str,
                   analytic: &dyn Fn(&PointTerms) -> f32,
                   shifted: &dyn Fn(&Point, f64) -> Option<PointTerms>,
                   step: f64| {
        let mut pairs = (Vec::new(), Vec::new());
        for point in reference.level(LEVEL).iter() {
            let here = terms(&current_from_keyframe, brightness, &point);
            let around = (shifted(&point, step), shifted(&point, -step));
            let (Some(here), (Some(plus), Some(minus))) = (here, around) else { continue };
            pairs.0.push(f64::from(analytic(&here)));
            pairs.1.push(f64::from(plus.residual - minus.residual) / (2.0 * step));
        }
        assert_derivative(name, &pairs.0, &pairs.1);
    };
    // Steps of about one pixel: the grey values are rounded, and the texture is smooth.
    for unknown in 0..6 {
        let shifted = |point: &Point, step: f64| {
            let mut twist = Vector6::zeros();
            twist[unknown] = step;
            terms(&(SE3::exp(&twist) * current_from_keyframe), brightness, point)
        };
        compare(&format!("pose {unknown}"), &|t| t.jacobian[unknown], &shifted, 0.006);
    }
    let gain = |point: &Point, step: f64| {
        let brightness = Brightness { a: brightness.a + step, ..brightness };
        terms(&current_from_keyframe, brightness, point)
    };
    compare("a", &|t| t.jacobian[6], &gain, 0.01);
    let offset = |point: &Point, step: f64| {
        let brightness = Brightness { b: brightness.b + step, ..brightness };
        terms(&current_from_keyframe, brightness, point)
    };
    compare("b", &|t| t.jacobian[7], &offset, 1.0);
    let depth = |point: &Point, step: f64| {
        let inverse_depth = point.inverse_depth + step as f32;
        terms(&current_from_keyframe, brightness, &Point { inverse_depth, ..*point })
    };
    compare("inverse depth", &|t| t.inverse_depth_derivative, &depth, 0.08);
}

/// (point, σ_r², its part from image noise alone) for every point in view.
fn variances(pose: &SE3) -> Vec<(Point, f32, f32)> {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.1));
    let image = pyramid(&plane.render(&camera, &pose.inverse(), 0.0, (1.0, 0.0), 1));
    let at = evaluation(pose, Brightness::default());
    let points = reference.level(LEVEL).iter();
    let terms = points.filter_map(|point| {
        let terms = point_terms(image.level(LEVEL), &at, &point)?;
        Some((point, terms.variance, at.intensity_variance))
    });
    terms.collect()
}

#[test]
fn under_pure_rotation_every_residual_has_the_same_variance() {
    let variances = variances(&SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.02, -0.05, 0.03)));
    assert!(variances.len() > 1000);
    assert!(variances.iter().all(|&(_, variance, image)| variance == image));
}

#[test]
fn under_translation_along_z_depth_variance_vanishes_at_the_epipole() {
    let variances = variances(&SE3::exp(&Vector6::new(0.0, 0.0, 0.1, 0.0, 0.0, 0.0)));
    let mean_excess = |within: &dyn Fn(f32) -> bool| {
        let near = variances.iter().filter(|(point, ..)| within(point.ray_x.hypot(point.ray_y)));
        let excess: Vec<_> = near.map(|(_, variance, image)| variance / image - 1.0).collect();
        assert!(excess.len() > 20);
        excess.iter().sum::<f32>() / excess.len() as f32
    };
    let (centre, rim) = (mean_excess(&|radius| radius < 0.05), mean_excess(&|radius| radius > 0.5));
    assert!(centre < 0.05 && rim > 20.0 * centre, "centre {centre}, rim {rim}");
}

#[test]
fn under_translation_along_x_depth_variance_affects_only_gradients_along_x() {
    let variances = variances(&SE3::exp(&Vector6::new(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)));
    let mut seen = (0, 0);
    for (point, variance, image) in variances {
        let excess = variance - image;
        // (g_x f_x t_x)² (V + c² d²) to first order, whatever g_y is.
        let focal = small_camera().at_level(LEVEL).fx as f32;
        let common = AlignmentParams::default().common_depth_error * point.inverse_depth;
        let of_depth = point.variance + common * common;
        let expected = (point.gradient_x * focal * 0.1).powi(2) * of_depth;
        assert!((excess - expected).abs() <= 0.01 * expected + 1e-3, "{excess}, {expected}");
        seen.0 += usize::from(expected < 0.01 * image && point.gradient_y.abs() > 5.0);
        seen.1 += usize::from(expected > image);
    }
    assert!(seen.0 > 10 && seen.1 > 100, "{seen:?}");
}

#[test]
fn an_error_that_neighbours_share_lowers_weights_but_excuses_no_outlier() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.02));
    // Half a pixel to two from the truth: some residuals are outliers.
    let pose = SE3::exp(&Vector6::new(0.1, 0.0, 0.0, 0.0, 0.01, 0.0));
    let image = pyramid(&plane.render(&camera, &SE3::identity(), 2.0, (1.0, 0.0), 1));
    let sums = [0.0, 0.2].map(|common_depth_error| {
        let params = AlignmentParams { common_depth_error, ..AlignmentParams::default() };
        let at = evaluation_with(&params, &pose, Brightness::default());
        accumulate_reference(reference.level(LEVEL), image.level(LEVEL), &at)
    });
    let [without, with] = sums;
    assert!(without.inliers > 0 && without.inliers < without.compared);
    assert_eq!(with.inliers, without.inliers);
    assert!(with.energy < 0.9 * without.energy, "{} {}", with.energy, without.energy);
}

#[test]
fn every_kernel_equals_the_reference() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.1));
    let image = pyramid(&plane.render(&camera, &move_of(9, 0.02), 2.0, (0.9, 4.0), 8));
    // Near the solution, far from it, and with most points outside the image.
    for (pose, gain) in
        [(move_of(9, 0.02).inverse(), 0.9f64), (move_of(3, 0.1), 1.0), (move_of(5, 0.3), 1.1)]
    {
        let at = evaluation(&pose, Brightness { a: gain.ln(), b: 3.0 });
        let (points, image) = (reference.level(LEVEL), image.level(LEVEL));
        let expected = accumulate_reference(points, image, &at);
        assert!(expected.in_view > 200);
        for kernel in Kernel::available() {
            let sums = kernel.accumulate(points, image, &at);
            let close = |a: f64, b: f64, scale: f64| (a - b).abs() <= 2e-3 * scale;
            let diagonal = expected.information.diagonal().map(f64::sqrt);
            for i in 0..UNKNOWNS {
                for j in 0..UNKNOWNS {
                    let (a, b) = (sums.information[(i, j)], expected.information[(i, j)]);
                    assert!(close(a, b, diagonal[i] * diagonal[j]), "{kernel:?} {i} {j}: {a} {b}");
                }
                let (a, b) = (sums.gradient[i], expected.gradient[i]);
                let scale = diagonal[i] * expected.energy.sqrt();
                assert!(close(a, b, scale), "{kernel:?} gradient {i}: {a} {b}");
            }
            assert!(close(sums.energy, expected.energy, expected.energy));
            assert!(close(
                sums.squared_residual,
                expected.squared_residual,
                expected.squared_residual
            ));
            // A point exactly on the border, or on the gate, may fall to either side by rounding.
            assert!(sums.in_view.abs_diff(expected.in_view) <= 2);
            assert!(sums.compared.abs_diff(expected.compared) <= 2);
            assert!(sums.inliers.abs_diff(expected.inliers) <= 4);
        }
    }
}

#[test]
fn pixels_that_the_sensor_clips_are_not_compared() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.01));
    let points = reference.level(LEVEL);
    let pose = move_of(9, 0.02);
    // A third of the pixels is white in one frame, black in the other; everything is as predicted.
    for (gain, offset) in [(1.6f64, 0.0), (1.6, -160.0)] {
        let frame = plane.render(&camera, &pose, 1.0, (gain, offset), 8);
        let clipped = frame.iter().filter(|grey| [1, 255].contains(*grey)).count();
        assert!((frame.len() / 10..frame.len() / 2).contains(&clipped), "{clipped}");
        let pyramid = pyramid(&frame);
        let image = pyramid.level(LEVEL);
        let at = evaluation(&pose.inverse(), Brightness { a: gain.ln(), b: offset });
        let expected = accumulate_reference(points, image, &at);
        let share = f64::from(expected.compared) / f64::from(expected.in_view);
        assert!((0.5..0.95).contains(&share), "{share}");
        let scattered = GradientScatter::reference(points, image, &at);
        for kernel in Kernel::available() {
            let sums = kernel.accumulate(points, image, &at);
            assert!(sums.in_view.abs_diff(expected.in_view) <= 2);
            assert!(sums.compared.abs_diff(expected.compared) <= 4, "{kernel:?} {sums:?}");
            assert!(sums.inliers.abs_diff(expected.inliers) <= 4, "{kernel:?} {sums:?}");
            assert!((sums.energy / expected.energy - 1.0).abs() < 2e-3);
            let trace = expected.information.trace();
            assert!((sums.information.trace() / trace - 1.0).abs() < 2e-3);
            let outer = kernel.scatter(points, image, &at).outer;
            assert!((outer.trace() / scattered.outer.trace() - 1.0).abs() < 0.02);
            // The remaining points are as predicted, except for mixed pixels at the border of clipped areas.
            assert!(f64::from(sums.inliers) > 0.95 * f64::from(sums.compared), "{sums:?}");
        }
    }
}

#[test]
fn an_overexposed_frame_is_aligned_by_its_unclipped_pixels() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 1, 0.01);
    let reference = Reference::prepare(&keyframe);
    let aligner = Aligner::new(AlignmentParams::default());
    let truth = move_of(2, 0.05);
    let frame = plane.render(&camera, &truth.inverse(), 1.0, (1.6, 0.0), 4);
    let (start, even) = (SE3::identity(), Brightness::default());
    let found = aligner.align(&reference, &pyramid(&frame), &start, even, &mut |_| true).state;
    let gain = found.brightness.a.exp();
    let error = (found.current_from_keyframe * truth.inverse()).log().norm();
    // A third of the frame is white. If compared like the rest, it would make the gain 1.43; partly white pixels at its
    // border leave 1.53.
    assert!((gain - 1.6).abs() < 0.1, "{gain}");
    assert!(error < 2e-3, "{error}");
}

#[test]
fn every_kernel_measures_the_scatter_of_the_reference() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.1));
    let image = pyramid(&plane.render(&camera, &move_of(9, 0.02), 6.0, (0.9, 4.0), 8));
    let (points, image) = (reference.level(LEVEL), image.level(LEVEL));
    assert!(points.runs().len() > points.blocks().len());
    // Near the solution, where only the gradients of tiles remain, far from it, and with most points outside the image.
    for (pose, gain) in
        [(move_of(9, 0.02).inverse(), 0.9f64), (move_of(3, 0.1), 1.0), (move_of(5, 0.3), 1.1)]
    {
        let at = evaluation(&pose, Brightness { a: gain.ln(), b: 3.0 });
        let expected = GradientScatter::reference(points, image, &at);
        assert!(expected.tiles > 12 && expected.curvature_ratio < 1.0, "{expected:?}");
        for kernel in Kernel::available() {
            let scatter = kernel.scatter(points, image, &at);
            assert!(scatter.tiles.abs_diff(expected.tiles) <= 1, "{kernel:?}");
            let off = (scatter.curvature_ratio / expected.curvature_ratio - 1.0).abs();
            assert!(off < 2e-3, "{kernel:?} curvature off by {off}");
            for i in 0..UNKNOWNS {
                for j in 0..UNKNOWNS {
                    let scale = (expected.outer[(i, i)] * expected.outer[(j, j)]).sqrt();
                    let (a, b) = (scatter.outer[(i, j)], expected.outer[(i, j)]);
                    assert!((a - b).abs() <= 2e-3 * scale, "{kernel:?} {i} {j}: {a} {b}");
                    assert_eq!(a, scatter.outer[(j, i)]);
                }
            }
        }
    }
}

fn aligned(keyframe: &Keyframe, image: &[u8], start: &SE3, simd: SimdMode) -> (SE3, Ending) {
    let aligner = Aligner::new(AlignmentParams { simd, ..AlignmentParams::default() });
    let reference = Reference::prepare(keyframe);
    let alignment =
        aligner.align(&reference, &pyramid(image), start, Brightness::default(), &mut |_| true);
    (alignment.state.current_from_keyframe, alignment.ending)
}

#[test]
fn the_result_is_independent_of_the_unit() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.05);
    let truth = move_of(2, 0.05);
    let image = plane.render(&camera, &truth.inverse(), 2.0, (1.0, 0.0), 4);
    let (pose, _) = aligned(&keyframe, &image, &SE3::identity(), SimdMode::Auto);
    assert!((pose * truth.inverse()).log().norm() < 5e-3);
    for scale in [1e-3, 0.25, 64.0, 1e4] {
        let mut scaled = keyframe.clone();
        for point in &mut scaled.points {
            point.inverse_depth /= scale;
            point.variance /= scale * scale;
        }
        let (mut other, _) = aligned(&scaled, &image, &SE3::identity(), SimdMode::Auto);
        other.translation /= f64::from(scale);
        let difference = (other * pose.inverse()).log().norm();
        assert!(difference < 1e-5, "scale {scale}: {difference}");
    }
}

#[test]
fn distant_initial_guesses_converge() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.05);
    let image = plane.render(&camera, &SE3::identity(), 2.0, (1.0, 0.0), 4);
    for seed in 0..20 {
        // Up to 12 px of level 0 by each unknown alone.
        let (pose, _) = aligned(&keyframe, &image, &move_of(seed, 0.045), SimdMode::Auto);
        assert!(pose.log().norm() < 5e-3, "seed {seed}: {}", pose.log().norm());
    }
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.05);
    let image = plane.render(&camera, &move_of(2, 0.05), 2.0, (1.0, 0.0), 4);
    for simd in [SimdMode::Auto, SimdMode::Portable] {
        let once = aligned(&keyframe, &image, &SE3::identity(), simd);
        assert_eq!(once, aligned(&keyframe, &image, &SE3::identity(), simd));
    }
}

#[test]
fn without_budget_the_best_state_so_far_is_returned() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 2, 0.05));
    let truth = move_of(2, 0.05);
    let image = pyramid(&plane.render(&camera, &truth.inverse(), 2.0, (1.0, 0.0), 4));
    let aligner = Aligner::new(AlignmentParams::default());
    let mut errors = Vec::new();
    for iterations in [0, 4, 100] {
        let mut left = iterations;
        let mut budget = |_: usize| {
            left -= 1;
            left >= 0
        };
        let (start, brightness) = (SE3::identity(), Brightness::default());
        let alignment = aligner.align(&reference, &image, &start, brightness, &mut budget);
        let ending = if iterations < 100 { Ending::OutOfBudget } else { Ending::Finished };
        assert_eq!(alignment.ending, ending);
        errors.push((alignment.state.current_from_keyframe * truth.inverse()).log().norm());
    }
    assert!(errors[1] < 0.25 * errors[0] && errors[2] < 0.1 * errors[0], "{errors:?}");
}

fn median(values: &[f64]) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn each_further_level_improves_the_pose() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 2, 0.02));
    let aligner = Aligner::new(AlignmentParams::default());
    // By the finest level that is solved, starting with none.
    let mut errors = [const { Vec::new() }; LEVELS - LEVEL + 1];
    for seed in 0..9 {
        let truth = move_of(seed, 0.04);
        let image = pyramid(&plane.render(&camera, &truth.inverse(), 2.0, (1.0, 0.0), 10 + seed));
        for (errors, finest) in errors.iter_mut().zip((LEVEL..=LEVELS).rev()) {
            let mut budget = |level: usize| level >= finest;
            let (start, brightness) = (SE3::identity(), Brightness::default());
            let alignment = aligner.align(&reference, &image, &start, brightness, &mut budget);
            assert_eq!(alignment.ending == Ending::Finished, finest == LEVEL);
            let error = alignment.state.current_from_keyframe * truth.inverse();
            errors.push(error.log().norm());
        }
    }
    for pair in errors.windows(2) {
        let [coarse, fine] = [&pair[0], &pair[1]];
        assert!(fine.iter().zip(coarse).all(|(fine, coarse)| fine < coarse), "{errors:?}");
        // Four times the points, each located twice as precisely: with independent noise a quarter is left.
        assert!(median(fine) < 0.5 * median(coarse), "{errors:?}");
    }
}

#[test]
fn the_point_budget_is_met_and_spread() {
    let (plane, camera) = (small_plane(), small_camera());
    let params = ReferenceParams { point_budget: [1000; 5], ..ReferenceParams::default() };
    let (mut reference, mut scratch) = (Reference::new(params), ReferenceScratch::default());
    reference.prepare_into(&plane.keyframe(&camera, 1, 0.1), &mut scratch);
    for level in 1..LEVELS {
        let points = reference.level(level);
        let available = scratch.candidates(level).len();
        assert!(points.len() <= 1000 && points.len() > 900.min(available * 7 / 10), "{level}");
        let centre = points.iter().map(|point| f64::from(point.ray_x)).sum::<f64>();
        assert!((centre / points.len() as f64).abs() < 0.05);
    }
}

#[test]
fn noise_in_the_depth_does_not_bias_the_translation() {
    let (plane, camera) = (small_plane(), small_camera());
    let truth = SE3::exp(&Vector6::new(0.1, 0.04, -0.05, 0.01, 0.02, 0.0));
    let image = pyramid(&plane.render(&camera, &truth.inverse(), 2.0, (1.0, 0.0), 4));
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.1));
    let at = evaluation(&truth, Brightness::default());
    // The step of the normal equations at the true pose, as a share of the translation.
    let pull = |points: &LevelPoints| {
        let sums = accumulate_reference(points, image.level(LEVEL), &at);
        let step = sums.damped_step(0.0).unwrap();
        step.fixed_rows::<3>(0).dot(&truth.translation) / truth.translation.norm_squared()
    };
    let mut own_depth = LevelPoints::default();
    for point in reference.level(LEVEL).iter() {
        own_depth.push(Point { surrounding_inverse_depth: point.inverse_depth, ..point }, 0);
    }
    let (without, with) = (pull(reference.level(LEVEL)), pull(&own_depth));
    assert!(without.abs() < 0.01 && with < -0.02, "{without} without, {with} with shared noise");
}

#[test]
fn correlated_residuals_increase_the_covariance() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.0));
    let points = reference.level(LEVEL);
    let at = evaluation(&SE3::identity(), Brightness::default());
    let std_dev = |image: &SumPyramid| {
        let scatter = GradientScatter::reference(points, image.level(LEVEL), &at);
        assert!(scatter.tiles > 100 && scatter.curvature_ratio <= 1.0);
        let sums = accumulate_reference(points, image.level(LEVEL), &at);
        let covariance = scatter.covariance(&sums).unwrap();
        assert!(covariance.cholesky().is_some());
        covariance.fixed_view::<3, 3>(0, 0).trace().sqrt()
    };
    let clean = plane.render(&camera, &SE3::identity(), 2.0, (1.0, 0.0), 4);
    // The same deviation in every pixel of a 16-pixel patch: noise that does not average out within it.
    let mut noise = Noise(6);
    let patches: Vec<_> = (0..20 * 15).map(|_| 4.0 * noise.normal()).collect();
    let deviating = clean.iter().enumerate().map(|(i, &grey)| {
        let (u, v) = (i % camera.width, i / camera.width);
        (f64::from(grey) + patches[v / 16 * 20 + u / 16]).round().clamp(1.0, 255.0) as u8
    });
    let (clean, deviating) =
        (std_dev(&pyramid(&clean)), std_dev(&pyramid(&deviating.collect::<Vec<_>>())));
    assert!(deviating > 2.0 * clean, "{deviating} with, {clean} without patches");
}

#[test]
fn without_inliers_there_is_no_covariance() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.0));
    let points = reference.level(LEVEL);
    let image = pyramid(&plane.render(&camera, &SE3::identity(), 2.0, (1.0, 0.0), 4));
    // An offset of 200 grey levels is far beyond noise everywhere.
    let at = evaluation(&SE3::identity(), Brightness { a: 0.0, b: 200.0 });
    let sums = accumulate_reference(points, image.level(LEVEL), &at);
    for kernel in Kernel::available() {
        let scatter = kernel.scatter(points, image.level(LEVEL), &at);
        assert!(scatter.tiles > 100);
        assert!(scatter.covariance(&sums).is_none(), "{kernel:?}");
    }
}
