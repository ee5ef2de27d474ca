//! Charts as inline SVG: lines, paths, dots, bars and bands over two axes.

use std::fmt::Write;

use crate::service::results::report::axis::Range;
use crate::service::results::report::chart_frame::{Frame, MARGIN};
use crate::service::results::report::chart_points::thinned;
use crate::service::results::report::html::escaped;
use crate::service::results::report::series::{Mark, Series};

/// Width of every chart's coordinate system; the page scales it.
pub const CHART_WIDTH: f64 = 640.0;

/// How the axes are scaled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scaling {
    /// Independently.
    Free,
    /// Independently, y from zero.
    FromZero,
    /// With equal units along x and y.
    Equal,
    /// Independently, y in decades; only values above zero are shown.
    Decades,
}

/// A chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// What it shows.
    pub title: &'static str,
    /// Its meaning and what is good, in one line below it; may be empty.
    pub meaning: &'static str,
    /// Label of the x axis.
    pub x_label: String,
    /// Label of the y axis.
    pub y_label: String,
    /// Height of the coordinate system.
    pub height: f64,
    /// How the axes are scaled.
    pub scaling: Scaling,
    /// The series to draw, the first at the bottom.
    pub series: Vec<Series>,
}

impl Chart {
    /// A low chart of a quantity over the run.
    pub fn over_time(
        title: &'static str,
        meaning: &'static str,
        y_label: &str,
        scaling: Scaling,
        series: Vec<Series>,
    ) -> Self {
        let (x_label, y_label) = ("time [s]".into(), y_label.into());
        Self { title, meaning, x_label, y_label, height: 230.0, scaling, series }
    }

    /// The chart as an `<svg>` element. Its text takes the page's colour.
    pub fn svg(&self) -> String {
        let frame = self.frame();
        let mut svg = format!(
            "<svg class=\"chart\" xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {CHART_WIDTH} {}\" \
             font-family=\"system-ui, sans-serif\" font-size=\"12\" fill=\"currentColor\" role=\"img\">\
             <title>{}</title>",
            self.height,
            escaped(self.title)
        );
        draw_text(
            &mut svg,
            MARGIN[0],
            18.0,
            "start",
            "font-weight=\"600\" font-size=\"13\"",
            self.title,
        );
        self.draw_legend(&mut svg);
        self.draw_axes(&mut svg, &frame);
        for series in &self.series {
            draw_series(&mut svg, &frame, series);
        }
        if self.series.iter().all(|series| series.points.is_empty()) {
            let (x, y) = (MARGIN[0] + 0.5 * frame.width, MARGIN[1] + 0.5 * frame.height);
            draw_text(&mut svg, x, y, "middle", "opacity=\"0.6\"", "nothing to show");
        }
        svg.push_str("</svg>");
        svg
    }

    /// Ranges of the axes, with equal units along both where that is requested.
    pub(super) fn frame(&self) -> Frame {
        let mut frame = self.tight_frame();
        if self.scaling == Scaling::Equal {
            let unit = (frame.x.width() / frame.width).max(frame.y.width() / frame.height);
            frame.x = frame.x.widened_to(unit * frame.width);
            frame.y = frame.y.widened_to(unit * frame.height);
        }
        frame
    }

    /// Ranges that the points need.
    pub(super) fn tight_frame(&self) -> Frame {
        let points = || self.series.iter().flat_map(|series| &series.points);
        let drawn = || {
            let drawn = self.series.iter().filter(|series| series.mark != Mark::Rule);
            drawn.flat_map(|series| &series.points)
        };
        let in_decades = self.scaling == Scaling::Decades;
        let height_of = |y: f64| if in_decades { y.log10() } else { y };
        let y = Range::around(drawn().map(|p| height_of(p[1])));
        Frame {
            x: Range::around(points().map(|p| p[0])),
            y: if self.scaling == Scaling::FromZero { y.begun_at_zero() } else { y },
            in_decades,
            width: CHART_WIDTH - MARGIN[0] - MARGIN[2],
            height: self.height - MARGIN[1] - MARGIN[3],
        }
    }

