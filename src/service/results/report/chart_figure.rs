//! A chart on a page: the picture for print, its figures for the script that draws it as wide as the page and shows the
//! values under the pointer, and its meaning.

use serde_json::json;

use crate::service::results::report::chart::{Chart, Scaling};
use crate::service::results::report::chart_points::{number, points_json};
use crate::service::results::report::html::escaped;
use crate::service::results::report::series::{Mark, Series};

/// The script, included once after all charts.
pub const CHART_SCRIPT: &str = include_str!("chart.js");

/// The `<figure>` of a chart.
pub fn chart_figure(chart: &Chart) -> String {
    let meaning = match chart.meaning {
        "" => String::new(),
        text => format!("<figcaption>{}</figcaption>", escaped(text)),
    };
    format!(
        "<figure class=\"plot\">{}<script type=\"application/json\" class=\"chart-figures\">{}</script>{meaning}</figure>",
        chart.svg(),
        figures_json(chart)
    )
}

/// Data for the script.
fn figures_json(chart: &Chart) -> String {
    let frame = chart.tight_frame();
    let scaling = match chart.scaling {
        Scaling::Free | Scaling::FromZero => "free",
        Scaling::Equal => "equal",
        Scaling::Decades => "decades",
    };
    let series: Vec<String> = chart
        .series
        .iter()
        .map(|series| {
            let (mark, size) = mark_words(series);
            format!(
                "{{\"name\":{},\"colour\":{},\"mark\":\"{mark}\",\"size\":{size},\"points\":{}}}",
                json!(series.name),
                json!(series.colour),
                points_json(&frame, series)
            )
        })
        .collect();
    let json = format!(
        "{{\"title\":{},\"xLabel\":{},\"yLabel\":{},\"height\":{},\"scaling\":\"{scaling}\",\
         \"x\":[{},{}],\"y\":[{:e},{:e}],\"series\":[{}]}}",
        json!(chart.title),
        json!(chart.x_label),
        json!(chart.y_label),
        chart.height,
        number(frame.x.low, frame.x),
        number(frame.x.high, frame.x),
        frame.y.low,
        frame.y.high,
        series.join(",")
    );
    // Nothing in it may close the element.
    json.replace('<', "\\u003c")
}

/// The mark's name and its radius or width.
fn mark_words(series: &Series) -> (&'static str, String) {
    match series.mark {
        Mark::Line | Mark::Path => ("line", "0".to_owned()),
        Mark::DashedPath => ("dashed", "0".to_owned()),
        Mark::Dots(radius) => ("dots", radius.to_string()),
        Mark::Bars(width) => ("bars", format!("{width:e}")),
        Mark::Rule => ("rule", "0".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    fn figures(scaling: Scaling, mark: Mark, points: Vec<[f64; 2]>) -> Value {
        let chart = Chart {
            title: "</script><b>",
            meaning: "a < b",
            x_label: "time [s]".into(),
            y_label: "error [m]".into(),
            height: 230.0,
            scaling,
            series: vec![Series { name: "final", colour: "#123456", mark, points }],
        };
        let html = chart_figure(&chart);
        assert!(html.contains("<figcaption>a &lt; b</figcaption>"), "{html}");
        assert_eq!(html.matches("</script>").count(), 1, "{html}");
        let (_, rest) = html.split_once("class=\"chart-figures\">").unwrap();
        serde_json::from_str(rest.split_once("</script>").unwrap().0).unwrap()
    }

    #[test]
    fn the_script_gets_names_and_values_and_gaps() {
        let points = vec![[0.0, 0.012], [0.5, f64::NAN], [1.0, 0.034]];
        for mark in [Mark::Line, Mark::Path, Mark::Dots(2.0)] {
            let json = figures(Scaling::FromZero, mark, points.clone());
            assert_eq!(json["title"], "</script><b>");
            let series = &json["series"][0];
            assert_eq!((&series["name"], &series["colour"]), (&json!("final"), &json!("#123456")));
            assert_eq!(series["points"], json!([0, 0.012, null, null, 1, 0.034]), "{mark:?}");
        }
    }

    #[test]
    fn any_value_is_valid_json() {
        let hostile = vec![[f64::INFINITY, 1.0], [1e300, -1e300], [1e-300, 0.0], [-1.0, 5e-324]];
        for scaling in [Scaling::Free, Scaling::FromZero, Scaling::Equal, Scaling::Decades] {
            for mark in [Mark::Line, Mark::DashedPath, Mark::Bars(0.5), Mark::Rule] {
                assert!(figures(scaling, mark, hostile.clone())["x"][0].is_number());
                assert!(figures(scaling, mark, Vec::new())["y"][1].is_number());
            }
        }
        let decades = figures(Scaling::Decades, Mark::Path, vec![[0.0, 0.01], [1.0, 0.0]]);
        assert_eq!(decades["series"][0]["points"], json!([0, 0.01, null, null]));
        assert_eq!(decades["scaling"], "decades");
    }

    #[test]
    fn bars_keep_their_width_and_a_long_line_its_peak() {
        let bars = figures(Scaling::FromZero, Mark::Bars(0.25), vec![[0.0, 3.0]]);
        assert_eq!(bars["series"][0]["size"], 0.25);
        let mut points: Vec<[f64; 2]> = (0..50_000).map(|i| [f64::from(i), 1.0]).collect();
        points[31_234][1] = 100.0;
        let line = figures(Scaling::Free, Mark::Line, points);
        let kept = line["series"][0]["points"].as_array().unwrap();
        let peak = kept.iter().position(|value| *value == json!(100)).unwrap();
        assert!((kept[peak - 1].as_f64().unwrap() - 31_234.0).abs() < 1.0);
        assert!(kept.len() < 5000);
    }
}
