//! `report.html`: a run on one page, which needs no other file and no network.

pub(crate) mod axis;
pub(crate) mod budget_charts;
pub mod chart;
mod chart_figure;
mod chart_frame;
mod chart_points;
pub(crate) mod charts;
pub(crate) mod evaluation_plot;
mod figure_words;
mod figure_words_quality;
pub(crate) mod figures;
pub(crate) mod grade_banner;
pub(crate) mod html;
pub(crate) mod joint_charts;
pub(crate) mod loop_section;
pub(crate) mod map_picture;
pub(crate) mod map_view;
mod number_text;
pub mod scene;
pub mod series;
pub(crate) mod views;

use std::fmt::Write;

use rayon::prelude::*;

use crate::service::results::Results;
use crate::service::results::colour::Picture;
use crate::service::results::empty_map::empty_map_warning;
use crate::service::results::output_folder::utc_text;
use crate::service::results::pictures::{
    RELATIVE_STD_DEV_RANGE, density_picture, inverse_depth_picture, variance_picture,
};
use crate::service::results::record::{EndOfRun, RunMode, RunRecord};
use crate::service::results::report::budget_charts::budget_charts;
use crate::service::results::report::chart::Chart;
use crate::service::results::report::chart_figure::{CHART_SCRIPT, chart_figure};
use crate::service::results::report::charts::{
    error_over_time, scale_over_time, time_charts, trajectory_views,
};
use crate::service::results::report::figures::figures;
use crate::service::results::report::grade_banner::grade_banner;
use crate::service::results::report::html::{escaped, png_address};
use crate::service::results::report::joint_charts::{depth_charts, joint_charts};
use crate::service::results::report::loop_section::loop_section;
use crate::service::results::report::map_picture::map_section;
use crate::service::results::report::map_view::map_view;
use crate::service::results::report::number_text::{grouped, length};
use crate::service::results::summary::Summary;
use crate::service::results::summary_text::is_unproven;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::pose::TrackingState;
use crate::slam::up::up_direction;

/// Keyframes whose depth is shown: enough to see the run, few enough for one page.
const PICTURED_KEYFRAMES: usize = 8;

/// Renders the page.
pub fn report(results: &Results<'_>) -> String {
    let summary = &results.summary;
    let mode = match summary.mode {
        RunMode::Replay => "replay in one process, every frame",
        RunMode::Lockstep => "lockstep run, every frame",
        RunMode::Live => "live run, newest frame wins",
    };
    let source = escaped(&summary.source);
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>semidense: {source}</title><style>{}</style></head><body><main>\
         <header><p class=\"product\">semidense {}</p><h1>{source}</h1>\
         <p class=\"mode\">{mode} &middot; {} frames &middot; {:.1} s</p>{}</header>",
        include_str!("report/report.css"),
        env!("CARGO_PKG_VERSION"),
        summary.frames_in,
        summary.recorded_secs,
        notices(results)
    );
    let normals = results.surface.iter().map(|point| point.normal);
    let up = up_direction(results.trajectory.iter(), normals);
    page.push_str(&grade_banner(&summary.grade));
    page.push_str(&cards(summary));
    page.push_str(&states(results.record));
    page.push_str(&map_view(results, up));
    page.push_str(&map_section(results, up));
    page.push_str(&section("Trajectory", "", &trajectory_views(results, up)));
    let errors: Vec<Chart> =
        error_over_time(results).into_iter().chain(scale_over_time(results)).collect();
    page.push_str(&section("Error", "", &errors));
    page.push_str(&depth_maps(results));
    let depth = depth_charts(results.record, &summary.depth.keyframe_depth);
    page.push_str(&section("Depth of the keyframes", "", &depth));
    page.push_str(&section("Joint estimation", "", &joint_charts(results.record)));
    page.push_str(&loop_section(results, up));
    page.push_str(&section("Time", "", &time_charts(results.record)));
    page.push_str(&budget(results));
    page.push_str(&figures(summary));
    let _ = writeln!(page, "<script>{CHART_SCRIPT}</script></main></body></html>");
    page
}

