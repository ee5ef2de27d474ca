//! Pairs of keyframes that share a view, and the projection of points from one into the other.

use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};

/// Smallest share of each keyframe's points that falls into the other's image: below, they have only a margin in
/// common.
const MIN_SHARED: f64 = 0.3;
/// Most keyframes that are compared with earlier ones, spread evenly over the map: 240 pairs, a second.
const MAX_JUDGED: usize = 60;
/// Most earlier keyframes that are considered for each, spread evenly.
const MAX_EARLIER: usize = 64;
/// Points that estimate the overlap of two keyframes: to a few percent.
const OVERLAP_POINTS: usize = 200;
/// A point nearer than this share of its original depth is not compared: it is magnified beyond recognition.
const NEAREST_DEPTH_RATIO: f64 = 0.1;

/// The similarity between two keyframes, for projecting points of one into the other.
#[derive(Debug, Clone, Copy)]
pub struct SharedView<'a> {
    /// Keyframe whose points are projected.
    pub from: &'a Keyframe,
    /// Keyframe into which they are projected.
    pub into: &'a Keyframe,
    into_from_from: Sim3,
}

/// A projected point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// Column, pixels.
    pub u: f64,
    /// Row, pixels.
    pub v: f64,
    /// Inverse depth in the other keyframe, 1/units of that keyframe.
    pub inverse_depth: f64,
}

impl<'a> SharedView<'a> {
    /// From the final poses and scales of both.
    pub fn new(from: &'a Keyframe, into: &'a Keyframe) -> Self {
        let into_from_from = into.map_from_keyframe.inverse() * from.map_from_keyframe;
        Self { from, into, into_from_from }
    }

    /// Projects pixel (u, v) with this inverse depth; `None` outside the image.
    pub fn project(&self, u: f64, v: f64, inverse_depth: f64) -> Option<Projection> {
        let (a, b) = (&self.from.intrinsics, &self.into.intrinsics);
        let depth = 1.0 / inverse_depth;
        let ray = a.ray(u, v);
        let point = self.into_from_from * (ray * depth);
        let is_near = point.z < NEAREST_DEPTH_RATIO * depth * self.into_from_from.scale;
        if is_near || !(point.z > 0.0 && point.z.is_finite()) {
            return None;
        }
        let (u, v) = (b.fx * point.x / point.z + b.cx, b.fy * point.y / point.z + b.cy);
        let inside = |x: f64, side: usize| x >= 0.0 && x <= side as f64 - 1.0;
        (inside(u, b.width) && inside(v, b.height)).then_some(Projection {
            u,
            v,
            inverse_depth: 1.0 / point.z,
        })
    }

    /// About `count` points, spread over the keyframe, with their projections.
    pub fn projections(
        &self,
        count: usize,
    ) -> impl Iterator<Item = (&'a DepthPoint, Option<Projection>)> + '_ {
        let step = (self.from.points.len() / count.max(1)).max(1);
        let usable = |p: &&DepthPoint| p.inverse_depth > 0.0 && p.inverse_depth.is_finite();
        self.from.points.iter().step_by(step).filter(usable).map(|point| {
            let d = f64::from(point.inverse_depth);
            (point, self.project(f64::from(point.u), f64::from(point.v), d))
        })
    }

    /// Share of the points that fall into the other image.
    pub fn shared(&self) -> f64 {
        let (mut inside, mut all) = (0u32, 0u32);
        for (_, projection) in self.projections(OVERLAP_POINTS) {
            all += 1;
            inside += u32::from(projection.is_some());
        }
        f64::from(inside) / f64::from(all.max(1))
    }
}

/// Two keyframes of one epoch that share a view, the earlier first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// Index of the earlier in the map.
    pub earlier: usize,
    /// Index of the later in the map.
    pub later: usize,
    /// Whether others of the epoch were created between them.
    pub is_wide: bool,
}

/// Pairs of keyframes that share a view: each later one with the oldest, the newest and two in between of the earlier
/// ones that see the same place. At most four for each of sixty keyframes.
pub fn pairs(keyframes: &[Keyframe]) -> Vec<Pair> {
    let judged = |k: &Keyframe| {
        let has_image = k.image.len() == k.intrinsics.width * k.intrinsics.height;
        k.map_state == MapState::Established && has_image && !k.points.is_empty()
    };
    let usable: Vec<usize> = (0..keyframes.len()).filter(|&i| judged(&keyframes[i])).collect();
    let mut pairs = Vec::new();
    for at in spread(usable.len(), MAX_JUDGED) {
        let later = usable[at];
        let same_epoch = |&i: &usize| keyframes[i].epoch == keyframes[later].epoch;
        let before: Vec<usize> = usable[..at].iter().copied().filter(same_epoch).collect();
        let shares = |&i: &usize| {
            let (a, b) = (&keyframes[i], &keyframes[later]);
            SharedView::new(b, a).shared() >= MIN_SHARED
                && SharedView::new(a, b).shared() >= MIN_SHARED
        };
        let looked_at = spread(before.len(), MAX_EARLIER).map(|i| before[i]);
        let sharing: Vec<usize> = looked_at.filter(shares).collect();
        for earlier in spread(sharing.len(), 4).map(|i| sharing[i]) {
            pairs.push(Pair { earlier, later, is_wide: before.last() != Some(&earlier) });
        }
    }
    pairs
}

/// At most `most` of the numbers below `count`, evenly spread, including the first and the last.
fn spread(count: usize, most: usize) -> impl Iterator<Item = usize> {
    let taken = count.min(most);
    (0..taken).map(move |i| if taken < 2 { count - 1 } else { i * (count - 1) / (taken - 1) })
}
