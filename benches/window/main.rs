//! What the joint estimation costs: `cargo bench --bench window`.
//!
//! First one comparison of a pattern with its derivatives, by kernel; then an estimate of the newest keyframes after
//! each new one of a walk through the simulated room, with the frames since the one before, on one core, against the
//! number of keyframes that there are: 100, or `cargo bench --bench window -- 1000`.

use std::hint::black_box;
use std::time::Instant;

use rustix::time::{ClockId, clock_gettime};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::slam::alignment::kernel::Kernel;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::buffer::Image;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::map::Map;
use semidense::slam::window::Window;
use semidense::slam::window::comparison::{
    Compared, LANES, Look, Pair, PairSums, Patterns, Robustness, SAMPLES, Wanted,
};
use semidense::slam::window::frames::TrackedFrame;
use semidense::slam::window::params::WindowParams;

/// Frames from a keyframe to the next.
const INTERVAL: usize = 12;
/// Keyframes, unless a number is given.
const KEYFRAMES: usize = 100;
/// Patterns of a kernel's measurement: the points of a keyframe in seven others.
const PATTERNS: usize = 2_100;
/// Repetitions of it.
const REPEATS: usize = 200;
/// Smallest difference of neighbours of a pixel that gets depth, grey levels.
const MIN_STEP: i32 = 8;

fn main() {
    let number = std::env::args().find_map(|argument| argument.parse().ok());
    let keyframes: usize = number.unwrap_or(KEYFRAMES);
    let params = SimulatorParams { frames: keyframes * INTERVAL, ..SimulatorParams::default() };
    let mut simulator =
        Simulator::new(params).expect("default values are valid but for the frames");
    let camera = simulator.intrinsics();
    let frame = simulator.raw_frame(0).expect("within the sequence").into_owned();
    comparisons(&camera, &frame);
    walk(&mut simulator, &camera, keyframes);
}

/// Nanoseconds of a comparison, by kernel.
fn comparisons(camera: &Intrinsics, pixels: &[u8]) {
    let image = Image::try_from_pixels(camera.width, camera.height, pixels.to_vec())
        .expect("a frame has the camera's pixels");
    let observer_from_host = SE3 { translation: [0.05, 0.01, 0.0].into(), ..SE3::identity() };
    let wanted = Wanted { poses: true, depths: true, host: true };
    let pair = Pair::new(&observer_from_host, camera, wanted);
    // All count: the derivatives are made for each.
    let robustness = Robustness { huber_grey: 9.0, most_energy: f32::INFINITY };
    let look = Look { shape: [1.0; SAMPLES], weight: [0.5; SAMPLES] };
    let mut patterns = vec![Patterns::NONE; PATTERNS.div_ceil(LANES)];
    for i in 0..PATTERNS {
        let (u, v) = (60 + (i * 37) % (camera.width - 120), 60 + (i * 53) % (camera.height - 120));
        let at = |pixel: usize, centre: f64, focal: f64| ((pixel as f64 - centre) / focal) as f32;
        let ray = [at(u, camera.cx, camera.fx), at(v, camera.cy, camera.fy)];
        patterns[i / LANES].set(i % LANES, &look, ray);
        patterns[i / LANES].inverse_depth[i % LANES] = 0.5;
    }
    println!(
        "one comparison of {SAMPLES} samples with derivatives, ns, best of {REPEATS} × {PATTERNS}"
    );
    let mut seen = vec![Compared::NONE; patterns.len()];
    for kernel in Kernel::available() {
        let mut best = f64::INFINITY;
        for _ in 0..REPEATS {
            let mut sums = PairSums::default();
            let begin = Instant::now();
            kernel.compare(&image, &pair, &patterns, &robustness, &mut seen, &mut sums);
            let elapsed = begin.elapsed().as_secs_f64();
            let counted = seen.iter().flat_map(|of| of.cost).filter(|cost| cost.is_finite());
            best = best.min(elapsed / counted.count().max(1) as f64);
            black_box(&sums);
        }
        println!("{:20} {:6.1}", format!("{kernel:?}"), 1e9 * best);
    }
}

