//! The geometry between a keyframe pixel and another frame, as a function of inverse depth.
//!
//! With `pr = K R K⁻¹ (u, v, 1)` and `kt = K t` (R, t: current_from_keyframe) a keyframe pixel of inverse depth d
//! projects to `((pr_x + kt_x d)/(pr_z + kt_z d), (pr_y + kt_y d)/(pr_z + kt_z d))`.

use nalgebra::matrix;

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;

/// Smallest `pr_z + kt_z d` that counts as in front of the camera (ratio of the depths).
pub(super) const MIN_DEPTH_RATIO: f32 = 1e-3;

/// Two-view geometry, prepared once per frame and used for every pixel.
#[derive(Debug, Clone, Copy)]
pub struct TwoView {
    /// `K R K⁻¹`, row-major.
    pub(super) rotation: [[f32; 3]; 3],
    /// `K t`.
    pub(super) translation: [f32; 3],
    /// Focal lengths per pixel.
    pub(super) per_focal_length: f32,
}

/// One keyframe pixel seen through a [`TwoView`]: its epipolar line, parametrised by inverse depth.
#[derive(Debug, Clone, Copy)]
pub struct EpipolarLine {
    /// `pr = K R K⁻¹ (u, v, 1)`.
    pub pr: [f32; 3],
    /// `kt = K t`.
    pub kt: [f32; 3],
}

/// A pixel position with the depth ratio `1/(pr_z + kt_z d)` of its projection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// Column in the frame.
    pub u: f32,
    /// Row in the frame.
    pub v: f32,
    /// `1/(pr_z + kt_z d)`: keyframe depth over frame depth.
    pub depth_ratio: f32,
}

impl TwoView {
    /// The geometry of images with `intrinsics`, `current_from_keyframe` in the unit of 1/d.
    pub fn new(intrinsics: &Intrinsics, current_from_keyframe: &SE3) -> Self {
        let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
        let k = matrix![fx, 0.0, cx; 0.0, fy, cy; 0.0, 0.0, 1.0];
        let k_inverse = matrix![1.0 / fx, 0.0, -cx / fx; 0.0, 1.0 / fy, -cy / fy; 0.0, 0.0, 1.0];
        let rotation = k * current_from_keyframe.rotation_matrix() * k_inverse;
        let translation = k * current_from_keyframe.translation;
        Self {
            rotation: [0, 1, 2].map(|r| [0, 1, 2].map(|c| rotation[(r, c)] as f32)),
            translation: [0, 1, 2].map(|r| translation[r] as f32),
            per_focal_length: (1.0 / fx.max(fy)) as f32,
        }
    }

    /// Displacement of the projection `at` of a pixel of `line` by the translation, focal lengths.
    #[inline]
    pub fn disparity(&self, line: &EpipolarLine, at: &Projection) -> f32 {
        let [far_u, far_v, z] = line.pr;
        let (du, dv) = (at.u - far_u / z, at.v - far_v / z);
        (du * du + dv * dv).sqrt() * self.per_focal_length
    }

    /// The epipolar line of keyframe pixel `(u, v)`.
    #[inline]
    pub fn line(&self, u: f32, v: f32) -> EpipolarLine {
        EpipolarLine {
            pr: self.rotation.map(|row| row[0] * u + row[1] * v + row[2]),
            kt: self.translation,
        }
    }

    /// Jacobian of the projected position with respect to the keyframe position at constant inverse depth, row-major
    /// 2×2: the warp of a small patch.
    #[inline]
    pub fn patch_warp(&self, at: &Projection) -> [f32; 4] {
        let m = &self.rotation;
        let s = at.depth_ratio;
        [
            (m[0][0] - at.u * m[2][0]) * s,
            (m[0][1] - at.u * m[2][1]) * s,
            (m[1][0] - at.v * m[2][0]) * s,
            (m[1][1] - at.v * m[2][1]) * s,
        ]
    }
}

impl EpipolarLine {
    /// Projection at inverse depth `d`; `None` behind the camera.
    #[inline]
    pub fn project(&self, d: f32) -> Option<Projection> {
        let z = self.pr[2] + self.kt[2] * d;
        if !(z > MIN_DEPTH_RATIO) {
            return None;
        }
        let depth_ratio = 1.0 / z;
        Some(Projection {
            u: (self.pr[0] + self.kt[0] * d) * depth_ratio,
            v: (self.pr[1] + self.kt[1] * d) * depth_ratio,
            depth_ratio,
        })
    }

    /// Velocity of the projection, pixels per unit of inverse depth: it points along the line, its length is 1/α
    /// (α = ∂d/∂λ of Engel, Sturm, Cremers 2013 §2.3).
    #[inline]
    pub fn velocity(&self, at: &Projection) -> (f32, f32) {
        let s = at.depth_ratio;
        ((self.kt[0] - self.kt[2] * at.u) * s, (self.kt[1] - self.kt[2] * at.v) * s)
    }

