//! Intervals of single points over the frames, as an SVG figure.

use std::error::Error;
use std::fmt::Write;
use std::path::PathBuf;

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::slam::depth::candidate::{CandidateParams, CandidateSelector};
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::gradient_image::GradientImage;
use semidense::slam::depth::immature::{ImmaturePoint, IntervalParams, TraceFrame, TraceStatus};
use semidense::slam::depth::interval::interval_history;
use semidense::slam::image::buffer::Image;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::pose::Brightness;

/// What to show, and where.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Seed of the simulated room
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Frame in which the points are selected
    #[arg(long, default_value_t = 0)]
    first: usize,
    /// Number of frames through which they are traced
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u16).range(2..=300))]
    frames: u16,
    /// Output file
    #[arg(long, default_value = "interval.svg")]
    output: PathBuf,
}

/// A keyframe with its true depth, and the following frames with exact poses.
struct Sequence {
    keyframe: GradientImage,
    true_depth: Image<f32>,
    frames: Vec<(QuadImage, TwoView)>,
}

/// The history of a point.
struct Story {
    pixel: (u16, u16),
    true_inverse_depth: f32,
    samples: Vec<ImmaturePoint>,
}

pub fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let sequence = sequence(arguments)?;
    let params = IntervalParams::default();
    let stories = stories(&sequence, &params);
    if stories.is_empty() {
        return Err("no point was matched: choose another first frame or seed".into());
    }
    std::fs::write(&arguments.output, picture(&stories, &params))
        .map_err(|error| format!("{}: {error}", arguments.output.display()))?;
    for story in &stories {
        let last = story.samples.iter().rev().find(|s| s.max_inverse_depth.is_some());
        let Some((last, max)) = last.and_then(|s| Some((s, s.max_inverse_depth?))) else {
            continue;
        };
        println!(
            "pixel ({}, {}): true {:.4} 1/m, at the end {:.4} to {max:.4}, quality {:.1}",
            story.pixel.0,
            story.pixel.1,
            story.true_inverse_depth,
            last.min_inverse_depth,
            last.quality,
        );
    }
    println!("{}", arguments.output.display());
    Ok(())
}

fn sequence(arguments: &Arguments) -> Result<Sequence, Box<dyn Error>> {
    let (first, frames) = (arguments.first, usize::from(arguments.frames));
    let frames_in = first + frames + 1;
    let params =
        SimulatorParams { seed: arguments.seed, frames: frames_in, ..SimulatorParams::default() };
    let mut simulator = Simulator::new(params)?;
    let intrinsics = simulator.intrinsics();
    let poses: Vec<_> = simulator.ground_truth().iter().map(|p| p.world_from_camera).collect();
    let nanos = simulator.ground_truth()[first].nanos;
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    for _ in 0..=first {
        simulator.next_into(&mut pixels)?;
    }
    let mut keyframe = GradientImage::with_size(intrinsics.width, intrinsics.height);
    keyframe.fill(&pixels);
    let mut traced = Vec::new();
    while simulator.next_into(&mut pixels)?.is_some() {
        let mut image = QuadImage::with_size(intrinsics.width, intrinsics.height);
        image.fill(&pixels);
        let pose = &poses[first + 1 + traced.len()];
        traced.push((image, TwoView::new(&intrinsics, &(pose.inverse() * poses[first]))));
    }
    let true_depth = simulator.depth_at(nanos)?.ok_or("the simulator gave no depth")?;
    Ok(Sequence { keyframe, true_depth, frames: traced })
}

/// Charts across and down.
const COLUMNS: usize = 3;
const ROWS: usize = 2;

/// The points with the most matches, each from a different part of the image.
fn stories(sequence: &Sequence, params: &IntervalParams) -> Vec<Story> {
    let (width, height) = (sequence.keyframe.width(), sequence.keyframe.height());
    let mut candidates = Vec::new();
    let wanted = CandidateParams { wanted: 600 };
    CandidateSelector::default().choose(&sequence.keyframe, &wanted, &mut candidates);
    let mut best: [Option<Story>; COLUMNS * ROWS] = [const { None }; COLUMNS * ROWS];
    for candidate in candidates {
        let (u, v) = (usize::from(candidate.u), usize::from(candidate.v));
        let frames = sequence.frames.iter().map(|(image, view)| TraceFrame {
            image,
            view: *view,
            brightness: Brightness::default(),
        });
        let pixel = (candidate.u, candidate.v);
        let story = Story {
            pixel,
            true_inverse_depth: 1.0 / sequence.true_depth.at(u, v),
            samples: interval_history(&sequence.keyframe, pixel, frames, params),
        };
        let part = v * ROWS / height * COLUMNS + u * COLUMNS / width;
        let is_better = best[part].as_ref().is_none_or(|b| matches(&story) > matches(b));
        if is_better && matches(&story) > 0 {
            best[part] = Some(story);
        }
    }
    best.into_iter().flatten().collect()
}

fn matches(story: &Story) -> usize {
    story.samples.iter().filter(|s| s.status == TraceStatus::Good).count()
}

