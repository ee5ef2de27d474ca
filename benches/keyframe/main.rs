//! Cost of a new keyframe, by stage and in total, on one and on two threads: `cargo bench --bench keyframe`, with a
//! word to select the stages whose names contain it.

use std::time::Instant;

use rustix::time::{ClockId, clock_gettime};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::gaussian::{GaussianParams, ObservedPixels, Observer, observe};
use semidense::slam::depth::map::{DepthMap, Hypothesis};
use semidense::slam::depth::matching::MatchingParams;
use semidense::slam::depth::propagation::{PropagationParams, propagate};
use semidense::slam::depth::regularisation::{
    RegularisationParams, RegularisationScratch, regularise,
};
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::keyframe::MAX_KEYFRAME_POINTS;
use semidense::slam::mapper::{Mapper, MapperParams};
use semidense::slam::pose::{Brightness, PoseEstimate, TrackingState};

/// The frame of the first keyframe, in the middle of the path through the room.
const FIRST: usize = 120;
/// Frames from one keyframe to the next.
const INTERVAL: usize = 10;
/// Total number of frames.
const FRAMES: usize = 61;
/// Repetitions of a stage.
const REPEATS: usize = 21;

/// A section of a simulated sequence.
struct Sequence {
    simulator: Simulator,
    frames: Vec<Vec<u8>>,
}

impl Sequence {
    fn render() -> Self {
        let simulator =
            Simulator::new(SimulatorParams::default()).expect("default values are valid");
        let frame = |k| simulator.raw_frame(FIRST + k).expect("within the sequence").into_owned();
        let frames = (0..FRAMES).map(frame).collect();
        Self { simulator, frames }
    }

    /// Pose of a frame in the camera of the first.
    fn first_from(&self, frame: usize) -> SE3 {
        let truth = self.simulator.ground_truth();
        truth[FIRST].world_from_camera.inverse() * truth[FIRST + frame].world_from_camera
    }

    fn view(&self, of: usize, seen_from: usize) -> TwoView {
        let of_from_other = self.first_from(of).inverse() * self.first_from(seen_from);
        TwoView::new(&self.simulator.intrinsics(), &of_from_other.inverse())
    }
}

fn main() {
    let sequence = Sequence::render();
    let pools = [1, 2].map(|threads| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be made")
    });
    println!("ms, least / median of {REPEATS}; in brackets the processor's time of the one thread");
    println!("{:44} {:>25} {:>15}", "stage", "1 thread", "2 threads");
    stages(&sequence, &pools);
    whole(&sequence, &pools);
}

/// Times one stage in every pool; `prepare` is not included.
fn row<T>(
    name: &str,
    pools: &[rayon::ThreadPool],
    prepare: impl Fn() -> T,
    mut stage: impl FnMut(&mut T) + Send,
) where
    T: Send,
{
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    if !wanted.is_empty() && !wanted.iter().any(|word| name.contains(word)) {
        return;
    }
    print!("{name:44}");
    for pool in pools {
        let (mut times, mut busy) = (Vec::new(), Vec::new());
        for _ in 0..REPEATS {
            let mut prepared = prepare();
            let begin = Instant::now();
            busy.push(pool.install(|| {
                let begin = processor_ms();
                stage(&mut prepared);
                processor_ms() - begin
            }));
            times.push(begin.elapsed().as_secs_f64() * 1e3);
        }
        print!(" {:>15}", spread(times));
        if pool.current_num_threads() == 1 {
            print!(" ({:>6.2})", median(busy));
        }
    }
    println!();
}

/// CPU time of this thread, ms: unlike wall time, it does not grow with the load of the machine.
fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// The minimum and the median.
fn spread(times: Vec<f64>) -> String {
    let least = times.iter().copied().fold(f64::INFINITY, f64::min);
    format!("{least:.2} / {:.2}", median(times))
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(f64::NAN)
}

