//! A keyframe as used in fusion, and how another one sees its points.

use nalgebra::{Matrix3, Vector3};

use crate::slam::fusion::params::FusionParams;
use crate::slam::fusion::pixel_index::PixelIndex;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};

/// A keyframe with depth.
#[derive(Debug)]
pub(super) struct View<'a> {
    /// The keyframe.
    pub keyframe: &'a Keyframe,
    /// Its pixels with depth.
    pub index: PixelIndex,
}

/// How another keyframe's depth relates to a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Verdict {
    /// The point is on the other's surface: inverse depth of that surface in the first keyframe, and its variance.
    Agrees(f64, f64),
    /// It sees through the point: the surface is behind it.
    SeesThrough,
    /// The other's surface is in front of the point: hidden, or wrong.
    Hides,
}

/// Maps the pixels of one keyframe to those of another: `q = A r + t d` of a ray r at depth 1 with inverse depth d.
#[derive(Debug)]
pub(super) struct Projection<'a> {
    into: &'a View<'a>,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl<'a> View<'a> {
    /// The view of an established keyframe with depth and a valid pose; `None` for others.
    pub fn of(keyframe: &'a Keyframe) -> Option<Self> {
        let is_usable = keyframe.map_state == MapState::Established
            && keyframe.map_from_keyframe.is_valid()
            && keyframe.intrinsics.is_valid();
        let index = is_usable.then(|| PixelIndex::of(keyframe)).flatten()?;
        (!keyframe.points.is_empty()).then_some(Self { keyframe, index })
    }

    /// The ray of a pixel at depth 1.
    pub fn ray(&self, u: f64, v: f64) -> Vector3<f64> {
        self.keyframe.intrinsics.ray(u, v)
    }

    /// The points of the square that extends `radius` pixels to each side of a point, itself included.
    pub fn around(
        &self,
        point: &DepthPoint,
        radius: usize,
    ) -> impl Iterator<Item = &'a DepthPoint> {
        self.index.around(&self.keyframe.points, [point.u, point.v], radius)
    }

    /// The point of a pixel.
    pub fn point(&self, u: i32, v: i32) -> Option<&DepthPoint> {
        self.index.get(&self.keyframe.points, u, v)
    }
}

/// Pixels around the nearest one in which depth is searched, the nearest first: a point of an edge may just as well be
/// a pixel off in another keyframe.
const AROUND: [(i32, i32); 5] = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)];
/// Least depth in another keyframe over the depth in its own: nearer, a pixel's error is many pixels there.
const NEAREST_RATIO: f64 = 0.1;

impl<'a> Projection<'a> {
    /// The projection of the points of `from` into `into`.
    pub fn new(from: &View<'_>, into: &'a View<'a>) -> Self {
        let into_from_from =
            into.keyframe.map_from_keyframe.inverse() * from.keyframe.map_from_keyframe;
        Self {
            into,
            rotation: into_from_from.rigid.rotation_matrix() * into_from_from.scale,
            translation: into_from_from.rigid.translation,
        }
    }

    /// The other keyframe's opinion of a point with this ray, inverse depth and variance; errors beyond `tolerance`
    /// standard deviations, and beyond a share `floor` of the distance in all, are contradictions. `None` where it has
    /// no depth that is certain enough.
    pub fn verdict(
        &self,
        ray: &Vector3<f64>,
        [d, variance]: [f64; 2],
        params: &FusionParams,
    ) -> Option<Verdict> {
        let &FusionParams { tolerance, floor, max_relative_std_dev, .. } = params;
        let turned = self.rotation * ray;
        let q = turned + self.translation * d;
        // Depth in units of the other: q.z / d.
        if !(q.z > NEAREST_RATIO * turned.norm()) {
            return None;
        }
        let k = &self.into.keyframe.intrinsics;
        let (u, v) = (k.fx * q.x / q.z + k.cx, k.fy * q.y / q.z + k.cy);
        if !(u > -0.5 && v > -0.5 && u < k.width as f64 && v < k.height as f64) {
            return None;
        }
        let (u, v) = (u.round() as i32, v.round() as i32);
        let there = d / q.z;
        let gain = turned.z / (q.z * q.z);
        let there_variance = variance * gain * gain;
        let mut against = None;
        for (du, dv) in AROUND {
            let Some(point) = self.into.point(u + du, v + dv) else { continue };
            let (e, e_variance) = (f64::from(point.inverse_depth), f64::from(point.variance));
            let spread = (floor * there).powi(2) + there_variance + e_variance;
            let difference = there - e;
            let most = max_relative_std_dev * e;
            if !(e > 0.0 && spread.is_finite() && e_variance <= most * most) {
                continue;
            }
            if difference * difference <= tolerance * tolerance * spread {
                return self.agreement_along_ray(turned.z, e, e_variance);
            }
            let verdict = if difference > 0.0 { Verdict::SeesThrough } else { Verdict::Hides };
            against.get_or_insert(verdict);
        }
        against
    }

    /// Converts an inverse depth e of the other keyframe to one along the ray.
    fn agreement_along_ray(&self, turned_z: f64, e: f64, variance: f64) -> Option<Verdict> {
        /// Below, the ray runs across the other's view, and its depth tells little about the point's.
        const MIN_REMAINDER: f64 = 0.1;
        let rest = 1.0 - e * self.translation.z;
        if !(rest > MIN_REMAINDER) {
            return None;
        }
        let gain = turned_z / (rest * rest);
        Some(Verdict::Agrees(e * turned_z / rest, variance * gain * gain))
    }
}
