//! Share of random starts that converge, by their distance from the truth, with and without the depth variance in the
//! weights.
//!
//! Pairs of a simulated keyframe and a later frame; the start is the true pose, translated or rotated about a random
//! axis until the keyframe's points are displaced, on average, by the number of pixels in the table.

use std::error::Error;
use std::path::PathBuf;

use nalgebra::{Vector3, Vector6};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::simulator::scene_kind::SceneKind;
use semidense::service::results::report::chart::{Chart, Scaling, svg_file};
use semidense::service::results::report::series::{Mark, Series};
use semidense::slam::alignment::align::{Aligner, AlignmentParams};
use semidense::slam::alignment::displacement::mean_displacement_px;
use semidense::slam::alignment::reference::{Reference, num_levels};
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::sums::SumPyramid;
use semidense::slam::pose::Brightness;

use crate::sequence::{KeyframeChoice, Noise, Recorded};

/// Parameters of the starts.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Standard deviation of the noise added to the inverse depth, as a share of it: the middle
    #[arg(long, default_value_t = 0.07)]
    depth_noise: f64,
    /// Multiply each point's noise by this to a power of -1 to 1: 1 % to 49 %, as in a map whose points were observed
    /// for different times
    #[arg(long, default_value_t = 7.0)]
    noise_spread: f64,
    /// Number of frames from a keyframe to the aligned frame, at 10 Hz
    #[arg(long, default_value_t = 4)]
    interval: usize,
    /// Number of random starts of each size for each pair
    #[arg(long, default_value_t = 24)]
    starts: usize,
    /// Write the figure as SVG
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
}

const SCENES: [(SceneKind, u64, [&str; 2]); 2] = [
    (SceneKind::Room, 41, ["Room: start moved", "Room: start turned"]),
    (SceneKind::Plane, 42, ["Plane: start moved", "Plane: start turned"]),
];

/// Mean distance of a start from the truth, pixels at a width of 640.
const SIZES_PX: [f64; 10] = [4.0, 8.0, 16.0, 24.0, 32.0, 48.0, 64.0, 80.0, 96.0, 128.0];

/// Perturbation of the start.
const KINDS: [&str; 2] = ["translation", "rotation"];

/// A start has converged if the points are closer than this to their true projections, pixels.
const CONVERGED_PX: f64 = 1.0;

/// Number of frames from one pair to the next.
const PAIR_INTERVAL: usize = 8;
const PAIRS: usize = 6;

/// Use every n-th point, which is enough for a mean.
const POINT_STRIDE: usize = 8;

/// Final distances from the truth of the starts of one size, pixels.
type Ends = Vec<f64>;

/// One pair to align.
struct Pair {
    reference: Reference,
    pyramid: SumPyramid,
    true_pose: SE3,
}

pub fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let mut charts = Vec::new();
    for (scene, seed, titles) in SCENES {
        let pairs = pairs(scene, seed, arguments)?;
        let flow = pairs.iter().map(|pair| pair.distance_px(&SE3::identity())).sum::<f64>();
        println!(
            "{scene:?}: {} pairs, {:.1} px apart in the mean; share converged (median end of those, px)",
            pairs.len(),
            flow / pairs.len().max(1) as f64
        );
        println!("{:<12} {:>8}  {:>18}  {:>18}", "start", "size px", "with variance", "without");
        for (kind, title) in titles.into_iter().enumerate() {
            let rows: Vec<[Ends; 2]> =
                SIZES_PX.iter().map(|&size| ends(&pairs, kind, size, arguments.starts)).collect();
            for (size, both) in SIZES_PX.iter().zip(&rows) {
                let [with, without] = both.each_ref().map(|ends| {
                    format!("{:>9.3} ({:.3})", share_converged(ends), median_end(ends))
                });
                println!("{:<12} {size:>8.0}  {with:>18}  {without:>18}", KINDS[kind]);
            }
            charts.push(chart(title, &rows));
        }
    }
    if let Some(path) = &arguments.plot {
        std::fs::write(path, svg_file(&charts, 2))?;
    }
    Ok(())
}

