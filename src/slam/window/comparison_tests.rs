//! The comparison: derivatives against differences, lanes against a plain reference and against each other.

use nalgebra::Vector6;

use super::comparison::{
    Compared, LANES, POSE, Pair, PairSums, PatternAppearance, Patterns, Robustness, SAMPLES,
    Wanted, sum,
};
use crate::slam::depth::pattern::{PATTERN, sum_of_samples};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::shared::SharedImage;
use crate::slam::kernel::Kernel;
use crate::slam::test_scene::{CAMERA, Random};

const EASY: Robustness = Robustness { huber_grey: 1e3, most_energy: f32::INFINITY };

/// A smooth image, so that a bilinear sample is hardly ever between two slopes.
fn waves(phase: f32) -> SharedImage {
    let pixels: Vec<u8> = (0..CAMERA.width * CAMERA.height)
        .map(|i| {
            let (u, v) = ((i % CAMERA.width) as f32, (i / CAMERA.width) as f32);
            let wave = 60.0 * (0.11 * u + phase).sin() * (0.09 * v).cos()
                + 50.0 * (0.1 * v + 0.04 * u).cos();
            (128.0 + wave).round() as u8
        })
        .collect();
    SharedImage::try_from_pixels(CAMERA.width, CAMERA.height, pixels.into()).unwrap()
}

/// Appearance of the pattern around a pixel, every sample of weight 1.
fn appearance(image: &SharedImage, u: usize, v: usize) -> PatternAppearance {
    let samples = PATTERN.map(|(du, dv)| {
        let row = image.row(v.wrapping_add_signed(dv as isize));
        f32::from(row[u.wrapping_add_signed(du as isize)])
    });
    let mean = sum_of_samples(&samples) / SAMPLES as f32;
    PatternAppearance { shape: samples.map(|grey| grey / mean), weight: [1.0; SAMPLES] }
}

/// The ray of a pixel, at depth 1.
fn ray(u: f64, v: f64) -> [f32; 2] {
    CAMERA.ray(u, v).xy().map(|x| x as f32).into()
}

const ALL_WANTED: Wanted = Wanted { poses: true, depths: true, host: true };

/// One comparison, in the first lane.
fn compare(
    kernel: Kernel,
    image: &SharedImage,
    pair: &Pair,
    appearance: &PatternAppearance,
    ray: [f32; 2],
    depth: f32,
    robustness: &Robustness,
) -> (Compared, PairSums) {
    let (mut patterns, mut seen) = (Patterns::NONE, [Compared::NONE]);
    patterns.set(0, appearance, ray);
    patterns.inverse_depth[0] = depth;
    let mut sums = PairSums::default();
    kernel.compare(image, pair, &[patterns], robustness, &mut seen, &mut sums);
    (seen[0], sums)
}

/// Cost of a comparison and half its gradient, with respect to the observer's pose and to depth.
fn compared(
    image: &SharedImage,
    appearance: &PatternAppearance,
    ray: [f32; 2],
    pose: &SE3,
    depth: f64,
) -> (f64, [f64; POSE + 1]) {
    let pair = Pair::new(pose, &CAMERA, ALL_WANTED);
    let (seen, sums) =
        compare(Kernel::Portable, image, &pair, appearance, ray, depth as f32, &EASY);
    assert!(seen.cost[0].is_finite());
    let mut gradient = [0.0; POSE + 1];
    (0..POSE).for_each(|m| gradient[m] = f64::from(sum(&sums.right[m])));
    gradient[POSE] = f64::from(seen.depth_right[0]);
    (f64::from(seen.cost[0]), gradient)
}