/// What a reader must know first: that a run did not finish, tracked nothing, or has an empty map.
fn notices(results: &Results<'_>) -> String {
    let summary = &results.summary;
    let end = match &results.record.ended {
        EndOfRun::Finished => None,
        EndOfRun::Interrupted => Some("Interrupted: these are the results up to then.".to_owned()),
        EndOfRun::Failed(cause) => {
            Some(format!("Failed: {}. These are the results up to then.", escaped(cause)))
        }
        EndOfRun::Recovered(time) => Some(format!(
            "Recovered from the journal of a run that ended at {}: it was killed, and its last two seconds may be \
             missing.",
            utc_text(*time)
        )),
    };
    let untracked = summary.untracked.as_ref();
    let untracked = untracked.map(|why| format!("Nothing was tracked: {}.", escaped(why)));
    let (points, resolution) = (summary.point_counts.points, results.params.map_resolution);
    let empty = empty_map_warning(points, results.surface.len(), resolution);
    let empty =
        empty.filter(|_| untracked.is_none()).map(|why| format!("Note: {}.", escaped(&why)));
    let notice = |text: String| format!("<p class=\"notice\">{text}</p>");
    end.into_iter().chain(untracked).chain(empty).map(notice).collect()
}

/// Cost of a deadline; empty where no frame was realigned.
fn budget(results: &Results<'_>) -> String {
    let samples = &results.record.budget_samples;
    let intro = format!(
        "<p>{} frames were aligned again and stopped early: mean distance in the image between the \
         keyframe's points at that pose and at the pose without a deadline. Each curve starts at the \
         prediction, followed by one step; 0.001 px means no difference.</p>",
        samples.len()
    );
    let charts = budget_charts(samples, results.summary.budget_curve.as_ref());
    section("Quality and budget", &intro, &charts)
}

/// Charts side by side below a heading and `intro`; empty where there are none.
fn section(heading: &str, intro: &str, charts: &[Chart]) -> String {
    if charts.is_empty() {
        return String::new();
    }
    let figures: String = charts.iter().map(chart_figure).collect();
    format!("<section><h2>{heading}</h2>{intro}<div class=\"charts\">{figures}</div></section>")
}

/// The most important figures, large.
fn cards(summary: &Summary) -> String {
    let mut cards = String::from("<section class=\"cards\">");
    let mut card = |name: &str, value: String, note: String| {
        let _ = write!(
            cards,
            "<div class=\"card\"><p class=\"name\">{name}</p><p class=\"value\">{value}</p>\
             <p class=\"note\">{note}</p></div>"
        );
    };
    let share = 100.0 * summary.frames.frames_tracked as f64 / summary.frames_in.max(1) as f64;
    let losses = match summary.lost_count {
        _ if summary.frames.frames_tracked == 0 && summary.frames.frames_lost > 0 => {
            "lost at once".to_owned()
        }
        _ if is_unproven(summary) => "none on the map".to_owned(),
        _ if summary.frames.frames_tracked == 0 => "never initialised".to_owned(),
        0 => "never lost".to_owned(),
        1 => "lost once".to_owned(),
        n => format!("lost {n} times"),
    };
    card("Frames tracked", format!("{share:.1} %"), losses);
    let trajectory = &summary.trajectory;
    if let (Some(ate), Some(path)) = (trajectory.ate_rmse_m, trajectory.path_length_m) {
        let note = format!("{:.2} % of {path:.2} m, {}", 100.0 * ate / path, "RMSE");
        card("Position error (ATE)", length(ate), note);
    }
    if let Some(ratio) = trajectory.window_scale_ratio {
        let note = "largest / smallest scale of 100-frame windows".to_owned();
        card("Scale drift", format!("&times; {ratio:.2}"), note);
    }
    let depth_error = summary.depth.depth_relative_error_median;
    if let Some(error) = depth_error.filter(|_| !is_unproven(summary)) {
        let best = summary.depth.depth_relative_error_median_best_half.unwrap_or(error);
        let note = format!("median; {:.1} % in the more certain half", 100.0 * best);
        card("Depth error", format!("{:.1} %", 100.0 * error), note);
    }
    let points = format!("{} certain points", grouped(summary.point_counts.points as u64));
    card("Keyframes", summary.keyframes.to_string(), points);
    if let Some(times) = summary.times.track_ms {
        // The deadline counts from a frame's arrival, as the time in the tracker does; latency from its stamp.
        let late = summary.deadline_misses.map(|misses| format!("; {misses} past the deadline"));
        let note = format!("median; p99 {:.1} ms{}", times.p99, late.unwrap_or_default());
        card("Tracking a frame", format!("{:.1} ms", times.p50), note);
    }
    if let Some(times) = summary.latency.latency_ms {
        let note = format!("from stamp to pose, median; p99 {:.1} ms", times.p99);
        card("Latency", format!("{:.1} ms", times.p50), note);
    }
    if let Some(factor) = summary.realtime_factor {
        card("Speed", format!("&times; {factor:.1}"), "of real time".to_owned());
    }
    cards.push_str("</section>");
    cards
}

