//! Every figure of the summary, with its name, unit and meaning.

use std::fmt::Write;

use serde_json::Value;

use crate::service::results::report::figure_words::{Format, GROUPS, Group, RUN_WORDS, Words};
use crate::service::results::report::figure_words_quality::QUALITY_WORDS;
use crate::service::results::report::html::escaped;
use crate::service::results::report::number_text::{grouped, length};
use crate::service::results::summary::Summary;
use crate::slam::geometry::intrinsics::Intrinsics;

/// Most buckets of a histogram that are written out.
const HISTOGRAM_ROWS: usize = 40;

/// The section: the figures by groups, lists as tables.
pub fn figures(summary: &Summary) -> String {
    let value = serde_json::to_value(summary).unwrap_or_default();
    let mut html = String::from(
        "<section><h2>Figures</h2><p><code>summary.json</code> next to this page holds the same figures for programs.</p>",
    );
    let shown = placed_figures(&value);
    for (group, heading) in GROUPS {
        let of_group: Vec<_> = shown.iter().filter(|(of, _, _)| *of == group).collect();
        if of_group.is_empty() {
            continue;
        }
        let _ = write!(html, "<h3>{heading}</h3>");
        let (tables, entries): (Vec<_>, Vec<_>) =
            of_group.into_iter().partition(|(_, words, _)| matches!(words.format, Format::Rows(_)));
        if !entries.is_empty() {
            html.push_str("<dl>");
            entries.iter().for_each(|(_, words, value)| entry(&mut html, words, value));
            html.push_str("</dl>");
        }
        tables.iter().for_each(|(_, words, value)| table(&mut html, words, value));
    }
    html.push_str("</section>");
    html
}

/// The figures with a value, in the order of their words, each with its group; those of nested ones in the group that
/// the outer one names.
fn placed_figures(summary: &Value) -> Vec<(Group, &'static Words, &Value)> {
    let mut placed = Vec::new();
    for words in all_words() {
        let value = &summary[words.key];
        match words.format {
            _ if !has_figures(value) => {}
            Format::Drawn => {}
            Format::Nested(group) => {
                let inner = all_words().map(|words| (group, words, &value[words.key]));
                placed.extend(inner.filter(|(_, _, value)| has_figures(value)));
            }
            _ => placed.push((words.group, words, value)),
        }
    }
    placed
}

/// Whether a value has anything to show.
fn has_figures(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Object(entries) => !entries.values().all(Value::is_null),
        Value::Array(values) => !values.is_empty(),
        Value::String(text) => !text.is_empty(),
        _ => true,
    }
}

fn entry(html: &mut String, words: &Words, value: &Value) {
    let _ = write!(
        html,
        "<div><dt>{}<small>{}</small></dt><dd>{}</dd></div>",
        escaped(words.name),
        escaped(words.meaning),
        escaped(&written(words.format, value))
    );
}

fn table(html: &mut String, words: &Words, value: &Value) {
    let Format::Rows(columns) = words.format else { return };
    let _ = write!(
        html,
        "<div class=\"table\"><p>{}<small>{}</small></p><table><tr>",
        escaped(words.name),
        escaped(words.meaning)
    );
    for (_, heading, _) in columns {
        let _ = write!(html, "<th>{}</th>", escaped(heading));
    }
    for row in value.as_array().into_iter().flatten() {
        html.push_str("</tr><tr>");
        for (key, _, format) in columns {
            let _ = write!(html, "<td>{}</td>", escaped(&written(*format, &row[*key])));
        }
    }
    html.push_str("</tr></table></div>");
}