#[test]
fn derivatives_match_differences_of_the_cost() {
    let (host, observer) = (waves(0.0), waves(0.4));
    let pose = SE3::exp(&Vector6::from([0.1, -0.05, 0.08, 0.02, -0.03, 0.05]));
    for (u, v, depth) in [(80, 60, 0.4), (200, 150, 0.9), (150, 40, 0.2)] {
        let appearance = appearance(&host, u, v);
        let ray = ray(u as f64, v as f64);
        let at = |pose: &SE3, depth: f64| compared(&observer, &appearance, ray, pose, depth);
        let found = at(&pose, depth).1;
        // A two-hundredth of a pixel to each side: hardly a sample leaves its four pixels, where the gradient is exact.
        let pixels = 0.005 / CAMERA.fx;
        let length = found.iter().take(3).map(|g| g * g).sum::<f64>().sqrt();
        for m in 0..=POSE {
            let h = [pixels / depth, pixels, 0.0005 * depth][[0, 0, 0, 1, 1, 1, 2][m]];
            let moved = |h: f64| match m {
                POSE => at(&pose, depth + h).0,
                _ => {
                    let twist = Vector6::from_fn(|r, _| if r == m { h } else { 0.0 });
                    at(&(SE3::exp(&twist) * pose), depth).0
                }
            };
            let numeric = (moved(h) - moved(-h)) / (4.0 * h);
            // Those by translation and by rotation differ by the depth.
            let size = if m < 3 { length } else { length / depth };
            assert!(
                (found[m] - numeric).abs() < 0.1 * size,
                "{u} {v} by {m}: {} {numeric}",
                found[m]
            );
        }
    }
}

/// Reference comparison without lanes, tricks and f32: the samples at their own positions, ∂π at the pattern's centre.
/// Returns the cost, the sums H of (pose, depth) and the right side.
fn explained(
    image: &SharedImage,
    appearance: &PatternAppearance,
    ray: [f32; 2],
    pose: &SE3,
    depth: f64,
    robustness: &Robustness,
) -> (f64, [[f64; POSE + 1]; POSE + 1], [f64; POSE + 1]) {
    let mut rows = Vec::new();
    let ray_of_centre = nalgebra::Vector3::new(f64::from(ray[0]), f64::from(ray[1]), 1.0);
    let centre = pose.rotation * ray_of_centre / depth + pose.translation;
    for (du, dv) in PATTERN {
        let x = f64::from(ray[0]) + f64::from(du) / CAMERA.fx;
        let y = f64::from(ray[1]) + f64::from(dv) / CAMERA.fy;
        let at = pose.rotation * nalgebra::Vector3::new(x, y, 1.0) / depth + pose.translation;
        let (u, v) = (CAMERA.fx * at.x / at.z + CAMERA.cx, CAMERA.fy * at.y / at.z + CAMERA.cy);
        let (column, row) = (u as usize, v as usize);
        let (a, b) = (u - column as f64, v - row as f64);
        let grey = |column: usize, row: usize| f64::from(image.row(row)[column]);
        let (p00, p10) = (grey(column, row), grey(column + 1, row));
        let (p01, p11) = (grey(column, row + 1), grey(column + 1, row + 1));
        let value = (1.0 - b) * ((1.0 - a) * p00 + a * p10) + b * ((1.0 - a) * p01 + a * p11);
        let along_u = (1.0 - b) * (p10 - p00) + b * (p11 - p01);
        let along_v = (1.0 - a) * (p01 - p00) + a * (p11 - p10);
        let j = nalgebra::Vector3::new(
            along_u * CAMERA.fx / centre.z,
            along_v * CAMERA.fy / centre.z,
            -(along_u * CAMERA.fx * centre.x + along_v * CAMERA.fy * centre.y)
                / (centre.z * centre.z),
        );
        let turning = centre.cross(&j);
        // X' = R X₁/d + t moves by −R X₁/d² with d.
        let by_depth = -j.dot(&(centre - pose.translation)) / depth;
        rows.push([value, j.x, j.y, j.z, turning.x, turning.y, turning.z, by_depth]);
    }
    let means: [f64; POSE + 2] =
        std::array::from_fn(|m| rows.iter().map(|row| row[m]).sum::<f64>() / SAMPLES as f64);
    let (mut cost, mut hessian) = (0.0, [[0.0; POSE + 1]; POSE + 1]);
    let mut right = [0.0; POSE + 1];
    for (k, row) in rows.iter().enumerate() {
        let of: [f64; POSE + 2] =
            std::array::from_fn(|m| row[m] - f64::from(appearance.shape[k]) * means[m]);
        let huber = (f64::from(robustness.huber_grey) / of[0].abs()).min(1.0);
        let weight = f64::from(appearance.weight[k]) * huber;
        cost += weight * (2.0 - huber) * of[0] * of[0];
        for a in 0..=POSE {
            (0..=POSE).for_each(|b| hessian[a][b] += weight * of[a + 1] * of[b + 1]);
            right[a] += weight * of[0] * of[a + 1];
        }
    }
    (cost, hessian, right)
}

