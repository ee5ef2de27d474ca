//! Time of the alignment: normal equations by level and kernel, pyramid, preparing a keyframe.
//!
//! `cargo bench --bench alignment`; throughput is in points, so that its inverse is the time per
//! point and iteration.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use semidense::slam::alignment::align::AlignmentParams;
use semidense::slam::alignment::kernel::Kernel;
use semidense::slam::alignment::reference::{Reference, ReferenceParams, num_levels};
use semidense::slam::alignment::residual::{Evaluation, accumulate_reference};
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::sums::SumPyramid;
use semidense::slam::keyframe::{DepthPoint, Keyframe, MapState};
use semidense::slam::pose::Brightness;
use semidense::slam::tracker::{Tracker, TrackerParams};

/// The sizes that cameras have: VGA, EuRoC, HD.
const SIZES: [(usize, usize); 3] = [(640, 480), (752, 480), (1280, 720)];

fn camera((width, height): (usize, usize)) -> Intrinsics {
    let focal = 0.82 * width as f64;
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    Intrinsics { fx: focal, fy: focal, cx, cy, width, height }
}

/// Waves of every length with noise, shifted by `shift` pixels.
fn image(camera: &Intrinsics, shift: f64) -> Vec<u8> {
    let mut seed = 1u32;
    let mut grey = |u: usize, v: usize| {
        let (u, v) = (u as f64 - shift, v as f64);
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let noise = f64::from(seed >> 24) / 64.0 - 2.0;
        let coarse = 45.0 * (0.031 * u + 0.4).sin() * (0.027 * v).cos();
        let fine = 35.0 * (0.23 * u + 0.05 * v).sin() * (0.19 * v - 0.03 * u).sin();
        (128.0 + coarse + fine + noise) as u8
    };
    let (width, height) = (camera.width, camera.height);
    (0..width * height).map(|i| grey(i % width, i / width)).collect()
}

/// A keyframe with depth at every fifth pixel: 60 000 points at 640×480.
fn keyframe(camera: &Intrinsics) -> Keyframe {
    let image = image(camera, 0.0);
    let width = camera.width;
    let pixels = (0..image.len()).step_by(5);
    let points = pixels.map(|i| DepthPoint {
        u: (i % width) as u16,
        v: (i / width) as u16,
        inverse_depth: 1.0,
        variance: 1e-3,
        intensity: f32::from(image[i]),
    });
    Keyframe {
        keyframe_id: 0,
        epoch: 0,
        revision: 0,
        sequence: 0,
        capture_nanos: 0,
        map_state: MapState::Established,
        world_from_keyframe: Sim3::identity(),
        intrinsics: *camera,
        points: points.take(100_000).collect(),
        image,
    }
}

fn normal_equations(criterion: &mut Criterion) {
    let camera = camera(SIZES[0]);
    let params = ReferenceParams { finest_level: 0, ..ReferenceParams::default() };
    let mut reference = Reference::new(params);
    reference.prepare_into(&keyframe(&camera));
    let levels = num_levels(camera.width, camera.height);
    let mut pyramid = SumPyramid::with_size(camera.width, camera.height, levels, 0);
    pyramid.fill(&image(&camera, 1.3));
    let mut group = criterion.benchmark_group("normal_equations");
    for level in 0..levels {
        let points = reference.level(level);
        let weighting = AlignmentParams::default().weighting(level);
        let intrinsics = camera.at_level(level);
        let (pose, brightness) = (SE3::identity(), Brightness::default());
        let at =
            Evaluation::new(&intrinsics, level, &pose, brightness, &weighting, &pose.translation);
        group.throughput(Throughput::Elements(points.len() as u64));
        group.bench_function(BenchmarkId::new("Reference", level), |bencher| {
            bencher.iter(|| accumulate_reference(black_box(points), pyramid.level(level), &at));
        });
        for kernel in Kernel::available() {
            group.bench_function(BenchmarkId::new(format!("{kernel:?}"), level), |bencher| {
                bencher.iter(|| kernel.accumulate(black_box(points), pyramid.level(level), &at));
            });
        }
    }
    group.finish();
}

fn whole_frame(criterion: &mut Criterion) {
    for size in SIZES {
        let camera = camera(size);
        let name = format!("{}x{}", size.0, size.1);
        let levels = num_levels(size.0, size.1);
        let images = [image(&camera, 1.3), image(&camera, 2.6)];
        let mut pyramid = SumPyramid::with_size(size.0, size.1, levels, 1);
        criterion.bench_function(&format!("pyramid/{name}"), |bencher| {
            bencher.iter(|| pyramid.fill(black_box(&images[0])));
        });
        let keyframe = keyframe(&camera);
        let mut reference = Reference::new(ReferenceParams::default());
        criterion.bench_function(&format!("prepare/{name}"), |bencher| {
            bencher.iter(|| reference.prepare_into(black_box(&keyframe)));
        });
        let Ok(mut tracker) = Tracker::new(camera, TrackerParams::default()) else { return };
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        let mut sequence = 0;
        criterion.bench_function(&format!("track/{name}"), |bencher| {
            bencher.iter(|| {
                sequence += 1;
                let frame = FrameView {
                    sequence,
                    capture_nanos: sequence as i64 * 33_000_000,
                    exposure_nanos: 0,
                    width: size.0,
                    height: size.1,
                    pixels: &images[sequence as usize % 2],
                };
                tracker.track(black_box(&frame), &mut |_| true)
            });
        });
    }
}

criterion_group!(benches, normal_equations, whole_frame);
criterion_main!(benches);