/// A figure with its unit; a dash where it has no value.
fn written(format: Format, value: &Value) -> String {
    const NONE: &str = "–";
    match (format, value) {
        (_, Value::Null) | (Format::Drawn | Format::Nested(_) | Format::Rows(_), _) => NONE.into(),
        (Format::Text, Value::String(text)) => text.clone(),
        (Format::Times, times) => times_text(times),
        (Format::Histogram, histogram) => histogram_text(histogram),
        (Format::Camera, camera) => camera_text(camera),
        (Format::Counts, Value::Object(counts)) => {
            let counts = counts.iter().map(|(name, count)| format!("{name} {count}"));
            counts.collect::<Vec<_>>().join(", ")
        }
        (Format::Named(names, is_share), Value::Array(values)) => {
            let values = values.iter().filter_map(Value::as_f64).zip(names);
            let values = values.map(|(value, name)| match is_share {
                true => format!("{name} {:.1} %", 100.0 * value),
                false => format!("{name} {}", plain(value)),
            });
            values.collect::<Vec<_>>().join(", ")
        }
        (format, value) => match value.as_f64() {
            Some(number) => number_text(format, number),
            None => value.as_str().unwrap_or(NONE).to_owned(),
        },
    }
}

fn number_text(format: Format, number: f64) -> String {
    match format {
        Format::Count if number >= 0.0 => grouped(number.round() as u64),
        Format::Unit("°") => format!("{}°", plain(number)),
        Format::Unit(unit) => format!("{} {unit}", plain(number)),
        Format::Metres => length(number),
        Format::Percent => format!("{:.1} %", 100.0 * number),
        _ => plain(number),
    }
}

/// A number with three significant digits, or all digits before the point.
fn plain(number: f64) -> String {
    const DIGITS: f64 = 2.0;
    if number == 0.0 {
        return "0".to_owned();
    }
    let decimals = DIGITS - number.abs().log10().floor();
    if !(-9.0..=8.0).contains(&decimals) {
        return format!("{number:.2e}");
    }
    format!("{number:.*}", decimals.max(0.0) as usize)
}

fn times_text(times: &Value) -> String {
    let of = |key: &str| times[key].as_f64().map_or("–".to_owned(), plain);
    format!(
        "mean {} ms, median {}; 95 % below {}, 99 % below {}, 99.9 % below {}; longest {} ms",
        of("mean"),
        of("p50"),
        of("p95"),
        of("p99"),
        of("p999"),
        of("max")
    )
}

fn histogram_text(histogram: &Value) -> String {
    let list = |key: &str| histogram[key].as_array().cloned().unwrap_or_default();
    let rows = list("below_ms").into_iter().zip(list("counts")).take(HISTOGRAM_ROWS);
    let rows = rows.map(|(end, count)| {
        let (end, count) = (end.as_f64().unwrap_or(f64::NAN), count.as_u64().unwrap_or(0));
        format!("below {} ms: {}", plain(end), grouped(count))
    });
    rows.collect::<Vec<_>>().join(", ")
}

fn camera_text(camera: &Value) -> String {
    match serde_json::from_value::<Intrinsics>(camera.clone()) {
        Ok(k) => format!(
            "{} × {}, focal lengths {:.1} and {:.1}, principal point {:.1}, {:.1}",
            k.width, k.height, k.fx, k.fy, k.cx, k.cy
        ),
        Err(_) => "–".to_owned(),
    }
}