    /// Draws names with a stroke of their colour, from the right end of the title's line.
    fn draw_legend(&self, svg: &mut String) {
        const LETTER: f64 = 6.6;
        let mut right = CHART_WIDTH - MARGIN[2];
        for series in self.series.iter().rev().filter(|series| !series.name.is_empty()) {
            draw_text(svg, right, 18.0, "end", "opacity=\"0.8\"", series.name);
            right -= LETTER * series.name.chars().count() as f64 + 8.0;
            let (path, width, style) = match series.mark {
                Mark::Dots(_) => ("h0", 7, " stroke-linecap=\"round\""),
                Mark::DashedPath | Mark::Rule => ("h16", 3, DASH),
                _ => ("h16", 3, ""),
            };
            let start = if path == "h0" { right - 5.0 } else { right - 16.0 };
            let _ = write!(
                svg,
                "<path d=\"M{start:.1} 14{path}\" stroke=\"{}\" stroke-width=\"{width}\"{style}/>",
                series.colour
            );
            right -= 32.0;
        }
    }

    fn draw_axes(&self, svg: &mut String, frame: &Frame) {
        let (left, top) = (MARGIN[0], MARGIN[1]);
        let (right, bottom) = (left + frame.width, top + frame.height);
        let mut grid = String::new();
        for (value, text) in frame.x.ticks() {
            let [x, _] = frame.place([value, frame.y.low]);
            let _ = write!(grid, "M{x:.1} {top:.1}V{bottom:.1}");
            draw_text(svg, x, bottom + 16.0, "middle", "opacity=\"0.75\"", &text);
        }
        let ticks = if frame.in_decades { frame.y.decade_ticks() } else { frame.y.ticks() };
        for (value, text) in ticks {
            let [_, y] = frame.place([frame.x.low, value]);
            let _ = write!(grid, "M{left:.1} {y:.1}H{right:.1}");
            draw_text(svg, left - 7.0, y + 4.0, "end", "opacity=\"0.75\"", &text);
        }
        let _ = write!(svg, "<path d=\"{grid}\" stroke=\"currentColor\" opacity=\"0.12\"/>");
        let _ = write!(
            svg,
            "<path d=\"M{left:.1} {top:.1}V{bottom:.1}H{right:.1}\" fill=\"none\" \
             stroke=\"currentColor\" opacity=\"0.45\"/>"
        );
        let middle = left + 0.5 * frame.width;
        draw_text(svg, middle, self.height - 6.0, "middle", "opacity=\"0.75\"", &self.x_label);
        let y = top + 0.5 * frame.height;
        let turned = format!("opacity=\"0.75\" transform=\"rotate(-90 12 {y:.1})\"");
        draw_text(svg, 12.0, y, "middle", &turned, &self.y_label);
    }
}

/// Charts in rows of `columns` as an SVG file with a white background.
pub fn svg_file(charts: &[Chart], columns: usize) -> String {
    let rows: Vec<&[Chart]> = charts.chunks(columns.max(1)).collect();
    let highest = |row: &[Chart]| row.iter().map(|chart| chart.height).fold(0.0, f64::max);
    let height: f64 = rows.iter().map(|row| highest(row)).sum();
    let width = CHART_WIDTH * columns.max(1) as f64;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
         color=\"#1c2230\"><rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>"
    );
    let mut top = 0.0;
    for row in rows {
        for (column, chart) in row.iter().enumerate() {
            // Each chart has its own viewBox; this element gives it position and size.
            let _ = write!(
                svg,
                "<svg x=\"{}\" y=\"{top}\" width=\"{CHART_WIDTH}\" height=\"{}\">{}</svg>",
                column as f64 * CHART_WIDTH,
                chart.height,
                chart.svg()
            );
        }
        top += highest(row);
    }
    svg.push_str("</svg>\n");
    svg
}

const DASH: &str = " stroke-dasharray=\"6 4\"";

fn draw_text(svg: &mut String, x: f64, y: f64, anchor: &str, attributes: &str, text: &str) {
    let _ = write!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" {attributes}>{}</text>",
        escaped(text)
    );
}

