//! The printed tables: the loop over points compared with the machine's peak, durations of a frame's parts.

use std::hint::black_box;
use std::time::Instant;

use semidense::slam::alignment::align::AlignmentParams;
use semidense::slam::alignment::points::{LANES, PointBlock};
use semidense::slam::alignment::reference::{
    Reference, ReferenceParams, ReferenceScratch, num_levels,
};
use semidense::slam::alignment::residual::Evaluation;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::sums::SumPyramid;
use semidense::slam::kernel::{Kernel, SimdMode};
use semidense::slam::pose::Brightness;
use semidense::slam::tracker::{Tracker, TrackerParams};

use crate::roofline::{bandwidth, best_nanos, peak_gflops};
use crate::scene::{SIZES, camera, frame, image, keyframe};

/// Operations to whiten a point, as in `accumulate_kernel::whiten`, with a fused multiply-add counted twice, and
/// comparisons, selections and conversions not at all: two warps 47, the sample 12, residual 3, gradient 27, variance
/// and weight 19, sums 5, the nine columns 23.
const WHITEN_FLOPS: f64 = 136.0;

/// The products of the columns: 36 for the information, 8 for the gradient, each a multiply-add.
const PRODUCT_FLOPS: f64 = 88.0;

/// Bytes that a point loads from memory: its eight floats, read once and in order …
const POINT_BYTES: f64 = (size_of::<PointBlock>() / LANES) as f64;

/// … and four pixels of 16 bits around its projection. The columns stay in the first-level cache.
const PIXEL_BYTES: f64 = 8.0;

/// Frames in a table of durations: the 99th percentile is then the 20th longest.
const FRAMES: usize = 2000;

/// Keyframes in a table of durations.
const KEYFRAMES: usize = 500;

/// Frames before the first one that counts, to warm up caches and branch predictors.
const WARM_UP: usize = 50;

/// A scene with everything that a frame needs.
struct Stage {
    camera: Intrinsics,
    images: [Vec<u8>; 2],
    reference: Reference,
    pyramid: SumPyramid,
}

impl Stage {
    fn new(size: (usize, usize), finest_level: usize) -> Self {
        let camera = camera(size);
        let images = [image(&camera, 1.3), image(&camera, 2.6)];
        let params = ReferenceParams { finest_level, ..ReferenceParams::default() };
        let mut reference = Reference::new(params);
        reference.prepare_into(&keyframe(&camera), &mut ReferenceScratch::default());
        let levels = num_levels(size.0, size.1);
        let mut pyramid = SumPyramid::with_size(size.0, size.1, levels, finest_level);
        pyramid.fill(&images[0]);
        Self { camera, images, reference, pyramid }
    }

    fn evaluation(&self, level: usize) -> Evaluation {
        let pose = SE3::identity();
        Evaluation::new(
            &self.camera.at_level(level),
            level,
            &pose,
            Brightness::default(),
            &AlignmentParams::default(),
            &pose.translation,
        )
    }
}

/// Prints all tables.
pub fn print() {
    print_roofline();
    print_times();
}

/// The loop over points on each level compared with the machine's peak.
fn print_roofline() {
    let stage = Stage::new(SIZES[0], 0);
    println!(
        "The loop over points at 640×480, best of many: shares are of this machine's measured"
    );
    println!("peak of multiply-adds and of reading a level's points and pixels in order.\n");
    println!(
        "kernel    level  points  ns/point  GFLOP/s  of peak   GB/s  of peak  scatter ns/point"
    );
    for kernel in Kernel::available() {
        let peak = peak_gflops(kernel);
        for level in 0..stage.pyramid.num_levels() {
            let (points, image) = (stage.reference.level(level), stage.pyramid.level(level));
            let at = stage.evaluation(level);
            let per_point = |nanos: f64| nanos / points.len() as f64;
            let nanos = per_point(best_nanos(|| {
                black_box(kernel.accumulate(black_box(points), image, &at));
            }));
            let scatter = per_point(best_nanos(|| {
                black_box(kernel.scatter(black_box(points), image, &at));
            }));
            let working_set = size_of_val(points.blocks()) + size_of_val(image.pixels());
            let gflops = (WHITEN_FLOPS + PRODUCT_FLOPS) / nanos;
            let gbytes = (POINT_BYTES + PIXEL_BYTES) / nanos;
            println!(
                "{:<9} {level:>5}  {:>6}  {nanos:>8.2}  {gflops:>7.1}  {:>5.0} %  {gbytes:>5.1}  {:>5.0} %  {scatter:>16.2}",
                format!("{kernel:?}"),
                points.len(),
                100.0 * gflops / peak,
                100.0 * gbytes / bandwidth(working_set),
            );
        }
        println!("{:<9} peak {peak:.0} GFLOP/s\n", format!("{kernel:?}"));
    }
}

/// Durations of the parts of a frame and of a whole one.
fn print_times() {
    println!(
        "Times in milliseconds, fastest kernel, default parameters; the least is the one that"
    );
    println!("nothing else disturbed:\n");
    println!("size      what                                    least median    p95    p99    max");
    for size in SIZES {
        let mut stage = Stage::new(size, 1);
        let name = format!("{}x{}", size.0, size.1);
        let Stage { pyramid, images, .. } = &mut stage;
        let times = times(FRAMES, |i| pyramid.fill(black_box(&images[i % 2])));
        row(&name, "pyramid (gradients are the keyframe's)", times);
        let keyframe = keyframe(&stage.camera);
        let prepared = format!("prepare a keyframe of {} points", keyframe.points.len());
        let (reference, mut scratch) = (&mut stage.reference, ReferenceScratch::default());
        let times =
            self::times(KEYFRAMES, |_| reference.prepare_into(black_box(&keyframe), &mut scratch));
        row(&name, &prepared, times);
        let (kernel, at) = (Kernel::choose(SimdMode::Auto), stage.evaluation(1));
        let (points, image) = (stage.reference.level(1), stage.pyramid.level(1));
        let times = self::times(FRAMES, |_| {
            black_box(kernel.scatter(black_box(points), image, &at));
        });
        row(&name, "scatter of the gradient", times);
        let Ok(mut tracker) = Tracker::new(stage.camera, TrackerParams::default()) else { return };
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        let times = self::times(FRAMES, |i| {
            let frame = frame(i as u64, &stage.camera, &stage.images[i % 2]);
            black_box(tracker.track(black_box(&frame), &mut |_| true));
        });
        row(&name, "whole track", times);
    }
    println!();
}

/// Durations of `count` runs after the warm-up, milliseconds, ascending.
fn times(count: usize, mut run: impl FnMut(usize)) -> Vec<f64> {
    let mut times = Vec::with_capacity(count);
    for i in 0..WARM_UP + count {
        let begin = Instant::now();
        run(i);
        if i >= WARM_UP {
            times.push(begin.elapsed().as_secs_f64() * 1e3);
        }
    }
    times.sort_by(f64::total_cmp);
    times
}

fn row(size: &str, what: &str, times: Vec<f64>) {
    let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
    println!(
        "{size:<9} {what:<38} {:>6.3} {:>6.3} {:>6.3} {:>6.3} {:>6.3}",
        at(0.0),
        at(0.5),
        at(0.95),
        at(0.99),
        at(1.0)
    );
}
