//! Cost of the joint estimation: `cargo bench --bench window`.
//!
//! First one comparison of a pattern with its derivatives, by kernel; then an estimate of the newest keyframes after
//! each new one of a walk through the simulated room, with the frames since the previous one, on one core, against the
//! number of keyframes: 100, or the number given. The plot of the documentation is made by `cargo bench --bench window
//! -- 1000 --without-frames --plot docs/window-cost.svg`: a long walk spends most of its time in the simulator, which
//! renders the frames between keyframes.

use std::hint::black_box;
use std::time::Instant;

use rustix::time::{ClockId, clock_gettime};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::service::results::report::chart::{Chart, Scaling, svg_file};
use semidense::service::results::report::series::{Mark, Series};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::shared::SharedImage;
use semidense::slam::kernel::Kernel;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::map::Map;
use semidense::slam::modes::ModeCovariance;
use semidense::slam::window::comparison::{
    Compared, LANES, Pair, PairSums, PatternAppearance, Patterns, Robustness, SAMPLES, Wanted,
};
use semidense::slam::window::frames::TrackedFrame;
use semidense::slam::window::params::WindowParams;
use semidense::slam::window::{Adjustment, Window};

/// Frames from one keyframe to the next.
const INTERVAL: usize = 12;
/// Keyframes, unless a number is given.
const KEYFRAMES: usize = 100;
/// Patterns in the measurement of a kernel: the points of a keyframe in seven others.
const PATTERNS: usize = 2_100;
/// Repetitions of that measurement.
const REPEATS: usize = 200;
/// Minimum difference to a neighbour for a pixel to get depth, grey levels.
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
    let has_frames = std::env::args().all(|argument| argument != "--without-frames");
    let costs = walk(&mut simulator, &camera, keyframes, has_frames);
    table(&costs);
    if let Some(path) = std::env::args().skip_while(|argument| argument != "--plot").nth(1) {
        plot(&costs, &path).expect("the plot can be written");
    }
}