/// Size of one chart, and space around its plot.
const CHART: (f64, f64) = (400.0, 260.0);
const LEFT: f64 = 52.0;
const TOP: f64 = 40.0;
const RIGHT: f64 = 12.0;
const BOTTOM: f64 = 34.0;
const LEGEND_HEIGHT: f64 = 44.0;

const TRUTH_COLOUR: &str = "#d6455d";
const SURE_COLOUR: &str = "#1f9d78";
const UNSURE_COLOUR: &str = "#e59a1a";
const KEPT_COLOUR: &str = "#b4bccb";

fn picture(stories: &[Story], params: &IntervalParams) -> String {
    let rows = stories.len().div_ceil(COLUMNS);
    let (width, height) = (COLUMNS as f64 * CHART.0, rows as f64 * CHART.1 + LEGEND_HEIGHT);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"12\" fill=\"#1c2230\">\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>"
    );
    legend(&mut svg, params);
    for (i, story) in stories.iter().enumerate() {
        let (x, y) = ((i % COLUMNS) as f64 * CHART.0, (i / COLUMNS) as f64 * CHART.1);
        let _ = write!(svg, "<g transform=\"translate({x} {})\">", y + LEGEND_HEIGHT);
        chart(&mut svg, story, params);
        svg.push_str("</g>");
    }
    svg.push_str("</svg>\n");
    svg
}

fn legend(svg: &mut String, params: &IntervalParams) {
    let matched = format!("matched, quality above {}", params.mature_quality);
    let entries = [
        (SURE_COLOUR, matched.as_str()),
        (UNSURE_COLOUR, "matched, ambiguous"),
        (KEPT_COLOUR, "kept: nothing to gain in this frame"),
        (TRUTH_COLOUR, "true inverse depth"),
    ];
    for (i, (colour, text)) in entries.iter().enumerate() {
        let x = LEFT + 250.0 * i as f64;
        let _ = write!(
            svg,
            "<rect x=\"{x}\" y=\"16\" width=\"12\" height=\"12\" fill=\"{colour}\"/>\
             <text x=\"{}\" y=\"26\">{text}</text>",
            x + 18.0
        );
    }
}

/// One point: its interval after every frame as a bar, and the true value as a line.
fn chart(svg: &mut String, story: &Story, params: &IntervalParams) {
    let truth = f64::from(story.true_inverse_depth);
    // The first intervals extend far beyond: they are clipped.
    let (low, high) = (0.0, 2.2 * truth);
    let (plot_width, plot_height) = (CHART.0 - LEFT - RIGHT, CHART.1 - TOP - BOTTOM);
    let y = |d: f64| TOP + (high - d.clamp(low, high)) / (high - low) * plot_height;
    let step = plot_width / story.samples.len() as f64;
    let _ = write!(
        svg,
        "<text x=\"{LEFT}\" y=\"22\" font-weight=\"600\">pixel ({}, {}), {:.2} m away</text>\
         <rect x=\"{LEFT}\" y=\"{TOP}\" width=\"{plot_width}\" \
         height=\"{plot_height}\" fill=\"#f6f7f9\"/>",
        story.pixel.0,
        story.pixel.1,
        1.0 / truth,
    );
    for (i, sample) in story.samples.iter().enumerate() {
        let Some(max) = sample.max_inverse_depth else { continue };
        let colour = match sample.status {
            TraceStatus::Good if sample.quality > params.mature_quality => SURE_COLOUR,
            TraceStatus::Good => UNSURE_COLOUR,
            _ => KEPT_COLOUR,
        };
        let (top, bottom) = (y(f64::from(max)), y(f64::from(sample.min_inverse_depth)));
        let _ = write!(
            svg,
            "<rect x=\"{:.2}\" y=\"{top:.2}\" width=\"{:.2}\" height=\"{:.2}\" fill=\"{colour}\"/>",
            LEFT + (i as f64 + 0.15) * step,
            0.7 * step,
            (bottom - top).max(1.0),
        );
    }
    let _ = write!(
        svg,
        "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{2:.2}\" y2=\"{2:.2}\" stroke=\"{1}\" stroke-width=\"1.5\"/>",
        CHART.0 - RIGHT,
        TRUTH_COLOUR,
        y(truth),
    );
    for share in [0.0, 0.5, 1.0, 1.5, 2.0] {
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{:.2}\" text-anchor=\"end\" fill=\"#5d6676\">{:.2}</text>",
            LEFT - 6.0,
            y(share * truth) + 4.0,
            share * truth,
        );
    }
    for frame in (0..=story.samples.len()).step_by(5) {
        let _ = write!(
            svg,
            "<text x=\"{:.2}\" y=\"{}\" text-anchor=\"middle\" fill=\"#5d6676\">{frame}</text>",
            LEFT + frame as f64 * step,
            CHART.1 - BOTTOM + 16.0,
        );
    }
    let _ = write!(
        svg,
        "<text x=\"{}\" y=\"22\" text-anchor=\"end\" fill=\"#5d6676\">1/m over frames</text>",
        CHART.0 - RIGHT
    );
}
