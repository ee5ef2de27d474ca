//! Distance of a map's points from the true surface, where true depth is known.

use std::collections::HashMap;

use nalgebra::Vector3;

use crate::slam::evaluation::statistics::median;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;

/// Distance between the points of the true surface, metres: walls are exact in between, as each has a normal.
const SPACING: f64 = 0.015;
/// Pixel step through the true depth along each axis: about [`SPACING`] in a room.
const STRIDE: usize = 2;
/// Search radius around a point, metres; beyond, its distance counts as this.
pub const REACH: f64 = 0.15;
/// Error above which a point is off, as a share of its distance.
const OFF_RATIO: f64 = 0.03;
/// Error up to which a point is right, as a share of its distance.
const RIGHT_RATIO: f64 = 0.01;
/// Distance within which a point shows the same as another, as a share of its distance.
const SHOWN_RATIO: f64 = 0.02;
/// Largest difference of neighbouring depths on one surface, as a share.
const STEP: f64 = 0.02;

/// The surface that true depth images show, as points with normals.
#[derive(Debug, Default)]
pub struct TrueSurface {
    /// The first point of each cell of [`SPACING`], and its normal.
    points: HashMap<[i32; 3], (Vector3<f64>, Vector3<f64>)>,
    /// The points of each cell of [`REACH`].
    near: HashMap<[i32; 3], Vec<[i32; 3]>>,
}

/// Distances of points from the true surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceErrors {
    /// Median distance, metres.
    pub median_m: f64,
    /// Median distance, as a share of the distance from the camera that saw the point.
    pub median_ratio: f64,
    /// Share of the points that are off by more than 3 % of that distance, 0 to 1.
    pub off: f64,
}

/// A point seen by a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenPoint {
    /// Position, metres.
    pub position: Vector3<f64>,
    /// Distance from the camera, metres.
    pub distance: f64,
}

fn cell(at: &Vector3<f64>, side: f64) -> [i32; 3] {
    [at.x, at.y, at.z].map(|c| (c / side).floor() as i32)
}

/// The nearer of a point with its normal and the nearest so far: distance to the point, and to the surface there.
fn nearer(
    at: &Vector3<f64>,
    (point, normal): &(Vector3<f64>, Vector3<f64>),
    nearest: (f64, f64),
) -> (f64, f64) {
    let offset = at - point;
    let distance = offset.norm();
    if distance >= nearest.0 {
        return nearest;
    }
    let off = normal.dot(&offset);
    // Off the edge of the surface, its plane does not count.
    let is_beside = (offset - normal * off).norm() > 2.0 * SPACING;
    (distance, if is_beside { distance } else { off.abs() })
}

impl TrueSurface {
    /// Adds the surface of a true depth image (metres, 0 where unknown).
    pub fn add(&mut self, depth: &Image<f32>, k: &Intrinsics, world_from_camera: &SE3) {
        let at = |u: usize, v: usize| {
            let z = f64::from(depth.at(u, v));
            k.ray(u as f64, v as f64) * z
        };
        for v in (0..k.height - 1).step_by(STRIDE) {
            for u in (0..k.width - 1).step_by(STRIDE) {
                let (p, right, down) = (at(u, v), at(u + 1, v), at(u, v + 1));
                let is_whole = [right, down].iter().all(|q| (q.z - p.z).abs() <= STEP * p.z);
                if !(p.z > 0.0 && is_whole) {
                    continue;
                }
                let normal = (right - p).cross(&(down - p)).normalize();
                let (p, normal) = (*world_from_camera * p, world_from_camera.rotation * normal);
                let key = cell(&p, SPACING);
                if let std::collections::hash_map::Entry::Vacant(free) = self.points.entry(key) {
                    free.insert((p, normal));
                    self.near.entry(cell(&p, REACH)).or_default().push(key);
                }
            }
        }
    }

    /// Its points, in no particular order.
    pub fn points(&self) -> impl Iterator<Item = &Vector3<f64>> {
        self.points.values().map(|(point, _)| point)
    }

    /// Distance of a point, metres: to the plane of the nearest surface point, [`REACH`] where there is none.
    pub fn distance(&self, at: &Vector3<f64>) -> f64 {
        let mut nearest = (REACH, REACH);
        // Most points lie on the surface.
        around(cell(at, SPACING)).filter_map(|key| self.points.get(&key)).for_each(|point| {
            nearest = nearer(at, point, nearest);
        });
        if nearest.0 > SPACING {
            let keys = around(cell(at, REACH)).filter_map(|key| self.near.get(&key)).flatten();
            keys.for_each(|key| nearest = nearer(at, &self.points[key], nearest));
        }
        nearest.1
    }

