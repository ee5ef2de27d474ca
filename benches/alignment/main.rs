//! Duration of the alignment: `cargo bench --bench alignment`.
//!
//! First two tables: the loop over points by level and kernel compared with the machine's peak, and the durations of a
//! frame's parts with their percentiles. Then criterion, which compares with the previous run; its throughput is in
//! points, so that the inverse is the time per point and iteration. A filter on the command line skips the tables.

mod roofline;
mod scene;
mod tables;

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group};
use semidense::slam::alignment::align::AlignmentParams;
use semidense::slam::alignment::reference::{
    Reference, ReferenceParams, ReferenceScratch, num_levels,
};
use semidense::slam::alignment::residual::{Evaluation, accumulate_reference};
use semidense::slam::alignment::scatter::GradientScatter;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::sums::SumPyramid;
use semidense::slam::kernel::Kernel;
use semidense::slam::pose::Brightness;
use semidense::slam::tracker::{Tracker, TrackerParams};

use crate::scene::{SIZES, camera, frame, image, keyframe};

fn normal_equations(criterion: &mut Criterion) {
    let camera = camera(SIZES[0]);
    let params = ReferenceParams { finest_level: 0, ..ReferenceParams::default() };
    let mut reference = Reference::new(params);
    reference.prepare_into(&keyframe(&camera), &mut ReferenceScratch::default());
    let levels = num_levels(camera.width, camera.height);
    let mut pyramid = SumPyramid::with_size(camera.width, camera.height, levels, 0);
    pyramid.fill(&image(&camera, 1.3));
    for level in 0..levels {
        let (points, image) = (reference.level(level), pyramid.level(level));
        let params = AlignmentParams::default();
        let (pose, brightness) = (SE3::identity(), Brightness::default());
        let intrinsics = camera.at_level(level);
        let at = Evaluation::new(&intrinsics, level, &pose, brightness, &params, &pose.translation);
        let mut group = criterion.benchmark_group("normal_equations");
        group.throughput(Throughput::Elements(points.len() as u64));
        group.bench_function(BenchmarkId::new("Reference", level), |bencher| {
            bencher.iter(|| accumulate_reference(black_box(points), image, &at));
        });
        for kernel in Kernel::available() {
            group.bench_function(BenchmarkId::new(format!("{kernel:?}"), level), |bencher| {
                bencher.iter(|| kernel.accumulate(black_box(points), image, &at));
            });
        }
        group.finish();
        let mut group = criterion.benchmark_group("scatter");
        group.throughput(Throughput::Elements(points.len() as u64));
        group.bench_function(BenchmarkId::new("Reference", level), |bencher| {
            bencher.iter(|| GradientScatter::reference(black_box(points), image, &at));
        });
        for kernel in Kernel::available() {
            group.bench_function(BenchmarkId::new(format!("{kernel:?}"), level), |bencher| {
                bencher.iter(|| kernel.scatter(black_box(points), image, &at));
            });
        }
        group.finish();
    }
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
        let mut scratch = ReferenceScratch::default();
        criterion.bench_function(&format!("prepare/{name}"), |bencher| {
            bencher.iter(|| reference.prepare_into(black_box(&keyframe), &mut scratch));
        });
        let Ok(mut tracker) = Tracker::new(camera, TrackerParams::default()) else { return };
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        let mut sequence = 0;
        criterion.bench_function(&format!("track/{name}"), |bencher| {
            bencher.iter(|| {
                sequence += 1;
                let frame = frame(sequence, &camera, &images[sequence as usize % 2]);
                tracker.track(black_box(&frame), &mut |_| true)
            });
        });
    }
}

criterion_group!(benches, normal_equations, whole_frame);

fn main() {
    let mut arguments = std::env::args().skip(1);
    // Cargo itself passes --bench; a filter, or --test, needs no tables.
    if arguments.all(|argument| argument == "--bench") {
        tables::print();
    }
    benches();
    Criterion::default().configure_from_args().final_summary();
}