/// Name and share of each state, and a strip that shows when it occurred.
fn states(record: &RunRecord) -> String {
    let count = record.poses.len();
    if count == 0 {
        return String::new();
    }
    let kinds: Vec<usize> = record.poses.iter().map(|pose| pose.estimate.state.index()).collect();
    let mut html = String::from(
        "<section><h2>States</h2><svg class=\"states\" viewBox=\"0 0 1000 22\" \
         preserveAspectRatio=\"none\">",
    );
    let mut start = 0;
    for run in kinds.chunk_by(|a, b| a == b) {
        let scale = 1000.0 / count as f64;
        let _ = write!(
            html,
            "<rect x=\"{:.2}\" width=\"{:.2}\" height=\"22\" class=\"{}\"/>",
            start as f64 * scale,
            run.len() as f64 * scale,
            TrackingState::NAMES[run[0]]
        );
        start += run.len();
    }
    html.push_str("</svg><p class=\"legend\">");
    for (kind, name) in TrackingState::NAMES.iter().enumerate() {
        let frames = kinds.iter().filter(|&&k| k == kind).count();
        let _ = write!(html, "<span><i class=\"{name}\"></i>{name} {frames}</span>");
    }
    html.push_str("</p></section>");
    html
}

/// Depth of keyframes spread over the run, and one with its uncertainty.
fn depth_maps(results: &Results<'_>) -> String {
    let usable = |k: &&Keyframe| k.map_state == MapState::Established && !k.points.is_empty();
    let keyframes: Vec<&Keyframe> = results.record.map.keyframes.iter().filter(usable).collect();
    if keyframes.is_empty() {
        return String::new();
    }
    let shown = keyframes.len().min(PICTURED_KEYFRAMES);
    let spread = |i: usize| keyframes[i * (keyframes.len() - 1) / (shown - 1).max(1)];
    let mut html = format!(
        "<section><h2>Depth</h2><p>Inverse depth of {shown} of {} keyframes: \
         <span class=\"scale near-far\"></span> far to near. Shown are points whose standard deviation is \
         at most {:.0} % of their inverse depth.</p><div class=\"pictures\">",
        keyframes.len(),
        100.0 * results.params.max_relative_std_dev
    );
    let pictured = |i: usize| {
        let keyframe = spread(i);
        let (picture, range) = inverse_depth_picture(keyframe, results.params.max_relative_std_dev);
        let depths = match range {
            Some([far, near]) => {
                let scale = keyframe.map_from_keyframe.scale;
                format!("{:.2} to {:.2} map units", scale / near, scale / far)
            }
            None => "no points".to_owned(),
        };
        picture_figure(&picture, keyframe, &depths)
    };
    html.extend((0..shown).into_par_iter().map(pictured).collect::<Vec<_>>());
    let middle = spread(shown / 2);
    let [low, high] = RELATIVE_STD_DEV_RANGE;
    let _ = write!(
        html,
        "</div><p>One keyframe with all its points; the relative standard deviation of its inverse depth, \
         <span class=\"scale sure-unsure\"></span> {:.1} % to {:.0} % (logarithmic); the share of \
         pixels with depth, 0 to 100 % on the same scale.</p><div class=\"pictures wide\">",
        100.0 * low,
        100.0 * high
    );
    let whole = [
        ("inverse depth", inverse_depth_picture(middle, f64::INFINITY).0),
        ("uncertainty", variance_picture(middle)),
        ("density", density_picture(middle)),
    ];
    let figures = whole.par_iter().map(|(note, picture)| picture_figure(picture, middle, note));
    html.extend(figures.collect::<Vec<_>>());
    html.push_str("</div></section>");
    html
}

/// The picture as part of the page; empty where it cannot be encoded.
fn picture_figure(picture: &Picture, keyframe: &Keyframe, note: &str) -> String {
    let Some(png) = picture.png() else { return String::new() };
    format!(
        "<figure><img alt=\"depth of keyframe {0}\" src=\"{1}\">\
         <figcaption>keyframe {0}, frame {2}: {3} points, {note}</figcaption></figure>",
        keyframe.keyframe_id,
        png_address(&png),
        keyframe.sequence,
        grouped(keyframe.points.len() as u64)
    )
}