    /// Errors of points; `None` for no points.
    pub fn errors(&self, points: &[SeenPoint]) -> Option<SurfaceErrors> {
        let errors: Vec<f64> = points.iter().map(|point| self.distance(&point.position)).collect();
        let ratio = |(error, point): (&f64, &SeenPoint)| error / point.distance;
        let ratios: Vec<f64> = errors.iter().zip(points).map(ratio).collect();
        let off = ratios.iter().filter(|&&ratio| ratio > OFF_RATIO).count();
        Some(SurfaceErrors {
            median_m: median(&errors)?,
            median_ratio: median(&ratios)?,
            off: off as f64 / ratios.len() as f64,
        })
    }

    /// Of those of `all` points that are right, the share with a point of `few` near it, 0 to 1: how much of what all
    /// points show the few still show.
    pub fn shown(&self, all: &[SeenPoint], few: &[SeenPoint]) -> f64 {
        let mut cells: HashMap<[i32; 3], Vec<&Vector3<f64>>> = HashMap::new();
        for point in few {
            cells.entry(cell(&point.position, REACH)).or_default().push(&point.position);
        }
        let is_right =
            |point: &&SeenPoint| self.distance(&point.position) <= RIGHT_RATIO * point.distance;
        let is_shown = |point: &&SeenPoint| {
            let reach = (SHOWN_RATIO * point.distance).min(REACH);
            around(cell(&point.position, REACH))
                .filter_map(|key| cells.get(&key))
                .flatten()
                .any(|other| (*other - point.position).norm() <= reach)
        };
        let right: Vec<&SeenPoint> = all.iter().filter(is_right).collect();
        right.iter().filter(|point| is_shown(point)).count() as f64 / right.len().max(1) as f64
    }
}

/// A cell and its 26 neighbours.
fn around([x, y, z]: [i32; 3]) -> impl Iterator<Item = [i32; 3]> {
    (0..27).map(move |i| [x + i / 9 - 1, y + i / 3 % 3 - 1, z + i % 3 - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall at 2 m.
    fn wall() -> TrueSurface {
        let camera = Intrinsics::pinhole(200, 100, 150.0);
        let mut surface = TrueSurface::default();
        surface.add(&Image::filled(200, 100, 2.0), &camera, &SE3::identity());
        surface
    }

    fn seen(x: f64, z: f64) -> SeenPoint {
        SeenPoint { position: Vector3::new(x, 0.1, z), distance: 2.0 }
    }

    #[test]
    fn distances_are_those_from_the_wall() {
        let wall = wall();
        for (x, z, distance) in [
            (0.0, 2.0, 0.0),
            (0.3, 2.013, 0.013),
            (-0.5, 1.9, 0.1),
            (0.0, 2.5, REACH),
            (0.0, 0.5, REACH),
        ] {
            let found = wall.distance(&seen(x, z).position);
            assert!((found - distance).abs() < 1e-6, "{x} {z}: {found}");
        }
        // Off its edge, which is at x = 1.32.
        let beside = wall.distance(&Vector3::new(1.42, 0.1, 2.0));
        assert!((beside - 0.1).abs() < 0.03, "{beside}");
    }

    #[test]
    fn errors_and_the_share_that_few_points_show() {
        let wall = wall();
        let all: Vec<SeenPoint> = (0..100).map(|i| seen(0.01 * f64::from(i), 2.0)).collect();
        let off: Vec<SeenPoint> =
            (0..100).map(|i| seen(0.01 * f64::from(i), 2.001 * f64::from(1 + i % 4 / 3))).collect();
        let errors = wall.errors(&off).unwrap();
        assert!(
            (errors.off - 0.25).abs() < 1e-9 && (errors.median_m - 0.001).abs() < 1e-6,
            "{errors:?}"
        );
        assert_eq!(wall.errors(&[]), None);
        let half: Vec<SeenPoint> = all.iter().filter(|p| p.position.x < 0.495).copied().collect();
        // The 2 % of 2 m beyond the last of them are shown too.
        let shown = wall.shown(&all, &half);
        assert!((shown - 0.54).abs() < 0.011, "{shown}");
        assert_eq!(wall.shown(&[], &half), 0.0);
    }
}
