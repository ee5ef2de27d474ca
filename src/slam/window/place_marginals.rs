//! Uncertainty of jointly estimated places, relative to the keyframes that held the window.
//!
//! With C = `camera_from_map`, whose left increments are estimated, the error of a place is ξ = −Ad(C⁻¹) ξ_C; that of
//! its unit is minus the constant of the plane fitted to the ln d' of the points. Both are linear in the free
//! parameters, as the modes are (`marginals`), but they do depend on the unit. Where one keyframe alone holds the
//! window, the unit is that of its depths, whatever stiffness the equations were given: with n the direction of growth
//! and c(x) the mean change of its ln d, where c(n) = −1, a linear function g becomes
//! ```text
//! g(x) + c(x) g(n)
//! ```

use nalgebra::{Cholesky, Const, DVector, Matrix3};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe_pose_covariance::{KEYFRAME_POSE_ERRORS, KeyframePoseMatrix, transport};
use crate::slam::tracker::covariance_floor::displacement_covariance;
use crate::slam::window::comparison::POSE;
use crate::slam::window::functional::{Functional, Seen};
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::system::{Members, System};
use crate::slam::window::view::Views;

/// Uncertainty of a keyframe's place (see `slam::keyframe_pose_covariance`), relative to those that held the window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePoseMarginal {
    /// From the noise of the residuals alone, taken as independent.
    pub noise: KeyframePoseMatrix,
    /// From a displacement of its image by a pixel along both axes, uniformly.
    pub of_displaced: KeyframePoseMatrix,
}

impl KeyframePoseMarginal {
    /// Transports it into the map that `by` moves this one to.
    pub(super) fn transport(&mut self, by: &Sim3) {
        let by = transport(by);
        for matrix in [&mut self.noise, &mut self.of_displaced] {
            *matrix = by * *matrix * by.transpose();
        }
    }

    /// Whether every number is finite.
    pub(super) fn is_finite(&self) -> bool {
        self.noise.iter().chain(self.of_displaced.iter()).all(|x| x.is_finite())
    }
}

/// What holds the unit of a window.
pub(super) struct Gauge {
    num_points: usize,
    /// The whitened change of ln d of the one keyframe that holds the window, and the motion of the free poses as the
    /// unit grows; `None` where more hold it.
    of_one: Option<(DVector<f64>, DVector<f64>)>,
}

impl Gauge {
    /// The gauge of a window that grows along `unit` if one keyframe holds it; `None` where that has no depth.
    pub(super) fn new(
        unit: Option<DVector<f64>>,
        keyframes: &[WindowKeyframe],
        members: &Members<'_>,
        views: &Views,
        system: &System,
        whiten: impl Fn(&Functional) -> DVector<f64>,
    ) -> Option<Self> {
        let num_points = views.points.len();
        let Some(along) = unit else { return Some(Self { num_points, of_one: None }) };
        let mut of = Functional::zero(system.num_free);
        // The median, by which `Window` keeps the unit, responds to points in proportion to their certainty.
        let mut sum = 0.0;
        for (slot, view) in views.points.iter().enumerate() {
            let inverse_depth =
                keyframes[members.members[view.host]].points[view.point].inverse_depth;
            let weight = inverse_depth / system.depth_deviation(slot);
            if members.free[view.host].is_none() && weight.is_finite() && weight > 0.0 {
                sum += weight;
                of.depths.push((slot, weight / inverse_depth));
            }
        }
        of.depths.iter_mut().for_each(|(_, by_depth)| *by_depth /= sum);
        let whitened = spread_out(&whiten(&of), &of, num_points);
        (sum > 0.0).then_some(Self { num_points, of_one: Some((whitened, along)) })
    }

    /// The whitened errors of a place: the products of two are their covariance. `number` is that of its pose, `unit`
    /// the error of its unit if that of the window were exact.
    pub(super) fn errors(
        &self,
        map_from_camera: &SE3,
        number: usize,
        unit: &Functional,
        whiten: impl Fn(&Functional) -> DVector<f64>,
    ) -> [DVector<f64>; KEYFRAME_POSE_ERRORS] {
        let by_increment = -map_from_camera.adjoint();
        std::array::from_fn(|row| {
            let mut of_pose = Functional::zero(unit.poses.len() / POSE);
            let of = if row < POSE {
                of_pose.add_pose(number, &by_increment.row(row).transpose());
                &of_pose
            } else {
                unit
            };
            let mut whitened = spread_out(&whiten(of), of, self.num_points);
            if let Some((of_one, along)) = &self.of_one {
                // A unit grows with everything else.
                let growth = if row < POSE { of.poses.dot(along) } else { 1.0 };
                whitened.axpy(growth, of_one, 1.0);
            }
            whitened
        })
    }
}

/// A whitened function with an entry for every point.
fn spread_out(whitened: &DVector<f64>, of: &Functional, num_points: usize) -> DVector<f64> {
    let poses = of.poses.len();
    let mut all = DVector::zeros(poses + num_points);
    all.rows_mut(0, poses).copy_from(&whitened.rows(0, poses));
    for (&(slot, _), value) in of.depths.iter().zip(whitened.iter().skip(poses)) {
        all[poses + slot] += value;
    }
    all
}

/// The equations of a plane over points; `None` where these do not determine it.
pub(super) fn unit_fit(seen: &[Seen]) -> Option<Cholesky<f64, Const<3>>> {
    let shapes = seen.iter().map(|of| of.phi.xyz());
    shapes.map(|phi| phi * phi.transpose()).sum::<Matrix3<f64>>().cholesky()
}

/// Covariance of a place whose points are `seen` by a displacement of the whole image by a pixel: of its pose as of a
/// tracked frame's, of its unit by the parallax of its points.
pub(super) fn covariance_of_displacement(
    seen: &[Seen],
    map_from_camera: &SE3,
    camera: &Intrinsics,
    fit: &Cholesky<f64, Const<3>>,
    parallax: f64,
) -> KeyframePoseMatrix {
    let num_points = seen.len() as f64;
    let mean_inverse_depth = seen.iter().map(|of| of.phi.w.exp()).sum::<f64>() / num_points;
    let by_camera = map_from_camera.adjoint();
    let of_pose = displacement_covariance(1.0, camera, mean_inverse_depth);
    let mut of_place = KeyframePoseMatrix::zeros();
    let mut pose = of_place.fixed_view_mut::<POSE, POSE>(0, 0);
    pose += by_camera * of_pose * by_camera.transpose();
    of_place[(POSE, POSE)] = fit.inverse()[(0, 0)] * num_points / parallax;
    of_place
}