/// Duration of a comparison by kernel, nanoseconds.
fn comparisons(camera: &Intrinsics, pixels: &[u8]) {
    let image = SharedImage::try_from_pixels(camera.width, camera.height, pixels.into())
        .expect("a frame has the camera's pixels");
    let observer_from_host = SE3 { translation: [0.05, 0.01, 0.0].into(), ..SE3::identity() };
    let wanted = Wanted { poses: true, depths: true, host: true };
    let pair = Pair::new(&observer_from_host, camera, wanted);
    // No pattern is an outlier: derivatives are computed for each.
    let robustness = Robustness { huber_grey: 9.0, most_energy: f32::INFINITY };
    let appearance = PatternAppearance { shape: [1.0; SAMPLES], weight: [0.5; SAMPLES] };
    let mut patterns = vec![Patterns::NONE; PATTERNS.div_ceil(LANES)];
    for i in 0..PATTERNS {
        let (u, v) = (60 + (i * 37) % (camera.width - 120), 60 + (i * 53) % (camera.height - 120));
        let at = |pixel: usize, centre: f64, focal: f64| ((pixel as f64 - centre) / focal) as f32;
        let ray = [at(u, camera.cx, camera.fx), at(v, camera.cy, camera.fy)];
        patterns[i / LANES].set(i % LANES, &appearance, ray);
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

/// Cost of a new keyframe.
struct Cost {
    /// Number of keyframes at that time.
    keyframes: usize,
    free: usize,
    fixed: usize,
    comparisons: usize,
    /// Copying the changes of the map, the estimate with the frames that are aligned again, if any, and applying it to
    /// the map: CPU time of one core, seconds.
    snapshot: f64,
    estimate: f64,
    correction: f64,
    /// Memory of the process in excess of the map's images and depth, bytes.
    memory: f64,
}

/// Costs of each new keyframe of a walk.
fn walk(
    simulator: &mut Simulator,
    camera: &Intrinsics,
    keyframes: usize,
    has_frames: bool,
) -> Vec<Cost> {
    let truth = simulator.ground_truth().to_vec();
    let world_from_first = truth[0].world_from_camera;
    let mut window = Window::new(*camera, WindowParams::default());
    let mut map = Map::default();
    let mut frames = Vec::new();
    let mut costs = Vec::new();
    for id in 0..keyframes {
        let index = id * INTERVAL;
        let world_from_keyframe = truth[index].world_from_camera;
        let place = world_from_first.inverse() * world_from_keyframe;
        map.keyframes.push(keyframe(simulator, camera, id as u64, index, place));
        let begin = cpu_secs();
        if window.update_from_map(&map, id as u64) {
            window.take_frames(&mut frames);
            let snapshot = cpu_secs() - begin;
            let begin = cpu_secs();
            let adjusted = window.optimise();
            let estimate = cpu_secs() - begin;
            let begin = cpu_secs();
            black_box(window.correction(&map, |_| (ModeCovariance::ZERO, None)));
            let correction = cpu_secs() - begin;
            drop(window.take_realigned());
            if let Some(Adjustment { free, fixed, comparisons, .. }) = adjusted {
                let (keyframes, memory) = (id + 1, resident_bytes() - map_bytes(&map));
                costs.push(Cost {
                    keyframes,
                    free,
                    fixed,
                    comparisons,
                    snapshot,
                    estimate,
                    correction,
                    memory,
                });
            }
        }
        let end = if has_frames { index + INTERVAL } else { index };
        for between in index + 1..end {
            let world_from_camera = truth[between].world_from_camera;
            frames.push(TrackedFrame {
                repeats: Vec::new(),
                sequence: between as u64,
                keyframe_id: id as u64,
                keyframe_from_camera: world_from_keyframe.inverse() * world_from_camera,
                is_guess: false,
                pixels: simulator
                    .raw_frame(between)
                    .expect("within the sequence")
                    .into_owned()
                    .into(),
            });
        }
    }
    costs
}

/// Prints medians over the keyframes from one row to the next.
fn table(costs: &[Cost]) {
    println!("\nafter each new keyframe, medians from row to row; ms of one core");
    println!(
        "{:>9} {:>9} {:>12} {:>9} {:>9} {:>11} {:>10}",
        "keyframes", "free+held", "comparisons", "snapshot", "estimate", "correction", "memory, MB"
    );
    let mut begin = 0;
    for end in (10..100).step_by(10).chain((100..).step_by(100)) {
        let row: Vec<&Cost> =
            costs.iter().filter(|cost| (begin + 1..=end).contains(&cost.keyframes)).collect();
        let Some(last) = row.last().filter(|last| last.keyframes == end) else { break };
        let of = |value: fn(&Cost) -> f64| share_of(row.iter().map(|cost| value(cost)), 0.5);
        println!(
            "{end:9} {:>9} {:12.0} {:9.2} {:9.1} {:11.2} {:10.1}",
            format!("{:.0}+{:.0}", of(|cost| cost.free as f64), of(|cost| cost.fixed as f64)),
            of(|cost| cost.comparisons as f64),
            1e3 * of(|cost| cost.snapshot),
            1e3 * of(|cost| cost.estimate),
            1e3 * of(|cost| cost.correction),
            1e-6 * last.memory,
        );
        begin = end;
    }
    let after_first =
        costs.iter().filter(|cost| cost.keyframes > WindowParams::default().num_first);
    let estimates: Vec<f64> = after_first.map(|cost| 1e3 * cost.estimate).collect();
    println!(
        "after the first keyframes: {:.1} ms median, {:.1} p99 of {}",
        share_of(estimates.iter().copied(), 0.5),
        share_of(estimates.iter().copied(), 0.99),
        estimates.len()
    );
    if let [first, .., last] = costs {
        let keyframes = (last.keyframes - first.keyframes) as f64;
        let each = (last.memory - first.memory) / keyframes;
        println!("memory beside the map's images and depth: {:.2} MB a keyframe", 1e-6 * each);
    }
}

/// Plots every keyframe's costs as dots, and their medians.
fn plot(costs: &[Cost], path: &str) -> std::io::Result<()> {
    let chart = |title, value: fn(&Cost) -> f64| {
        let points: Vec<[f64; 2]> =
            costs.iter().map(|cost| [cost.keyframes as f64, 1e3 * value(cost)]).collect();
        let medians = points.chunks((points.len() / 20).max(1)).map(|chunk| {
            let x = chunk.iter().map(|[x, _]| x).sum::<f64>() / chunk.len() as f64;
            [x, share_of(chunk.iter().map(|[_, y]| *y), 0.5)]
        });
        let median = Series {
            name: "median",
            colour: "#d6455d",
            mark: Mark::Line,
            points: medians.collect(),
        };
        let each = Series { name: "", colour: "#b4bccb", mark: Mark::Dots(1.2), points };
        Chart {
            title,
            meaning: "Time as the map grows; it should stay level.",
            x_label: "keyframes".to_owned(),
            y_label: "ms of one core".to_owned(),
            height: 260.0,
            scaling: Scaling::FromZero,
            series: vec![each, median],
        }
    };
    let charts = [
        chart("An estimate of the newest keyframes", |cost| cost.estimate),
        chart("Mapper: copy of what is new, and the correction", |cost| {
            cost.snapshot + cost.correction
        }),
    ];
    std::fs::write(path, svg_file(&charts, 2))
}

/// The quantile `share` of the values; 0 without values.
fn share_of(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let place = (values.len().saturating_sub(1) as f64 * share) as usize;
    values.get(place).copied().unwrap_or(0.0)
}

/// Resident memory of the process, bytes.
fn resident_bytes() -> f64 {
    /// Size of a page, bytes.
    const PAGE: f64 = 4096.0;
    let text = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = text.split_whitespace().nth(1).and_then(|pages| pages.parse::<f64>().ok());
    PAGE * pages.unwrap_or(0.0)
}

/// Bytes of the map's images and depth.
fn map_bytes(map: &Map) -> f64 {
    let bytes = |keyframe: &Keyframe| {
        keyframe.image.len() + keyframe.points.capacity() * size_of::<DepthPoint>()
    };
    map.keyframes.iter().map(bytes).sum::<usize>() as f64
}

/// A keyframe at its true pose, with exact depth where there is gradient.
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
    points.shrink_to_fit();
    let mut keyframe = Keyframe::at(Sim3::new(place, 1.0), *camera, points, image);
    keyframe.keyframe_id = id;
    keyframe
}

/// CPU time of this thread, seconds.
fn cpu_secs() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