fn draw_series(svg: &mut String, frame: &Frame, series: &Series) {
    let colour = series.colour;
    let placed = || thinned(frame, series).into_iter().map(|point| frame.place(point));
    let seen = || placed().filter(|p| p.iter().all(|c| c.is_finite()));
    match series.mark {
        Mark::Line => draw_line(svg, &joined(placed()), colour, "", 1.6),
        Mark::Path => draw_line(svg, &joined(placed()), colour, "", 1.8),
        Mark::DashedPath => draw_line(svg, &joined(placed()), colour, DASH, 1.6),
        Mark::Dots(radius) => {
            // A stroke of zero length with round ends is a dot.
            let path: String = seen().map(|[x, y]| format!("M{x:.1} {y:.1}h0")).collect();
            let round = " stroke-linecap=\"round\"";
            draw_line(svg, &path, colour, round, 2.0 * radius);
        }
        Mark::Bars(width) => {
            let mut path = String::new();
            for [left, top] in seen() {
                let right = left + width / frame.x.width() * frame.width;
                let [_, bottom] = frame.place([0.0, 0.0]);
                let _ = write!(path, "M{left:.1} {bottom:.1}V{top:.1}H{right:.1}V{bottom:.1}z");
            }
            let _ = write!(svg, "<path d=\"{path}\" fill=\"{colour}\" fill-opacity=\"0.75\"/>");
        }
        Mark::Rule => {
            let (top, bottom) = (MARGIN[1], MARGIN[1] + frame.height);
            let path: String =
                seen().map(|[x, _]| format!("M{x:.1} {top:.1}V{bottom:.1}")).collect();
            draw_line(svg, &path, colour, DASH, 1.4);
        }
    }
}

fn draw_line(svg: &mut String, path: &str, colour: &str, attributes: &str, width: f64) {
    let _ = write!(
        svg,
        "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width:.1}\" \
         stroke-linejoin=\"round\"{attributes}/>"
    );
}

/// An SVG path through the points, broken at those that are not finite.
fn joined(points: impl Iterator<Item = [f64; 2]>) -> String {
    let mut path = String::new();
    let mut draws = false;
    for [x, y] in points {
        let finite = x.is_finite() && y.is_finite();
        if finite {
            let _ = write!(path, "{}{x:.1} {y:.1}", if draws { 'L' } else { 'M' });
        }
        draws = finite;
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(mark: Mark, points: Vec<[f64; 2]>) -> Chart {
        Chart {
            title: "t",
            meaning: "",
            x_label: "x".into(),
            y_label: "<y>".into(),
            height: 240.0,
            scaling: Scaling::Free,
            series: vec![Series { name: "a", colour: "#000", mark, points }],
        }
    }

    #[test]
    fn long_series_are_thinned_and_keep_their_peak() {
        let mut points: Vec<[f64; 2]> = (0..50_000).map(|i| [f64::from(i), 1.0]).collect();
        points[31_234][1] = 100.0;
        points[0][1] = 0.0;
        let line = chart(Mark::Line, points.clone()).svg();
        assert!(line.len() < 100_000);
        let top = MARGIN[1] + (240.0 - MARGIN[1] - MARGIN[3]) * 0.04 / 1.08;
        assert!(line.contains(&format!(" {top:.1}L")), "the peak at y = {top:.1} is drawn");
        assert!(chart(Mark::Path, points).svg().len() < 100_000);
    }

    #[test]
    fn any_points_make_a_well_formed_picture() {
        let hostile = vec![
            [f64::NAN, 1.0],
            [0.0, f64::INFINITY],
            [1.0, 2.0],
            [f64::NAN, f64::NAN],
            [2.0, 1.0],
        ];
        for mark in [Mark::Line, Mark::Path, Mark::Dots(2.0), Mark::Bars(1.0), Mark::Rule] {
            for points in [hostile.clone(), Vec::new(), vec![[1.0, 1.0]]] {
                let svg = chart(mark, points).svg();
                assert!(!svg.contains("NaN") && !svg.contains("inf"), "{mark:?}: {svg}");
                assert!(svg.contains("&lt;y&gt;") && svg.ends_with("</svg>"));
            }
        }
        assert!(chart(Mark::Line, Vec::new()).svg().contains("nothing to show"));
    }

    #[test]
    fn decades_are_equally_spaced() {
        let points = vec![[0.0, 0.01], [1.0, 0.1], [2.0, 0.0], [3.0, 1.0]];
        let chart = Chart { scaling: Scaling::Decades, ..chart(Mark::Path, points) };
        let frame = chart.frame();
        let heights = [0.01, 0.1, 1.0].map(|y| frame.place([0.0, y])[1]);
        assert!((heights[0] - heights[1] - (heights[1] - heights[2])).abs() < 1e-9);
        assert!(heights[2] > MARGIN[1] && heights[0] < 240.0 - MARGIN[3]);
        let svg = chart.svg();
        assert!(svg.contains(">0.01<") && svg.contains(">0.1<") && svg.contains(">1<"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "zero has no place: {svg}");
    }
}