fn stages(sequence: &Sequence, pools: &[rayon::ThreadPool]) {
    let camera = sequence.simulator.intrinsics();
    let (width, height) = (camera.width, camera.height);
    let (matching, gaussian) = (MatchingParams::default(), GaussianParams::default());
    let (carrying, smoothing) = (PropagationParams::default(), RegularisationParams::default());
    let mut before = DepthMap::with_size(width, height);
    before.restart(&sequence.frames[0], 5.0, MAX_KEYFRAME_POINTS);
    let sensor = sequence.simulator.raw_depth(FIRST).expect("within the sequence");
    let candidates = before.candidates.clone();
    let pixels = before.hypotheses.pixels_mut().iter_mut().zip(candidates.pixels());
    for ((h, _), depth) in pixels.zip(sensor.pixels()).filter(|((_, candidate), _)| **candidate) {
        let (inverse_depth, variance) = (1.0 / depth, (0.05 / depth).powi(2));
        let smoothed = inverse_depth;
        *h = Hypothesis { inverse_depth, variance, smoothed, validity: 8, ..Hypothesis::NONE };
    }
    let mut quads = QuadImage::with_size(width, height);
    quads.fill(&sequence.frames[INTERVAL]);
    let observer = Observer {
        image: &quads,
        view: sequence.view(0, INTERVAL),
        brightness: Brightness::default(),
        pixels: ObservedPixels::All,
    };
    row(
        "observe a frame",
        pools,
        || before.clone(),
        |map| {
            observe(map, &observer, &matching, &gaussian);
        },
    );
    observe(&mut before, &observer, &matching, &gaussian);
    let scratch = RegularisationScratch::with_size(width, height);
    row(
        "regularise the old keyframe",
        pools,
        || (before.clone(), scratch.clone()),
        |map| {
            regularise(&mut map.0, &mut map.1, &smoothing);
        },
    );
    let mut empty = DepthMap::with_size(width, height);
    let image = &sequence.frames[INTERVAL];
    row(
        "restart on the new image",
        pools,
        || empty.clone(),
        |map| {
            map.restart(image, 5.0, MAX_KEYFRAME_POINTS);
        },
    );
    empty.restart(image, 5.0, MAX_KEYFRAME_POINTS);
    let new_from_old = sequence.first_from(INTERVAL).inverse();
    let bright = Brightness::default();
    row(
        "propagate",
        pools,
        || empty.clone(),
        |map| {
            propagate(&before, map, &camera, &new_from_old, bright, &carrying);
        },
    );
    let mut carried = empty.clone();
    propagate(&before, &mut carried, &camera, &new_from_old, bright, &carrying);
    row(
        "regularise the new keyframe",
        pools,
        || (carried.clone(), scratch.clone()),
        |map| {
            regularise(&mut map.0, &mut map.1, &smoothing);
        },
    );
    row(
        "rescale, count",
        pools,
        || carried.clone(),
        |map| {
            let factor = map.mean_inverse_depth().map_or(1.0, |mean| 1.0 / mean);
            map.rescale(factor as f32);
            std::hint::black_box(map.num_hypotheses());
        },
    );
    quads.fill(&sequence.frames[0]);
    let past = Observer {
        image: &quads,
        view: sequence.view(INTERVAL, 0),
        brightness: Brightness::default(),
        pixels: ObservedPixels::New,
    };
    row(
        "seed all new pixels from a past frame",
        pools,
        || carried.clone(),
        |map| {
            observe(map, &past, &matching, &gaussian);
        },
    );
    println!("{} of {} candidates carried", carried.num_hypotheses(), {
        carried.candidates.pixels().iter().filter(|c| **c).count()
    });
}

/// A covariance like that of a tracked pose: 1 mm and 0.02° in each direction.
fn tracked_covariance() -> [f64; 21] {
    let mut entries = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    std::array::from_fn(|_| match entries.next() {
        Some((row, column)) if row == column => {
            if row < 3 {
                1e-6
            } else {
                1e-7
            }
        }
        _ => 0.0,
    })
}

/// The mapper's step by its position after a change of keyframe.
fn whole(sequence: &Sequence, pools: &[rayon::ThreadPool]) {
    let camera = sequence.simulator.intrinsics();
    let mut by_place: [Vec<Vec<f64>>; 2] = [0, 1].map(|_| vec![Vec::new(); INTERVAL]);
    let mut changes: [Vec<f64>; 2] = [0, 1].map(|_| Vec::new());
    for ((pool, by_place), changes) in pools.iter().zip(&mut by_place).zip(&mut changes) {
        for _ in 0..4 {
            let mut mapper =
                Mapper::new(camera, MapperParams::default()).expect("default values are valid");
            for (k, pixels) in sequence.frames.iter().enumerate() {
                let frame = FrameView::new(&camera, k as u64, k as i64 * 33_333_333, pixels);
                let pose = PoseEstimate {
                    state: TrackingState::Tracking,
                    keyframe_id: mapper.keyframe().map_or(u64::MAX, |k| k.keyframe_id),
                    world_from_camera: sequence.first_from(k),
                    proposes_keyframe: k > 0 && k % INTERVAL == 0,
                    covariance: tracked_covariance(),
                    alignment_covariance: tracked_covariance(),
                    ..PoseEstimate::unknown(&frame)
                };
                let depth = (k == 0).then(|| sequence.simulator.raw_depth(FIRST)).flatten();
                let begin = Instant::now();
                let mut change = None;
                let mut change_begins = || change = Some(Instant::now());
                pool.install(|| mapper.step(&frame, &pose, depth.as_ref(), &mut change_begins));
                changes.extend(change.map(|begin| begin.elapsed().as_secs_f64() * 1e3));
                pool.install(|| mapper.finish_keyframe());
                if k > 0 {
                    by_place[k % INTERVAL].push(begin.elapsed().as_secs_f64() * 1e3);
                }
            }
        }
    }
    let [one, two] = [0, 1].map(|pool: usize| spread(changes[pool].clone()));
    println!("{:44} {one:>15}          {two:>15}", "a new keyframe, until it can be published");
    for place in 0..INTERVAL {
        let name = match place {
            0 => "whole step: a new keyframe".to_owned(),
            after => format!("whole step: frame {after} after it"),
        };
        let [one, two] = [0, 1].map(|pool: usize| spread(by_place[pool][place].clone()));
        println!("{name:44} {one:>15}          {two:>15}");
    }
}
