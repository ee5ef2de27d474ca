//! The outcomes of the search for loops, and where they occurred.

use std::collections::BTreeMap;
use std::fmt::Write;

use nalgebra::Vector3;

use crate::service::adjustments::SearchRecord;
use crate::service::results::Results;
use crate::service::results::poses::longest_epoch;
use crate::service::results::record::RunRecord;
use crate::service::results::report::chart::{Chart, Scaling};
use crate::service::results::report::chart_figure::chart_figure;
use crate::service::results::report::charts::{
    ERROR, ESTIMATE, MAPPING, ONLINE, TRUTH, keyframe_poses,
};
use crate::service::results::report::html::escaped;
use crate::service::results::report::series::{Mark, Series};
use crate::service::results::report::views::Views;
use crate::service::results::summary_text::loops_text;
use crate::slam::counted::counted;
use crate::slam::keyframe::Keyframe;
use crate::slam::loops::SearchOutcome;

/// Radius of a loop that holds, and of a refused place.
const LOOP_RADIUS: f64 = 4.0;
const REFUSED_RADIUS: f64 = 2.5;
/// Most loops that are drawn, the newest: what a path keeps without being thinned, three points each.
const MAX_DRAWN_LINKS: usize = 1000;

/// Figures, reasons for refusals, and a view of the map from above; empty where no loop was searched for.
pub fn loop_section(results: &Results<'_>, up: Option<Vector3<f64>>) -> String {
    let Some(figures) = loops_text(&results.summary.loops) else { return String::new() };
    let searches = results.record.searches.as_deref().unwrap_or_default();
    let mut section = format!("<section><h2>Loops</h2><p>{}</p>", escaped(&figures));
    let reasons = reasons(searches);
    if !reasons.is_empty() {
        let listed: Vec<String> = reasons
            .iter()
            .map(|(why, n)| format!("{} {}", counted(*n, "time"), escaped(why)))
            .collect();
        let _ = write!(
            section,
            "<p>Other places, by the reason against the first candidate: {}.</p>",
            listed.join("; ")
        );
    }
    let chart = seen_from_above(results.record, searches, up);
    let _ = write!(section, "<div class=\"charts\">{}</div></section>", chart_figure(&chart));
    section
}

/// Why candidates were other places, and how often, most frequent first.
fn reasons(searches: &[SearchRecord]) -> Vec<(String, usize)> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for search in searches {
        if let SearchOutcome::Refused(why) = search.report.outcome {
            // Without the measured value.
            let why = why.to_string();
            let why = why.split(':').next().unwrap_or_default().to_owned();
            *counts.entry(why).or_default() += 1;
        }
    }
    let mut counts: Vec<(String, usize)> = counts.into_iter().collect();
    counts.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    counts
}

/// The keyframes' path in the longest epoch, and the outcomes along it; loops as lines between their keyframes.
fn seen_from_above(
    record: &RunRecord,
    searches: &[SearchRecord],
    up: Option<Vector3<f64>>,
) -> Chart {
    let keyframes = keyframe_poses(record);
    let views = Views::of(&keyframes, up);
    let epoch = longest_epoch(record);
    let at = |id: u64| {
        let is_shown = |of: &&Keyframe| epoch.is_none_or(|epoch| of.epoch == epoch);
        let keyframe = record.map.get(id).filter(is_shown)?;
        Some(views.seen_from_above(&keyframe.map_from_keyframe.rigid.translation))
    };
    let of = |is: IsOutcome| -> Vec<[f64; 2]> {
        let found = searches.iter().filter(|search| is(&search.report.outcome));
        found.filter_map(|search| at(search.report.keyframe_id)).collect()
    };
    let links = record
        .map
        .loops
        .links
        .iter()
        .rev()
        .take(MAX_DRAWN_LINKS)
        .filter_map(|link| Some([at(link.i)?, at(link.j)?]));
    // A broken line: one segment per loop.
    let links = links.flat_map(|[i, j]| [i, j, [f64::NAN; 2]]).collect();
    let line = |name, colour, points| Series { name, colour, mark: Mark::Path, points };
    let path =
        keyframes.iter().map(|pose| views.seen_from_above(&pose.world_from_camera.translation));
    Chart {
        title: "Loops from above",
        meaning: "Where earlier places were recognised. Closed or joined: the map was corrected; held already: the map already \
                  satisfied it; against the drift and other place: refused.",
        x_label: "along the longest extent of the path [map units]".into(),
        y_label: "across [map units]".into(),
        height: 480.0,
        scaling: Scaling::Equal,
        series: [line("keyframes", TRUTH, path.collect())]
            .into_iter()
            .chain(place_series(&of))
            .chain([line("loops of the map", MAPPING, links)])
            .collect(),
    }
}

/// Whether a search has a certain fate.
type IsOutcome = fn(&SearchOutcome) -> bool;

/// Searches by their fate: `of` gives the positions of those with such a fate.
fn place_series(of: &dyn Fn(IsOutcome) -> Vec<[f64; 2]>) -> [Series; 4] {
    let dots = |name, colour, radius, is| Series::new(name, colour, Mark::Dots(radius), of(is));
    let is_other = |outcome: &SearchOutcome| {
        matches!(
            outcome,
            SearchOutcome::Refused(_) | SearchOutcome::Unconfirmed | SearchOutcome::Inconsistent
        )
    };
    let is_too_far = |outcome: &SearchOutcome| matches!(outcome, SearchOutcome::AgainstDrift(_));
    let moved_the_map =
        |outcome: &SearchOutcome| matches!(outcome, SearchOutcome::Closed | SearchOutcome::Joined);
    [
        dots("other place", ERROR, REFUSED_RADIUS, is_other as IsOutcome),
        dots("against the drift", ONLINE, REFUSED_RADIUS, is_too_far),
        dots("held already", ESTIMATE, LOOP_RADIUS, |outcome| {
            *outcome == SearchOutcome::AlreadyConsistent
        }),
        dots("closed or joined", MAPPING, LOOP_RADIUS, moved_the_map),
    ]
}
