//! Selects the points of a keyframe's depth that take part in the joint estimation.

use std::collections::HashSet;

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::DepthPoint;
use crate::slam::window::params::WindowParams;

/// Pixels at the border that no point is chosen in: pattern and gradients stay inside.
const BORDER_PX: u16 = 4;

/// Like [`choose`], followed by as many more as there are in up to `max_points` cells, in an order of which every
/// prefix is spread over the image.
pub fn choose_spread(
    points: &[DepthPoint],
    pixels: &[u8],
    camera: &Intrinsics,
    params: &WindowParams,
) -> Vec<DepthPoint> {
    /// Stride through the others.
    const STEP: usize = 8;
    let of = |num_cells| choose(points, pixels, camera, num_cells, params);
    let (num_cells, most_cells) = (params.points, params.max_points);
    let mut chosen = of(num_cells);
    if most_cells > num_cells {
        let known: HashSet<(u16, u16)> = chosen.iter().map(|point| (point.u, point.v)).collect();
        let mut others = of(most_cells);
        others.retain(|point| !known.contains(&(point.u, point.v)));
        let spread = (0..STEP).flat_map(|first| others.iter().skip(first).step_by(STEP));
        chosen.extend(spread);
        chosen.truncate(most_cells);
    }
    chosen
}

/// Chooses the most certain points with gradient, at most one in each of `num_cells` cells of the image, cell by cell.
pub fn choose(
    points: &[DepthPoint],
    pixels: &[u8],
    camera: &Intrinsics,
    num_cells: usize,
    params: &WindowParams,
) -> Vec<DepthPoint> {
    let WindowParams { min_gradient, max_relative_deviation, .. } = *params;
    let (width, height) = (camera.width, camera.height);
    let side = ((width * height) as f64 / num_cells.max(1) as f64).sqrt().max(1.0);
    let columns = (width as f64 / side).ceil() as usize;
    let rows = (height as f64 / side).ceil() as usize;
    let mut best: Vec<Option<(f32, DepthPoint)>> = vec![None; columns * rows];
    let most = (max_relative_deviation * max_relative_deviation) as f32;
    let inside = |at: u16, side: usize| at >= BORDER_PX && usize::from(at + BORDER_PX) + 1 < side;
    for point in points {
        if !(inside(point.u, width) && inside(point.v, height) && point.inverse_depth > 0.0) {
            continue;
        }
        let relative = point.variance / (point.inverse_depth * point.inverse_depth);
        let (u, v) = (usize::from(point.u), usize::from(point.v));
        let cell = (v as f64 / side) as usize * columns + (u as f64 / side) as usize;
        let is_better = best[cell].is_none_or(|(least, _)| relative < least);
        if relative <= most && is_better && gradient(pixels, width, u, v) >= min_gradient {
            best[cell] = Some((relative, *point));
        }
    }
    best.into_iter().flatten().map(|(_, point)| point).collect()
}

/// Gradient by central differences, grey levels a pixel.
fn gradient(pixels: &[u8], width: usize, u: usize, v: usize) -> f64 {
    let at = |u: usize, v: usize| f64::from(pixels[v * width + u]);
    (0.5 * (at(u + 1, v) - at(u - 1, v))).hypot(0.5 * (at(u, v + 1) - at(u, v - 1)))
}

/// The point at a pixel, among a keyframe's points in row-major order.
pub fn at_pixel(points: &[DepthPoint], u: u16, v: u16) -> Option<&DepthPoint> {
    let place = points.binary_search_by_key(&(v, u), |point| (point.v, point.u)).ok()?;
    points.get(place)
}

/// The points of a keyframe by row, for looking up many positions.
pub struct Rows<'a> {
    points: &'a [DepthPoint],
    /// Where each row begins, and the end.
    begins: Vec<usize>,
}

impl<'a> Rows<'a> {
    /// Indexes points in row-major order, of an image with this many rows.
    pub fn of(points: &'a [DepthPoint], rows: usize) -> Self {
        let begin = |row: usize| points.partition_point(|point| usize::from(point.v) < row);
        Self { points, begins: (0..=rows).map(begin).collect() }
    }

    /// The point nearest to a position, within a pixel of it.
    pub fn near(&self, u: f64, v: f64) -> Option<&'a DepthPoint> {
        let (column, row) = (u.round(), v.round());
        if !(column >= 1.0 && row >= 1.0 && column < 65_535.0 && row < 65_535.0) {
            return None;
        }
        let (column, row) = (column as u16, usize::from(row as u16));
        let around = (row - 1..=row + 1).flat_map(|row| {
            let bounds = self.begins.get(row).zip(self.begins.get(row + 1));
            let of_row =
                bounds.map_or(&self.points[..0], |(&begin, &end)| &self.points[begin..end]);
            let first = of_row.partition_point(|point| point.u < column - 1);
            of_row[first..].iter().take_while(move |point| point.u <= column + 1)
        });
        let distance = |p: &DepthPoint| (f64::from(p.u) - u).hypot(f64::from(p.v) - v);
        around.min_by(|one, other| distance(one).total_cmp(&distance(other)))
    }
}