fn pairs(scene: SceneKind, seed: u64, arguments: &Arguments) -> Result<Vec<Pair>, Box<dyn Error>> {
    let frames = PAIRS * PAIR_INTERVAL + arguments.interval;
    let defaults = SimulatorParams::default();
    let simulator =
        Simulator::new(SimulatorParams { scene, seed, frames, rate_hz: 10.0, ..defaults })?;
    let mut recorded = Recorded::new(Box::new(simulator), frames)?;
    let choice = KeyframeChoice {
        depth_noise: arguments.depth_noise,
        noise_spread: arguments.noise_spread,
        min_gradient: 5.0,
        every: 0,
    };
    let mut noise = Noise(seed);
    let mut pairs = Vec::new();
    for first in (0..PAIRS).map(|pair| pair * PAIR_INTERVAL) {
        let keyframe = recorded.keyframe(first, &choice, &mut noise)?;
        let frame = recorded.frame(first + arguments.interval);
        let (Some(keyframe), Some((pixels, true_pose))) = (keyframe, frame) else { continue };
        let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
        let reference = Reference::prepare(&keyframe);
        let levels = num_levels(width, height);
        let mut pyramid = SumPyramid::with_size(width, height, levels, reference.finest_level());
        pyramid.fill(pixels);
        let true_pose = keyframe.map_from_keyframe.inverse_transform_pose(&true_pose).inverse();
        pairs.push(Pair { reference, pyramid, true_pose });
    }
    Ok(pairs)
}

impl Pair {
    fn distance_px(&self, pose: &SE3) -> f64 {
        mean_displacement_px(&self.reference, pose, &self.true_pose, POINT_STRIDE)
    }

    /// The true pose, moved or rotated in a random direction by `size_px`.
    fn start(&self, kind: usize, size_px: f64, noise: &mut Noise) -> SE3 {
        let direction = Vector3::from_fn(|_, _| noise.normal()).normalize();
        let mut twist = Vector6::zeros();
        twist.fixed_rows_mut::<3>(3 * kind).copy_from(&direction);
        let moved = |length: f64| SE3::exp(&(twist * length)) * self.true_pose;
        let (mut low, mut high) = (0.0, 3.0);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            // Points behind the camera count as infinitely far.
            match self.distance_px(&moved(middle)) < size_px {
                true => low = middle,
                false => high = middle,
            }
        }
        moved(low)
    }

    fn end(&self, aligner: &Aligner, start: &SE3) -> f64 {
        let brightness = Brightness::default();
        let alignment =
            aligner.align(&self.reference, &self.pyramid, start, brightness, &mut |_| true);
        self.distance_px(&alignment.state.current_from_keyframe)
    }
}

/// Final distances for one size, with and without depth variance, from the same starts.
fn ends(pairs: &[Pair], kind: usize, size_px: f64, starts: usize) -> [Ends; 2] {
    let aligner = |use_depth_variance| {
        Aligner::new(AlignmentParams { use_depth_variance, ..AlignmentParams::default() })
    };
    let aligners = [aligner(true), aligner(false)];
    let mut ends = [Ends::new(), Ends::new()];
    for (index, pair) in pairs.iter().enumerate() {
        // The same directions for every size.
        let mut noise = Noise(1000 + index as u64);
        for _ in 0..starts {
            let start = pair.start(kind, size_px, &mut noise);
            for (ends, aligner) in ends.iter_mut().zip(&aligners) {
                ends.push(pair.end(aligner, &start));
            }
        }
    }
    ends
}

fn share_converged(ends: &Ends) -> f64 {
    let converged = ends.iter().filter(|&&end| end < CONVERGED_PX).count();
    converged as f64 / ends.len().max(1) as f64
}

fn median_end(ends: &Ends) -> f64 {
    let mut converged: Vec<f64> = ends.iter().copied().filter(|&end| end < CONVERGED_PX).collect();
    converged.sort_by(f64::total_cmp);
    converged.get(converged.len() / 2).copied().unwrap_or(f64::NAN)
}

fn chart(title: &'static str, rows: &[[Ends; 2]]) -> Chart {
    let points = |which: usize| -> Vec<[f64; 2]> {
        let shares = rows.iter().map(|ends| 100.0 * share_converged(&ends[which]));
        SIZES_PX.iter().zip(shares).map(|(&size, share)| [size, share]).collect()
    };
    let series = |name, colour, mark, which| Series { name, colour, mark, points: points(which) };
    Chart {
        title,
        meaning: "Share of starts, that far away, from which the alignment finds the right pose.",
        x_label: "mean distance of the start in the image [px]".into(),
        y_label: "converged to within 1 px [%]".into(),
        height: 280.0,
        scaling: Scaling::FromZero,
        series: vec![
            series("without", "#e59a1a", Mark::Path, 1),
            series("", "#e59a1a", Mark::Dots(3.0), 1),
            series("with depth variance", "#2f6fed", Mark::Path, 0),
            series("", "#2f6fed", Mark::Dots(3.0), 0),
        ],
    }
}
