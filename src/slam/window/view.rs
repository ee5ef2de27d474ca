//! Which keyframes see which points.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::window::comparison::{LANES, Patterns};
use crate::slam::window::keyframe::{WindowKeyframe, WindowPoint};
use crate::slam::window::surface::Projected;
use nalgebra::Vector3;

/// Pixels at the border where a pattern is not compared.
const MARGIN_PX: f64 = 4.0;
/// Cosine of the largest angle between two lines of sight: beyond 40° a surface looks different.
const MIN_COSINE: f64 = 0.766;
/// Largest ratio of the distances from which a point is seen: beyond it, a pattern covers something else.
const MAX_DISTANCE_RATIO: f64 = 2.0;
/// Least depth of a point in an observer, relative to that in its host.
pub(super) const MIN_DEPTH_RATIO: f64 = 0.05;

/// The points of a host that an observer sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairView {
    /// The host, by its index among the members.
    pub host: usize,
    /// The observer.
    pub observer: usize,
    /// First of its blocks of comparisons.
    pub block: usize,
    /// Number of them.
    pub count: usize,
}

impl PairView {
    /// Indices of its comparisons.
    pub fn places(&self) -> std::ops::Range<usize> {
        let first = LANES * self.block;
        first..first + self.count
    }

    /// Its blocks of comparisons.
    pub fn blocks(&self) -> std::ops::Range<usize> {
        self.block..self.block + self.count.div_ceil(LANES)
    }
}

/// A point and the range of its comparisons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointView {
    /// Its host, by its index among the members.
    pub host: usize,
    /// Index among its host's points.
    pub point: usize,
    first: usize,
    count: usize,
}

/// A comparison of a point.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Link {
    /// The observer, by its index among the members.
    pub observer: usize,
    /// Index of the comparison.
    pub place: usize,
}

/// All comparisons of an adjustment, ordered by observer, host, point: one image after the other is read.
#[derive(Debug, Clone, Default)]
pub struct Views {
    /// The pairs of keyframes of which one sees points of the other.
    pub pairs: Vec<PairView>,
    /// For each comparison, its point's index in `points`: those of a pair in blocks, of which the last may have room
    /// left, where the index is 0.
    pub slots: Vec<usize>,
    /// Appearance of the points, by block.
    pub patterns: Vec<Patterns>,
    /// The living points of all members, by host.
    pub points: Vec<PointView>,
    links: Vec<Link>,
    depths: Vec<f32>,
}

impl Views {
    /// Finds the living points of the members and which other members see each, where `may` allows the pair.
    pub fn find(
        &mut self,
        keyframes: &[WindowKeyframe],
        members: &[usize],
        camera: &Intrinsics,
        mut may: impl FnMut(usize, usize) -> bool,
    ) {
        self.pairs.clear();
        self.slots.clear();
        self.points.clear();
        for (host, &index) in members.iter().enumerate() {
            let alive = keyframes[index].points.iter().enumerate().filter(|(_, of)| of.is_alive);
            self.points.extend(alive.map(|(point, _)| PointView {
                host,
                point,
                first: 0,
                count: 0,
            }));
        }
        for (observer, &other) in members.iter().enumerate() {
            let mut end = 0;
            for (host, &index) in members.iter().enumerate() {
                let begin = end;
                end += self.points[begin..].iter().take_while(|point| point.host == host).count();
                if observer == host || begin == end || !may(host, observer) {
                    continue;
                }
                let map_from_host = keyframes[index].camera_from_map.inverse();
                let sight =
                    ObserverView::new(&(keyframes[other].camera_from_map * map_from_host), camera);
                let first = self.slots.len();
                let points = &keyframes[index].points;
                let sees = |slot: &usize| sight.sees(&points[self.points[*slot].point]);
                self.slots.extend((begin..end).filter(sees));
                let count = self.slots.len() - first;
                if count > 0 {
                    self.pairs.push(PairView { host, observer, block: first / LANES, count });
                    self.slots.resize(first + count.next_multiple_of(LANES), 0);
                }
            }
        }
        self.link();
    }

    /// Lists the comparisons of each point.
    fn link(&mut self) {
        for pair in &self.pairs {
            for place in pair.places() {
                self.points[self.slots[place]].count += 1;
            }
        }
        let mut end = 0;
        for point in &mut self.points {
            point.first = end;
            end += point.count;
            point.count = 0;
        }
        self.links.clear();
        self.links.resize(end, Link::default());
        for pair in &self.pairs {
            for place in pair.places() {
                let point = &mut self.points[self.slots[place]];
                self.links[point.first + point.count] = Link { observer: pair.observer, place };
                point.count += 1;
            }
        }
    }

