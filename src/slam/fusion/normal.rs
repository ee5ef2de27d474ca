//! The normal of a surface at a pixel, from the depth around it.

use nalgebra::{Matrix3, Vector3};

use crate::slam::fusion::view::View;
use crate::slam::keyframe::DepthPoint;

/// Pixels considered to each side: depth with holes has some thirty there.
const RADIUS: usize = 6;
/// Fewest pixels with depth on one surface.
const MIN_NEIGHBOURS: usize = 12;
/// Depths more than this many standard deviations apart are not on one surface.
const TOLERANCE: f64 = 3.0;
/// Share of the inverse depth by which exact depths of one surface differ: a surface seen at 75° over [`RADIUS`] pixels
/// at f = 500.
const FLOOR: f64 = 0.05;
/// Depth is smoothed over its neighbours: differences between these vary by this much less than their variances.
const CORRELATED: f64 = 9.0;
/// Largest standard deviation of a normal's direction, radians (17°): a less certain one shades a surface wrongly.
const MAX_STD_DEV: f64 = 0.3;
/// Smallest sine of the angle between ray and surface: a surface at a shallower angle is not seen.
const MIN_SINE: f64 = 0.1;

/// The normal at a point of a keyframe, in the keyframe's axes, towards the camera; `None` where the depth around does
/// not determine it. An inverse depth that is a plane over the image, d = n · ray, is a plane in space with normal n.
pub(super) fn normal(view: &View<'_>, point: &DepthPoint) -> Option<Vector3<f64>> {
    let d = f64::from(point.inverse_depth);
    let bound = |other: &DepthPoint| {
        let spread = f64::from(point.variance) + f64::from(other.variance);
        TOLERANCE * spread.sqrt() + FLOOR * d
    };
    let centre = view.ray(f64::from(point.u), f64::from(point.v));
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    let (mut count, mut sum, mut sum_of_squares) = (0usize, 0.0, 0.0);
    for other in view.around(point, RADIUS) {
        let difference = f64::from(other.inverse_depth) - d;
        if !(difference.abs() <= bound(other) && other.variance > 0.0) {
            continue;
        }
        let ray = view.ray(f64::from(other.u), f64::from(other.v)) - centre;
        let row = Vector3::new(ray.x, ray.y, 1.0);
        normal += row * row.transpose();
        right += row * difference;
        sum += f64::from(other.variance);
        sum_of_squares += difference * difference;
        count += 1;
    }
    if count < MIN_NEIGHBOURS {
        return None;
    }
    let inverse = normal.cholesky()?.inverse();
    let plane = inverse * right;
    // The scatter of the depths about the plane or their own variances, whichever is larger.
    let residual = (sum_of_squares - right.dot(&plane)) / (count - 3) as f64;
    let variance = residual.max(sum / count as f64 / CORRELATED);
    // d = n · ray with ray = centre + offset.
    let offset = d + plane.z;
    let n = Vector3::new(plane.x, plane.y, offset - plane.x * centre.x - plane.y * centre.y);
    let length = n.norm();
    let spread = ((inverse[(0, 0)] + inverse[(1, 1)]) * variance).sqrt();
    let sine = offset / (length * centre.norm());
    let is_known = length > 0.0 && spread <= MAX_STD_DEV * length && sine >= MIN_SINE;
    is_known.then(|| -n / length)
}
