//! The grade at the head of the report: level, reasons, what it cannot see, and its figures.

use std::fmt::Write;

use crate::service::results::report::html::escaped;
use crate::slam::evaluation::grade::{Grade, GradeLevel};

/// Renders the banner.
pub fn grade_banner(grade: &Grade) -> String {
    let class = match grade.level {
        GradeLevel::Good => "good",
        GradeLevel::Doubtful => "doubtful",
        GradeLevel::Poor => "poor",
        GradeLevel::NotJudged => "unjudged",
    };
    let mut html = format!(
        "<section class=\"grade {class}\"><h2>Grade without ground truth: <b>{}</b></h2><ul>",
        grade.level.name()
    );
    for reason in &grade.reasons {
        let _ = write!(html, "<li>{}</li>", escaped(reason));
    }
    let _ = write!(
        html,
        "</ul><p class=\"caveat\">What it cannot see: {}.</p><details><summary>Figures</summary><dl>",
        escaped(&grade.caveat)
    );
    for (name, value) in figures(grade) {
        let _ = write!(html, "<div><dt>{name}</dt><dd>{value}</dd></div>");
    }
    html.push_str("</dl></details></section>");
    html
}

/// The figures that are known, with their names.
fn figures(grade: &Grade) -> Vec<(&'static str, String)> {
    let figures = &grade.figures;
    let px = |value: Option<f64>| value.map(|px| format!("{px:.2} px"));
    let percent = |value: Option<f64>| value.map(|share| format!("{:.1} %", 100.0 * share));
    [
        ("pairs of keyframes far apart", Some(figures.wide_pairs.to_string())),
        ("widest pair", Some(format!("{} frames", figures.longest_span_frames))),
        ("misfit of pairs far apart", px(figures.wide_misfit_px)),
        ("misfit of neighbouring keyframes", px(figures.near_misfit_px)),
        ("patches found again", percent(figures.wide_found)),
        ("depth difference", percent(figures.wide_depth_difference)),
        ("depths within 3 sigma", percent(figures.wide_depth_within_3_sigma)),
        ("tilt between depths", percent(figures.wide_depth_tilt)),
    ]
    .into_iter()
    .filter_map(|(name, value)| Some((name, value?)))
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::evaluation::grade::GradeInput;

    #[test]
    fn a_run_without_a_grade_has_no_colour_and_gives_the_reason() {
        let html = grade_banner(&Grade::of(&GradeInput::default()));
        assert!(html.contains("class=\"grade unjudged\"") && html.contains("not judged"), "{html}");
        assert!(html.contains("no frame was tracked") && html.contains("cannot see"), "{html}");
        assert!(!html.contains("NaN") && !html.contains("None"));
    }
}
