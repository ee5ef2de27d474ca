//! Points of a chart that are drawn in one style.

/// How the points of a series are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Mark {
    /// A line over x in ascending order; its extremes survive when it is thinned. NaN breaks it.
    Line,
    /// A line in any direction.
    Path,
    /// A dashed line in any direction.
    DashedPath,
    /// Dots of this radius.
    Dots(f64),
    /// Bars from zero, of this width in x.
    Bars(f64),
    /// A vertical line across the plot at each x.
    Rule,
}

/// Points drawn in one style.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend; an empty one has no entry.
    pub name: &'static str,
    /// CSS colour.
    pub colour: &'static str,
    /// How the points are drawn.
    pub mark: Mark,
    /// x and y.
    pub points: Vec<[f64; 2]>,
}

impl Series {
    /// Points with a name and a colour, drawn as `mark`.
    pub fn new(
        name: &'static str,
        colour: &'static str,
        mark: Mark,
        points: Vec<[f64; 2]>,
    ) -> Self {
        Self { name, colour, mark, points }
    }
}
