//! The points of a chart's series to draw: few enough for a page, without losing a peak.

use std::fmt::Write;

use crate::service::results::report::axis::Range;
use crate::service::results::report::chart_frame::Frame;
use crate::service::results::report::number_text::without_zeros;
use crate::service::results::report::series::{Mark, Series};

/// Most points that a path keeps.
const MAX_PATH_POINTS: usize = 3000;

/// Coordinates are written in steps of the axis range over this: finer than a screen shows.
const STEPS: f64 = 20_000.0;

/// The points of a series to draw. One that is not finite breaks a line.
pub(super) fn thinned(frame: &Frame, series: &Series) -> Vec<[f64; 2]> {
    let points = &series.points;
    match series.mark {
        Mark::Line => by_columns(frame, points),
        Mark::Path | Mark::DashedPath | Mark::Dots(_) => by_stride(points),
        Mark::Bars(_) | Mark::Rule => points.clone(),
    }
}

/// Every n-th point, few enough to draw; always the last, and the first of those that break a line.
fn by_stride(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let stride = points.len().div_ceil(MAX_PATH_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    let is_finite = |i: usize| points[i].iter().all(|c| c.is_finite());
    let breaks = |i: usize| !is_finite(i) && i > 0 && is_finite(i - 1);
    let kept = (0..points.len()).filter(|&i| i % stride == 0 || i == last || breaks(i));
    kept.map(|i| points[i]).collect()
}

/// A line over x: the first, the lowest, the highest and the last of the points in one column of the picture.
fn by_columns(frame: &Frame, points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let column_of = |point: &[f64; 2]| {
        let placed = frame.place(*point);
        placed.iter().all(|c| c.is_finite()).then(|| placed[0].floor() as i64)
    };
    let mut kept = Vec::new();
    for column in points.chunk_by(|a, b| column_of(a) == column_of(b)) {
        let order = |a: &&[f64; 2], b: &&[f64; 2]| a[1].total_cmp(&b[1]);
        let ends = [column.first(), column.iter().min_by(order), column.iter().max_by(order)];
        let ends = ends.into_iter().chain([column.last()]).flatten();
        if column_of(&column[0]).is_none() {
            kept.push([f64::NAN; 2]);
            continue;
        }
        let mut chosen: Vec<[f64; 2]> = ends.copied().collect();
        chosen.sort_by(|a, b| a[0].total_cmp(&b[0]));
        chosen.dedup();
        kept.extend(chosen);
    }
    kept
}

/// The points to draw as a JSON array `[x, y, x, y …]`; both are null for one without a position.
pub(super) fn points_json(frame: &Frame, series: &Series) -> String {
    let mut json = String::from("[");
    for [x, y] in thinned(frame, series) {
        let separator = if json.len() > 1 { "," } else { "" };
        let is_placed = frame.place([x, y]).iter().all(|c| c.is_finite());
        let _ = match (is_placed, frame.in_decades) {
            (false, _) => write!(json, "{separator}null,null"),
            (true, true) => write!(json, "{separator}{},{y:.3e}", number(x, frame.x)),
            (true, false) => {
                write!(json, "{separator}{},{}", number(x, frame.x), number(y, frame.y))
            }
        };
    }
    json.push(']');
    json
}

/// A number with as many digits as the axis needs.
pub(super) fn number(value: f64, axis: Range) -> String {
    /// Most decimals of a plain number.
    const MAX_DECIMALS: f64 = 9.0;
    let decimals = -(axis.width() / STEPS).log10().floor();
    if !(-MAX_DECIMALS..=MAX_DECIMALS).contains(&decimals) {
        return format!("{value:e}");
    }
    without_zeros(&format!("{value:.*}", decimals.max(0.0) as usize)).to_owned()
}