/// Milliseconds of an estimate with the frames that are aligned again, against the number of keyframes.
fn walk(simulator: &mut Simulator, camera: &Intrinsics, keyframes: usize) {
    let truth = simulator.ground_truth().to_vec();
    let world_from_first = truth[0].world_from_camera;
    let mut window = Window::new(*camera, WindowParams::default());
    let mut map = Map::default();
    let (mut frames, mut spare) = (Vec::new(), Vec::new());
    let mut times = Vec::new();
    println!("\nestimate after each new keyframe, ms of one core");
    println!(
        "{:>9} {:>9} {:>12} {:>12} {:>7} {:>9} {:>9}",
        "keyframes", "free+held", "comparisons", "iterations", "frames", "snapshot", "estimate"
    );
    for id in 0..keyframes {
        let index = id * INTERVAL;
        let world_from_keyframe = truth[index].world_from_camera;
        let place = world_from_first.inverse() * world_from_keyframe;
        map.keyframes.push(keyframe(simulator, camera, id as u64, index, place));
        let begin = cpu_secs();
        if window.take_in(&map, id as u64) {
            window.take_frames(&mut frames, &mut spare);
            let snapshot = cpu_secs() - begin;
            let begin = cpu_secs();
            let adjusted = window.optimise();
            let estimate = cpu_secs() - begin;
            let placed = window.take_placed().len();
            if id >= WindowParams::default().num_first {
                times.push(estimate);
            }
            if let Some(adjusted) = adjusted
                && (id + 1) % (keyframes / 10).max(1) == 0
            {
                let members = format!("{}+{}", adjusted.free, adjusted.fixed);
                let (compared, iterations) = (adjusted.comparisons, adjusted.iterations);
                let [snapshot, estimate] = [snapshot, estimate].map(|secs| 1e3 * secs);
                println!(
                    "{:9} {members:>9} {compared:12} {iterations:12} {placed:7} {snapshot:9.2} {estimate:9.1}",
                    id + 1
                );
            }
        }
        for between in index + 1..index + INTERVAL {
            let world_from_camera = truth[between].world_from_camera;
            frames.push(TrackedFrame {
                sequence: between as u64,
                keyframe_id: id as u64,
                keyframe_from_camera: world_from_keyframe.inverse() * world_from_camera,
                is_guess: false,
                pixels: simulator.raw_frame(between).expect("within the sequence").into_owned(),
            });
        }
    }
    times.sort_by(f64::total_cmp);
    let at = |share: f64| 1e3 * times[((times.len() - 1) as f64 * share) as usize];
    println!(
        "after the first keyframes: {:.1} ms median, {:.1} p99 of {}",
        at(0.5),
        at(0.99),
        times.len()
    );
}

/// A keyframe at its true place, with exact depth where there is gradient.
fn keyframe(
    simulator: &mut Simulator,
    camera: &Intrinsics,
    id: u64,
    index: usize,
    place: SE3,
) -> Keyframe {
    let image = simulator.raw_frame(index).expect("within the sequence").into_owned();
    let nanos = simulator.ground_truth()[index].nanos;
    let depth = simulator.depth_at(nanos).ok().flatten().expect("the simulator has exact depth");
    let width = camera.width;
    let mut points = Vec::new();
    for v in 4..camera.height - 4 {
        for u in 4..width - 4 {
            let at = |u: usize, v: usize| i32::from(image[v * width + u]);
            let step = (at(u + 1, v) - at(u - 1, v)).abs() + (at(u, v + 1) - at(u, v - 1)).abs();
            let z = depth.at(u, v);
            if step < 2 * MIN_STEP || !(z > 0.0) {
                continue;
            }
            let intensity = f32::from(image[v * width + u]);
            points.push(DepthPoint {
                u: u as u16,
                v: v as u16,
                inverse_depth: 1.0 / z,
                variance: 1e-4,
                intensity,
            });
        }
    }
    let mut keyframe = Keyframe::at(Sim3::new(place, 1.0), *camera, points, image);
    keyframe.keyframe_id = id;
    keyframe
}

/// CPU time of this thread, seconds.
fn cpu_secs() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
