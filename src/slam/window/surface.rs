//! How far a keyframe sees in each part of its image: points behind that are hidden.
//!
//! A keyframe has the points of the next room in view through a wall, more of them than of its own surroundings if it
//! sees the wall from near, and on walls of little contrast half of the comparisons with them are inliers by chance.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::DepthPoint;

/// Side of a part: a door three metres away is four parts wide at f = 500, and an image half as large has enough parts.
const CELL_PX: usize = 32;
/// One in this many points is used.
const STEP: usize = 4;
/// Fewest of these in a part for its depth to be known.
const MIN_CELL_POINTS: usize = 5;
/// Share of these that may be beyond what is taken as the farthest: wrong matches, mostly.
const OUTLIERS: f64 = 0.1;
/// A point this many times as far as the farthest that is seen there is hidden. Depth and unit of a keyframe are more
/// accurate than that, and points behind a wall seen from near are further away than that.
const HIDDEN_RATIO: f64 = 1.5;

/// A point as an observer sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// Column, level 0.
    pub u: f64,
    /// Row.
    pub v: f64,
    /// Its inverse depth in the observer.
    pub inverse_depth: f64,
}

/// The farthest depth in each part of a keyframe's image.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Surface {
    columns: usize,
    /// Smallest inverse depth of each part, row by row, in the keyframe's unit; 0 where it is unknown.
    least: Vec<f32>,
}

impl Surface {
    /// The surface of a keyframe with this depth, in its unit.
    pub fn of(points: &[DepthPoint], camera: &Intrinsics) -> Self {
        let columns = camera.width.div_ceil(CELL_PX);
        let rows = camera.height.div_ceil(CELL_PX);
        let mut parts: Vec<Vec<f32>> = vec![Vec::new(); columns * rows];
        for point in points.iter().step_by(STEP) {
            let (column, row) = (usize::from(point.u) / CELL_PX, usize::from(point.v) / CELL_PX);
            let is_inside = column < columns && point.inverse_depth > 0.0;
            if let Some(part) = parts.get_mut(row * columns + column).filter(|_| is_inside) {
                part.push(point.inverse_depth);
            }
        }
        let least = parts.into_iter().map(|mut part| {
            let outliers = (OUTLIERS * part.len() as f64) as usize;
            match part.len() >= MIN_CELL_POINTS {
                true => *part.select_nth_unstable_by(outliers, f32::total_cmp).1,
                false => 0.0,
            }
        });
        Self { columns, least: least.collect() }
    }

    /// Whether the surface hides a point that is projected into a keyframe of unit `unit`.
    pub fn hides(&self, seen: &Projected, unit: f64) -> bool {
        let (column, row) = (seen.u as usize / CELL_PX, seen.v as usize / CELL_PX);
        let least = self.least.get(row * self.columns + column).copied().unwrap_or(0.0);
        HIDDEN_RATIO * seen.inverse_depth * unit < f64::from(least)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::CAMERA;

    /// A wall at inverse depth 1 with a door in it, from column 128 to 192, behind which depth is four times as large;
    /// about one point in twenty is wrong.
    fn wall_with_a_door() -> Vec<DepthPoint> {
        let pixels = (0..CAMERA.height).flat_map(|v| (0..CAMERA.width).map(move |u| (u, v)));
        let point = |(k, (u, v)): (usize, (usize, usize))| {
            let is_door = (128..192).contains(&u);
            let is_wrong = (k / STEP).is_multiple_of(21);
            let inverse_depth = if is_wrong {
                0.01
            } else if is_door {
                0.25
            } else {
                1.0
            };
            DepthPoint { u: u as u16, v: v as u16, inverse_depth, variance: 1e-4, intensity: 0.0 }
        };
        pixels.enumerate().map(point).collect()
    }

    #[test]
    fn points_behind_the_wall_are_hidden_and_those_in_the_door_are_not() {
        let surface = Surface::of(&wall_with_a_door(), &CAMERA);
        let hides = |u: f64, inverse_depth: f64, unit: f64| {
            surface.hides(&Projected { u, v: 100.0, inverse_depth }, unit)
        };
        assert!(hides(40.0, 0.5, 1.0));
        assert!(!hides(40.0, 0.8, 1.0), "of the wall, and not quite right");
        assert!(!hides(40.0, 3.0, 1.0), "before the wall");
        assert!(!hides(160.0, 0.25, 1.0) && !hides(160.0, 0.5, 1.0));
        assert!(hides(160.0, 0.1, 1.0));
        assert!(!hides(40.0, 0.5, 2.0) && hides(40.0, 0.3, 2.0), "in the keyframe's unit");
    }

    #[test]
    fn nothing_is_hidden_where_the_surface_is_unknown() {
        let far = Projected { u: 40.0, v: 100.0, inverse_depth: 1e-6 };
        assert!(!Surface::default().hides(&far, 1.0));
        assert!(!Surface::of(&[], &CAMERA).hides(&far, 1.0));
        let beside =
            DepthPoint { u: u16::MAX, v: 3, inverse_depth: 1.0, variance: 1.0, intensity: 0.0 };
        assert!(!Surface::of(&[beside; 100], &CAMERA).hides(&far, 1.0));
    }
}
