//! Every figure of the summary in writing.

use std::fmt::Write;

use serde_json::{Map, Value};

use crate::service::results::report::html::escaped;
use crate::service::results::summary::Summary;

/// What has a place of its own on the page.
const DRAWN: [&str; 3] = ["budget_curve", "grade", "keyframe_depth"];

/// The figures as a list, and those that are lists themselves as tables.
pub fn figures(summary: &Summary) -> String {
    let mut html = String::from("<section><h2>Figures</h2><dl>");
    let value = serde_json::to_value(summary).unwrap_or_default();
    let entries = value.as_object().into_iter().flatten();
    let shown = entries.filter(|(key, value)| !DRAWN.contains(&key.as_str()) && has_figures(value));
    let mut tables = String::new();
    for (key, value) in shown {
        match value {
            Value::Array(rows) if rows.iter().all(Value::is_object) => {
                let _ = write!(tables, "<h2>{key}</h2>{}", table(rows));
            }
            // Figures of another trajectory under the same names: one entry each.
            Value::Object(inner) if key == "online" => {
                for (name, value) in inner.iter().filter(|(_, value)| has_figures(value)) {
                    entry(&mut html, &format!("{key}.{name}"), value);
                }
            }
            other => entry(&mut html, key, other),
        }
    }
    let _ = write!(html, "</dl>{tables}</section>");
    html
}

/// Whether there is anything to tell.
fn has_figures(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Object(entries) => !entries.values().all(Value::is_null),
        Value::Array(values) => !values.is_empty(),
        _ => true,
    }
}

fn entry(html: &mut String, key: &str, value: &Value) {
    let _ = write!(html, "<div><dt>{key}</dt><dd>{}</dd></div>", escaped(&figure(value)));
}

/// Rows that have the same keys.
fn table(rows: &[Value]) -> String {
    let rows: Vec<&Map<String, Value>> = rows.iter().filter_map(Value::as_object).collect();
    let mut html = String::from("<div class=\"table\"><table><tr>");
    for key in rows.first().into_iter().flat_map(|row| row.keys()) {
        let _ = write!(html, "<th>{key}</th>");
    }
    for row in rows {
        html.push_str("</tr><tr>");
        for value in row.values() {
            let _ = write!(html, "<td>{}</td>", escaped(&figure(value)));
        }
    }
    html.push_str("</tr></table></div>");
    html
}

/// A number with at most five significant digits after the point; text as it is; several with
/// their names.
fn figure(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Object(entries) => {
            let entries = entries.iter().filter(|(_, value)| !value.is_null());
            let named = entries.map(|(key, value)| format!("{key} {}", figure(value)));
            named.collect::<Vec<_>>().join(", ")
        }
        Value::Array(values) => {
            let separator = if values.iter().any(|value| value.is_object()) { "; " } else { ", " };
            values.iter().map(figure).collect::<Vec<_>>().join(separator)
        }
        Value::Number(number) if number.is_f64() => {
            let number = number.as_f64().unwrap_or(f64::NAN);
            if number != 0.0 && number.abs() < 1e-3 {
                format!("{number:.3e}")
            } else {
                format!("{number:.4}")
            }
        }
        other => other.to_string(),
    }
}