#[test]
fn sums_match_the_reference_comparison() {
    let (host, observer) = (waves(0.0), waves(0.4));
    let robustness = Robustness { huber_grey: 9.0, most_energy: f32::INFINITY };
    let pose = SE3::exp(&Vector6::from([0.1, -0.05, 0.08, 0.02, -0.03, 0.05]));
    for (u, v, depth) in [(60, 50, 0.4), (250, 190, 0.9), (70, 190, 0.2), (240, 45, 0.6)] {
        let appearance = appearance(&host, u, v);
        let ray = ray(u as f64, v as f64);
        let pair = Pair::new(&pose, &CAMERA, ALL_WANTED);
        let kernel = Kernel::Portable;
        let (seen, sums) =
            compare(kernel, &observer, &pair, &appearance, ray, depth as f32, &robustness);
        let (cost, hessian, right) =
            explained(&observer, &appearance, ray, &pose, depth, &robustness);
        assert!((f64::from(seen.cost[0]) - cost).abs() < 1e-3 * cost, "{cost}");
        // Relative to what the diagonal allows.
        let near = |found: f32, expected: f64, a: usize, b: usize| {
            let size = (hessian[a][a] * hessian[b][b]).sqrt();
            assert!(
                (f64::from(found) - expected).abs() < 0.002 * size,
                "{a} {b}: {found} {expected}"
            );
        };
        let mut entry = 0;
        for a in 0..POSE {
            for b in a..POSE {
                near(sum(&sums.pose[entry]), hessian[a][b], a, b);
                entry += 1;
            }
            near(seen.observer[a][0], hessian[a][POSE], a, POSE);
            let size = (hessian[a][a] * cost).sqrt();
            assert!((f64::from(sum(&sums.right[a])) - right[a]).abs() < 0.002 * size);
            let carried: f64 =
                (0..POSE).map(|m| Pair::by_host(&pose)[(m, a)] * hessian[m][POSE]).sum();
            let length: f64 = (0..POSE).map(|m| hessian[m][POSE].powi(2)).sum::<f64>().sqrt();
            assert!((f64::from(seen.host[a][0]) - carried).abs() < 0.002 * length / depth);
        }
        near(seen.depth[0], hessian[POSE][POSE], POSE, POSE);
        let size = (hessian[POSE][POSE] * cost).sqrt();
        assert!((f64::from(seen.depth_right[0]) - right[POSE]).abs() < 0.002 * size);
    }
}

#[test]
fn all_instruction_sets_give_the_same_bits() {
    let mut random = Random::new(4);
    let pixels: Vec<u8> =
        (0..CAMERA.width * CAMERA.height).map(|_| (255.0 * random.uniform()) as u8).collect();
    let image = SharedImage::try_from_pixels(CAMERA.width, CAMERA.height, pixels.into()).unwrap();
    let robustness = Robustness { huber_grey: 9.0, most_energy: 8.0 * 900.0 };
    let mut counts = [0; 3];
    for round in 0..100 {
        let mut next = |low: f64, high: f64| low + (high - low) * random.uniform();
        let pose = SE3::exp(&Vector6::from_fn(|_, _| next(-0.2, 0.2)));
        let wanted = Wanted { poses: round % 2 == 0, depths: round % 3 != 0, host: round % 5 != 0 };
        let pair = Pair::new(&pose, &CAMERA, wanted);
        // Two blocks, the second not full.
        let mut patterns = [Patterns::NONE; 2];
        for k in 0..LANES + 5 {
            let (u, v, depth) = (next(4.0, 315.0), next(4.0, 235.0), next(0.0, 2.0) as f32);
            let appearance = appearance(&image, u as usize, v as usize);
            patterns[k / LANES].set(k % LANES, &appearance, ray(u, v));
            patterns[k / LANES].inverse_depth[k % LANES] = depth;
        }
        let run = |kernel: Kernel| {
            let (mut seen, mut sums) = ([Compared::NONE; 2], PairSums::default());
            kernel.compare(&image, &pair, &patterns, &robustness, &mut seen, &mut sums);
            (seen, sums)
        };
        let (seen, sums) = run(Kernel::Portable);
        for kernel in Kernel::available() {
            let (fast, fast_sums) = run(kernel);
            assert_eq!(fast_sums, sums, "{kernel:?}");
            for (fast, seen) in fast.iter().zip(&seen) {
                assert_eq!(fast.cost.map(f32::to_bits), seen.cost.map(f32::to_bits), "{kernel:?}");
                let rest = |of: &Compared| Compared { cost: [0.0; LANES], ..*of };
                assert_eq!(rest(fast), rest(seen), "{kernel:?}");
            }
        }
        for cost in seen[0].cost {
            counts[[cost.is_nan(), cost.is_infinite(), true].iter().position(|&is| is).unwrap()] +=
                1;
        }
    }
    assert!(counts.iter().all(|&count| count > 100), "{counts:?}");
}