/// The words of all figures in the order of the page.
fn all_words() -> impl Iterator<Item = &'static Words> {
    RUN_WORDS.iter().chain(QUALITY_WORDS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::results::alignment_levels::LevelSummary;
    use crate::service::results::summary::PointCounts;
    use crate::service::results::times::{Histogram, Percentiles};
    use crate::service::results::untracked::tests::record;
    use crate::slam::evaluation::depth_error::DepthErrors;
    use crate::slam::pose::TrackingState;
    use serde_json::json;

    /// A summary with every key, including those that are null.
    fn summary() -> Value {
        let counts = PointCounts { points: 0, map_points: 0, fusion_secs: 0.0 };
        let record = record(0, 0, TrackingState::Initializing);
        let depth = DepthErrors::default();
        let summary = Summary::new(&record, counts, None, None, [None, None, None], depth);
        serde_json::to_value(summary).unwrap()
    }

    fn words_of(key: &str) -> Option<&'static Words> {
        all_words().find(|words| words.key == key)
    }

    fn keys(value: &impl serde::Serialize) -> Vec<String> {
        let value = serde_json::to_value(value).unwrap();
        value.as_object().unwrap().keys().cloned().collect()
    }

    #[test]
    fn every_key_of_the_summary_has_words_and_a_meaning() {
        let summary = summary();
        let nested = ["online", "map_nees", "velocity_nees"].map(|key| &summary[key]);
        let all = nested.into_iter().chain([&summary]);
        let mut count = 0;
        for (key, _) in all.flat_map(|value| value.as_object().unwrap()) {
            let words = words_of(key).unwrap_or_else(|| panic!("{key} has no words"));
            assert!(!words.name.contains('_') && words.name.len() > 2, "{key}");
            assert!(words.meaning.ends_with('.'), "{key}: {}", words.meaning);
            count += 1;
        }
        assert!(count > 110, "{count}");
    }

    #[test]
    fn only_the_scale_of_the_path_is_said_to_drift() {
        let drifting = all_words().filter(|words| words.name.contains("cale drift"));
        assert_eq!(drifting.map(|words| words.key).collect::<Vec<_>>(), ["window_scale_ratio"]);
    }

    #[test]
    fn every_column_of_a_table_has_a_heading() {
        let level = LevelSummary {
            level: 0,
            frames: 1,
            points: 1.0,
            iterations_median: 1.0,
            iterations_mean: 1.0,
            nanos_per_point: None,
        };
        let rejection =
            crate::service::results::record::Rejection { sequence: 0, reason: String::new() };
        let cause = crate::service::results::record::RestartCause {
            process: String::new(),
            cause: String::new(),
            count: 1,
        };
        let rows = [
            ("alignment_levels", keys(&level)),
            ("map_rejections", keys(&rejection)),
            ("restart_causes", keys(&cause)),
        ];
        for (key, mut keys) in rows {
            let Format::Rows(columns) = words_of(key).unwrap().format else { panic!("{key}") };
            let mut known: Vec<&str> = columns.iter().map(|(key, _, _)| *key).collect();
            keys.sort_unstable();
            known.sort_unstable();
            assert_eq!(known, keys, "{key}");
        }
    }

    #[test]
    fn figures_have_units_and_keys_are_not_shown() {
        let mut value = summary();
        let times = Percentiles { mean: 1.75, p50: 1.5, p95: 2.0, p99: 3.0, p999: 4.0, max: 12.25 };
        value["track_ms"] = json!(times);
        value["ate_rmse_m"] = json!(0.0123);
        value["online"]["ate_rmse_m"] = json!(0.5);
        value["nees_below_bound"] = json!(0.9);
        value["depth_coverage"] = json!([0.6, 0.9, 0.99]);
        value["map_rejections"] = json!([{ "sequence": 7, "reason": "<two>" }]);
        value["latency_histogram"] = json!(Histogram { below_ms: vec![1.0], counts: vec![12345] });
        value["camera"] = json!(Intrinsics::pinhole(640, 480, 500.0));
        let html = figures(&serde_json::from_value(value).unwrap());
        for part in [
            "mean 1.75 ms, median 1.50; 95 % below 2.00",
            "<dd>1.23 cm</dd>",
            "<dd>50.00 cm</dd>",
            "trajectory as published</h3>",
            "<dd>90.0 %</dd>",
            "1 σ 60.0 %, 2 σ 90.0 %, 3 σ 99.0 %",
            "<td>7</td><td>&lt;two&gt;</td>",
            "12\u{202f}345",
            "640 × 480, focal lengths 500.0",
        ] {
            assert!(html.contains(part), "{part}: {html}");
        }
        let keys = summary().as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        for key in keys.iter().filter(|key| key.contains('_')) {
            assert!(!html.contains(key.as_str()), "{key}");
        }
    }
}
