//! Which keyframes see which points.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::window::keyframe::{WindowKeyframe, WindowPoint};
use nalgebra::Vector3;

/// Pixels at the border where a pattern is not compared.
const MARGIN_PX: f64 = 4.0;
/// Cosine of the largest angle between two lines of sight: beyond 40° things look different.
const MIN_COSINE: f64 = 0.766;
/// Largest ratio of the distances from which a point is seen: beyond, a pattern covers something else.
const MAX_DISTANCE_RATIO: f64 = 2.0;
/// Nearest that a point may be to an observer, in its distance from its host.
const MIN_DEPTH_RATIO: f64 = 0.05;

/// A point and where the list of its observers is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointView {
    /// Place among its host's points.
    pub point: usize,
    /// First of its observers.
    pub first: usize,
    /// Number of them.
    pub count: usize,
}

/// All comparisons of an adjustment, in their order: by host, point, observer.
#[derive(Debug, Clone, Default)]
pub struct Views {
    /// Members that see a point; of all points one after the other.
    pub observers: Vec<usize>,
    points: Vec<PointView>,
    /// End of each host's part of the points.
    ends: Vec<usize>,
}

impl Views {
    /// Every living point of the members that a host may be, with every other member that may observe and sees it.
    pub fn find(
        &mut self,
        keyframes: &[WindowKeyframe],
        members: &[usize],
        camera: &Intrinsics,
        mut may: impl FnMut(usize, usize) -> bool,
    ) {
        self.observers.clear();
        self.points.clear();
        self.ends.clear();
        let mut seen_by = Vec::with_capacity(members.len());
        for (host, &index) in members.iter().enumerate() {
            let map_from_host = keyframes[index].camera_from_map.inverse();
            seen_by.clear();
            for (observer, &other) in members.iter().enumerate() {
                if observer != host && may(host, observer) {
                    let observer_from_host = keyframes[other].camera_from_map * map_from_host;
                    seen_by.push((observer, Sight::new(&observer_from_host, camera)));
                }
            }
            for (point, of) in keyframes[index].points.iter().enumerate() {
                if !of.is_alive {
                    continue;
                }
                let first = self.observers.len();
                let seeing = seen_by.iter().filter(|(_, sight)| sight.project(of).is_some());
                self.observers.extend(seeing.map(|(observer, _)| *observer));
                let count = self.observers.len() - first;
                if count > 0 {
                    self.points.push(PointView { point, first, count });
                }
            }
            self.ends.push(self.points.len());
        }
    }

    /// Each host with its points.
    pub fn of_hosts(&self) -> impl Iterator<Item = (usize, &[PointView])> {
        let begins = std::iter::once(0).chain(self.ends.iter().copied());
        let parts = begins.zip(&self.ends).map(|(begin, &end)| &self.points[begin..end]);
        parts.enumerate().filter(|(_, points)| !points.is_empty())
    }

    /// Each point with its host.
    pub fn with_hosts(&self) -> impl Iterator<Item = (usize, &PointView)> {
        self.of_hosts().flat_map(|(host, points)| points.iter().map(move |point| (host, point)))
    }
}

/// How one keyframe sees another's points.
#[derive(Debug, Clone, Copy)]
pub struct Sight {
    rotation: nalgebra::Matrix3<f64>,
    translation: Vector3<f64>,
    camera: Intrinsics,
}

/// A point as an observer sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// Column, level 0.
    pub u: f64,
    /// Row.
    pub v: f64,
    /// Its inverse depth there.
    pub inverse_depth: f64,
}

impl Sight {
    /// From where an observer stands.
    pub fn new(observer_from_host: &SE3, camera: &Intrinsics) -> Self {
        Self {
            rotation: observer_from_host.rotation_matrix(),
            translation: observer_from_host.translation,
            camera: *camera,
        }
    }

    /// Where the observer sees a point, if it does so well enough to be compared.
    pub fn project(&self, point: &WindowPoint) -> Option<Projected> {
        let Intrinsics { fx, fy, cx, cy, width, height } = self.camera;
        let ray = Vector3::new(f64::from(point.ray[0]), f64::from(point.ray[1]), 1.0);
        let turned = self.rotation * ray;
        let scaled = turned + point.inverse_depth * self.translation;
        if !(scaled.z >= MIN_DEPTH_RATIO) {
            return None;
        }
        let (u, v) = (fx * scaled.x / scaled.z + cx, fy * scaled.y / scaled.z + cy);
        let inside = |at: f64, side: usize| at > MARGIN_PX && at < side as f64 - 1.0 - MARGIN_PX;
        let ratio = scaled.norm() / turned.norm();
        let is_seen = inside(u, width)
            && inside(v, height)
            && turned.dot(&scaled) >= MIN_COSINE * turned.norm() * scaled.norm()
            && (1.0 / MAX_DISTANCE_RATIO..=MAX_DISTANCE_RATIO).contains(&ratio);
        is_seen.then(|| Projected { u, v, inverse_depth: point.inverse_depth / scaled.z })
    }
}