#[test]
fn points_behind_a_mask_are_not_seen() {
    let image = waves(0.0);
    let appearance = appearance(&image, 100, 100);
    let pair = Pair::new(&SE3::identity(), &CAMERA, ALL_WANTED);
    let robustness = Robustness { huber_grey: 9.0, most_energy: 8.0 * 900.0 };
    let mut patterns = [Patterns::NONE];
    patterns[0].set(0, &appearance, ray(100.0, 100.0));
    patterns[0].set(1, &appearance, ray(100.0, 100.0));
    patterns[0].inverse_depth = [1.0; LANES];
    // Hidden entirely, in one pixel of the pattern, and next to it.
    for (hidden, is_seen) in [(0..CAMERA.width, false), (102..103, false), (106..107, true)] {
        let mut pixels = image.pixels().to_vec();
        pixels.chunks_exact_mut(CAMERA.width).for_each(|row| row[hidden.clone()].fill(0));
        let image =
            SharedImage::try_from_pixels(CAMERA.width, CAMERA.height, pixels.into()).unwrap();
        for kernel in Kernel::available() {
            let (mut seen, mut sums) = ([Compared::NONE], PairSums::default());
            kernel.compare(&image, &pair, &patterns, &robustness, &mut seen, &mut sums);
            assert_eq!(seen[0].cost[0].is_finite(), is_seen, "{kernel:?} {hidden:?}");
            assert_eq!(seen[0].cost[0].is_nan(), !is_seen, "{kernel:?} {hidden:?}");
            assert!(is_seen || sums == PairSums::default(), "{kernel:?} {hidden:?}");
        }
    }
}

#[test]
fn invalid_numbers_are_outside_the_image() {
    let image = waves(0.0);
    let appearance = appearance(&image, 100, 100);
    let pair = Pair::new(&SE3::identity(), &CAMERA, ALL_WANTED);
    let wild = [
        ([f32::NAN, 0.0], 1.0),
        ([0.0, 0.0], f32::NAN),
        ([0.0, 0.0], f32::INFINITY),
        ([f32::INFINITY, 0.0], 1.0),
        ([0.0, f32::NEG_INFINITY], 1.0),
        ([1e30, 0.0], 1.0),
    ];
    for kernel in Kernel::available() {
        for (ray, depth) in wild {
            let (seen, sums) = compare(kernel, &image, &pair, &appearance, ray, depth, &EASY);
            let all = sums.pose.iter().chain(&sums.right).chain(&seen.observer).chain(&seen.host);
            assert!(all.flatten().all(|number| number.is_finite()), "{ray:?} {depth}");
            assert!(seen.cost[1].is_nan() && seen.depth[0].is_finite(), "{ray:?} {depth}");
        }
        // An image smaller than the camera's is not read.
        let small = SharedImage::try_from_pixels(100, 50, [7; 5000].into()).unwrap();
        let (seen, _) = compare(kernel, &small, &pair, &appearance, ray(150.0, 100.0), 1.0, &EASY);
        assert!(seen.cost.iter().all(|cost| cost.is_nan()));
    }
}
