//! Positions of a chart's values in its picture.

use crate::service::results::report::axis::Range;

/// Space to the left of, above, to the right of and below the plot.
pub(super) const MARGIN: [f64; 4] = [66.0, 34.0, 14.0, 42.0];

/// Places values of the axes in the picture.
pub(super) struct Frame {
    pub(super) x: Range,
    /// Range of the values, or of their decimal logarithms.
    pub(super) y: Range,
    pub(super) in_decades: bool,
    pub(super) width: f64,
    pub(super) height: f64,
}

impl Frame {
    /// Position of a point in the picture.
    pub(super) fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let y = if self.in_decades { y.log10() } else { y };
        [
            MARGIN[0] + (x - self.x.low) / self.x.width() * self.width,
            MARGIN[1] + (self.y.high - y) / self.y.width() * self.height,
        ]
    }
}