    /// Inverse depth of the point on the line nearest to `(u, v)`, solved on the axis along which the line is longer;
    /// `None` if the line has no direction or the result is not finite.
    #[inline]
    pub fn inverse_depth_at(&self, u: f32, v: f32) -> Option<f32> {
        let along_u = self.kt[0] - self.kt[2] * u;
        let along_v = self.kt[1] - self.kt[2] * v;
        let d = if along_u.abs() >= along_v.abs() {
            (self.pr[2] * u - self.pr[0]) / along_u
        } else {
            (self.pr[2] * v - self.pr[1]) / along_v
        };
        d.is_finite().then_some(d)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;
    use proptest::prelude::*;

    use super::*;

    const CAMERA: Intrinsics =
        Intrinsics { fx: 525.0, fy: 515.0, cx: 319.5, cy: 240.0, width: 640, height: 480 };

    fn project_exactly(transform: &SE3, u: f64, v: f64, d: f64) -> (f64, f64, f64) {
        let x = CAMERA.ray(u, v) / d;
        let y = *transform * x;
        (CAMERA.fx * y.x / y.z + CAMERA.cx, CAMERA.fy * y.y / y.z + CAMERA.cy, y.z)
    }

    proptest! {
        #[test]
        fn projection_is_the_pinhole_of_the_moved_point(
            twist in proptest::array::uniform6(-0.2f64..0.2), u in 5.0f64..634.0, v in 5.0f64..474.0, d in 0.1f64..2.0,
        ) {
            let transform = SE3::exp(&Vector6::from(twist));
            let line = TwoView::new(&CAMERA, &transform).line(u as f32, v as f32);
            let exact = project_exactly(&transform, u, v, d);
            let p = line.project(d as f32).unwrap();
            prop_assert!((f64::from(p.u) - exact.0).abs() < 2e-3 && (f64::from(p.v) - exact.1).abs() < 2e-3);
            prop_assert!((f64::from(p.depth_ratio) - 1.0 / (d * exact.2)).abs() < 1e-4);
        }

        #[test]
        fn velocity_and_patch_warp_are_derivatives(
            twist in proptest::array::uniform6(-0.2f64..0.2), u in 5.0f64..634.0, v in 5.0f64..474.0, d in 0.1f64..2.0,
        ) {
            let transform = SE3::exp(&Vector6::from(twist));
            let view = TwoView::new(&CAMERA, &transform);
            let line = view.line(u as f32, v as f32);
            let at = line.project(d as f32).unwrap();
            let h = 1e-4;
            let difference = |plus: (f64, f64, f64), minus: (f64, f64, f64)| ((plus.0 - minus.0) / (2.0 * h), (plus.1 - minus.1) / (2.0 * h));
            let velocity = difference(project_exactly(&transform, u, v, d + h), project_exactly(&transform, u, v, d - h));
            let (vu, vv) = line.velocity(&at);
            prop_assert!((f64::from(vu) - velocity.0).abs() < 1e-2 * (1.0 + velocity.0.abs()));
            prop_assert!((f64::from(vv) - velocity.1).abs() < 1e-2 * (1.0 + velocity.1.abs()));
            let warp = view.patch_warp(&at);
            let by_u = difference(project_exactly(&transform, u + h, v, d), project_exactly(&transform, u - h, v, d));
            let by_v = difference(project_exactly(&transform, u, v + h, d), project_exactly(&transform, u, v - h, d));
            for (fast, exact) in warp.iter().zip([by_u.0, by_v.0, by_u.1, by_v.1]) {
                prop_assert!((f64::from(*fast) - exact).abs() < 1e-3);
            }
        }

        #[test]
        fn inverse_depth_is_read_back_from_the_line(
            twist in proptest::array::uniform6(-0.2f64..0.2), u in 5.0f64..634.0, v in 5.0f64..474.0, d in 0.1f64..2.0,
        ) {
            let transform = SE3::exp(&Vector6::from(twist));
            let line = TwoView::new(&CAMERA, &transform).line(u as f32, v as f32);
            let p = line.project(d as f32).unwrap();
            let (vu, vv) = line.velocity(&p);
            prop_assume!(vu.hypot(vv) > 5.0);
            let back = line.inverse_depth_at(p.u, p.v).unwrap();
            prop_assert!((f64::from(back) - d).abs() < 1e-2 / f64::from(vu.hypot(vv)) + 1e-3 * d);
        }
    }

    #[test]
    fn a_pure_rotation_has_no_line() {
        let turn = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.02, -0.01, 0.03));
        let line = TwoView::new(&CAMERA, &turn).line(100.0, 200.0);
        assert!(line.inverse_depth_at(105.0, 203.0).is_none());
    }
}