    /// Fetches the appearance of the points at a level.
    pub fn sample_patterns(
        &mut self,
        keyframes: &[WindowKeyframe],
        members: &[usize],
        level: usize,
    ) {
        self.patterns.clear();
        self.patterns.resize(self.slots.len() / LANES, Patterns::NONE);
        for pair in &self.pairs {
            let points = &keyframes[members[pair.host]].points;
            for place in pair.places() {
                let point = &points[self.points[self.slots[place]].point];
                let patterns = &mut self.patterns[place / LANES];
                patterns.set(place % LANES, &point.appearances[level], point.ray);
            }
        }
    }

    /// Fetches the depths of the points.
    pub fn fetch_depths(&mut self, keyframes: &[WindowKeyframe], members: &[usize]) {
        self.depths.clear();
        self.depths.extend(
            self.points
                .iter()
                .map(|view| keyframes[members[view.host]].points[view.point].inverse_depth as f32),
        );
        for (patterns, slots) in self.patterns.iter_mut().zip(self.slots.chunks_exact(LANES)) {
            patterns.inverse_depth = std::array::from_fn(|lane| self.depths[slots[lane]]);
        }
    }

    /// The comparisons of a point, by observer.
    pub fn links(&self, point: &PointView) -> &[Link] {
        &self.links[point.first..point.first + point.count]
    }
}

/// An observer's view of another keyframe's points.
#[derive(Debug, Clone, Copy)]
pub struct ObserverView {
    rotation: nalgebra::Matrix3<f64>,
    translation: Vector3<f64>,
    camera: Intrinsics,
}

impl ObserverView {
    /// Creates the view of an observer at this pose.
    pub fn new(observer_from_host: &SE3, camera: &Intrinsics) -> Self {
        Self {
            rotation: observer_from_host.rotation_matrix(),
            translation: observer_from_host.translation,
            camera: *camera,
        }
    }

    /// Projects a point into the observer, if it is seen well enough to be compared.
    pub fn project(&self, point: &WindowPoint) -> Option<Projected> {
        let Intrinsics { fx, fy, cx, cy, .. } = self.camera;
        let (_, scaled) = self.directions(point);
        self.sees(point).then(|| Projected {
            u: fx * scaled.x / scaled.z + cx,
            v: fy * scaled.y / scaled.z + cy,
            inverse_depth: point.inverse_depth / scaled.z,
        })
    }

    /// Whether the observer sees a point well enough to be compared: in the image, from a similar direction and
    /// distance. Without division or root, since it is evaluated for every point with every keyframe.
    #[inline]
    pub fn sees(&self, point: &WindowPoint) -> bool {
        let Intrinsics { fx, fy, cx, cy, width, height } = self.camera;
        let (turned, scaled) = self.directions(point);
        let inside = |at: f64, focal: f64, centre: f64, side: usize| {
            let (at, last) = (focal * at, side as f64 - 1.0 - MARGIN_PX);
            at > (MARGIN_PX - centre) * scaled.z && at < (last - centre) * scaled.z
        };
        let (host, observer) = (turned.norm_squared(), scaled.norm_squared());
        let along = turned.dot(&scaled);
        const MAX_SQUARED_RATIO: f64 = MAX_DISTANCE_RATIO * MAX_DISTANCE_RATIO;
        scaled.z >= MIN_DEPTH_RATIO
            && inside(scaled.x, fx, cx, width)
            && inside(scaled.y, fy, cy, height)
            && along > 0.0
            && along * along >= MIN_COSINE * MIN_COSINE * host * observer
            && observer <= MAX_SQUARED_RATIO * host
            && host <= MAX_SQUARED_RATIO * observer
    }

    /// False where the observer sees none of a sample of the points, spread over the image: most keyframes are turned
    /// elsewhere, and finding that out must not take longer with every keyframe.
    pub fn may_see(&self, points: &[WindowPoint]) -> bool {
        const STEP: usize = 8;
        points.iter().filter(|point| point.is_alive).step_by(STEP).any(|point| self.sees(point))
    }

    /// The line of sight in the observer's axes, from the host at depth 1 and from the observer with the same scale.
    #[inline]
    fn directions(&self, point: &WindowPoint) -> (Vector3<f64>, Vector3<f64>) {
        let ray = Vector3::new(f64::from(point.ray[0]), f64::from(point.ray[1]), 1.0);
        let turned = self.rotation * ray;
        (turned, turned + point.inverse_depth * self.translation)
    }
}
