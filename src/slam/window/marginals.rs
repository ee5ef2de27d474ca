//! Marginal covariances of the joint estimate: of a keyframe's modes and of its place.
//!
//! With H the final normal equations and σ² the variance of a residual, the covariance of a linear function g of the
//! free parameters is σ² gᵀ H⁻¹ g. A point's depth is coupled only to the poses that see it, so that with D the depths'
//! part of H, S its Schur complement, and g = (β, α):
//! ```text
//! gᵀ H⁻¹ g = αᵀ D⁻¹ α + (β − H_cd D⁻¹ α)ᵀ S⁻¹ (β − H_cd D⁻¹ α)
//! ```
//! The modes are the least-squares fit m = A δd'/d' over the points that the keyframe's depth is moved to: its own, or
//! those of others as it sees them, whose inverse depth d' = d/z, with X' = R x + t d = (·, ·, z) and n = X'/z, depends
//! on depth and poses by
//! ```text
//! δd'/d' = δd (1/d − t_z/z) − d' ξ_tz − n_y ξ_ωx + n_x ξ_ωy
//! ```

use nalgebra::{
    Cholesky, Const, DVector, Matrix3, Matrix4, SMatrix, SVector, Vector1, Vector3, Vector4,
    Vector6,
};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe_pose_covariance::KeyframePoseMatrix;
use crate::slam::modes::NUM_MODES;
use crate::slam::window::Window;
use crate::slam::window::comparison::{POSE, Pair};
use crate::slam::window::functional::{Functional, Seen};
use crate::slam::window::holders::{Comparisons, Holder, holders};
use crate::slam::window::keyframe::{WindowKeyframe, WindowPoint};
use crate::slam::window::place_marginals::{
    Gauge, KeyframePoseMarginal, covariance_of_displacement, unit_fit,
};
use crate::slam::window::solver::Solver;
use crate::slam::window::system::{Members, System};
use crate::slam::window::view::{MIN_DEPTH_RATIO, ObserverView, Views};

/// Uncertainty of a jointly estimated keyframe, from the noise of the residuals alone: these are taken as independent,
/// and the keyframes that hold the others in place as exact, which makes it overconfident.
#[derive(Debug, Clone, PartialEq)]
pub struct Marginal {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Covariance of the modes of its depth, as defined in `slam::modes`.
    pub modes: Matrix3<f64>,
    /// The same if images are displaced against each other by a pixel, uniformly: for lens and shutter, which no number
    /// of points averages out.
    pub of_displaced: Matrix3<f64>,
    /// Its place; `None` where one keyframe alone holds the others and has no depth to hold their unit.
    pub place: Option<KeyframePoseMarginal>,
    /// The older keyframes that held it in place.
    pub held_by: Vec<Holder>,
}

/// Points that a fit of the modes needs: ten per parameter, as the plane.
const MIN_POINTS: usize = 40;

/// Standard deviation of a point's inverse depth, over that depth, above which it is not used for the modes: a few
/// points without baseline would otherwise dominate their uncertainty.
const MAX_RELATIVE_STD_DEV: f64 = 0.3;

impl Window {
    /// The marginal of a keyframe by the last adjustment.
    pub fn marginal_of(&self, keyframe_id: u64) -> Option<&Marginal> {
        self.marginals.iter().find(|of| of.keyframe_id == keyframe_id)
    }
}

/// Marginals of every member that was free in the adjustment whose equations the solver holds.
pub(super) fn marginals(
    keyframes: &[WindowKeyframe],
    members: &Members<'_>,
    solver: &mut Solver,
    camera: &Intrinsics,
    most_energy: f32,
) -> Vec<Marginal> {
    let mut held_by = holders_of(keyframes, members, solver, most_energy);
    let (views, system) = (&solver.views, &mut solver.system);
    // The unit that nothing holds is not one of the modes: any stiffness serves. From places it is removed.
    let unit = unit_direction(keyframes, members, system.num_free);
    let factors = system.factors(members, views, unit.as_ref());
    let Some(factors) = factors else { return Vec::new() };
    let (num_free, variance) = (system.num_free, system.mean_squared_residual());
    let whiten = |of: &Functional| system.whitened(&factors, members, views, of);
    let gauge = Gauge::new(unit, keyframes, members, views, system, whiten);
    let free = members.free.iter().enumerate().filter_map(|(k, number)| Some((k, (*number)?)));
    let marginals = free.filter_map(|(member, number)| {
        let seen = seen_by(keyframes, members, views, system, camera, member);
        let fit = fit_of(&seen)?;
        let modes_of = |of: &Seen| fit.solve(&of.phi).fixed_rows::<NUM_MODES>(1).into_owned();
        let of = functionals(&seen, modes_of, members, num_free, number)?.each_ref().map(whiten);
        let modes = Matrix3::from_fn(|i, j| variance * of[i].dot(&of[j]));
        let parallax = mean_squared_parallax(&seen, keyframes, members, views, camera);
        let of_one = fit.inverse().fixed_view::<NUM_MODES, NUM_MODES>(1, 1) * seen.len() as f64;
        let keyframe = &keyframes[members.members[member]];
        let place = unit_fit(&seen).zip(gauge.as_ref()).and_then(|(fit, gauge)| {
            let unit_of = |of: &Seen| Vector1::new(-fit.solve(&of.phi.xyz()).x);
            let [unit] = functionals(&seen, unit_of, members, num_free, number)?;
            let map_from_camera = keyframe.camera_from_map.inverse();
            let errors = gauge.errors(&map_from_camera, number, &unit, whiten);
            let noise = KeyframePoseMatrix::from_fn(|i, j| variance * errors[i].dot(&errors[j]));
            let of_displaced =
                covariance_of_displacement(&seen, &map_from_camera, camera, &fit, parallax);
            Some(KeyframePoseMarginal { noise, of_displaced })
        });
        let place = place.filter(KeyframePoseMarginal::is_finite);
        let keyframe_id = keyframe.keyframe_id;
        let (of_displaced, held_by) = (of_one / parallax, std::mem::take(&mut held_by[member]));
        Some(Marginal { keyframe_id, modes, of_displaced, place, held_by })
    });
    let is_finite =
        |of: &Marginal| of.modes.iter().chain(of.of_displaced.iter()).all(|x| x.is_finite());
    marginals.filter(is_finite).collect()
}

/// For each member, the older fixed keyframes that hold it.
fn holders_of(
    keyframes: &[WindowKeyframe],
    members: &Members<'_>,
    solver: &Solver,
    most_energy: f32,
) -> Vec<Vec<Holder>> {
    let ids: Vec<u64> = members.members.iter().map(|&at| keyframes[at].keyframe_id).collect();
    let is_free: Vec<bool> = members.free.iter().map(Option::is_some).collect();
    let comparisons = solver.views.pairs.iter().map(|pair| Comparisons {
        members: [pair.host, pair.observer],
        inliers: solver.system.inliers_among(pair.places(), most_energy),
    });
    holders(&ids, &is_free, &comparisons.collect::<Vec<_>>())
}

/// Motion of the free poses as the unit grows of a window that only one keyframe holds in place; `None` where more do.
fn unit_direction(
    keyframes: &[WindowKeyframe],
    members: &Members<'_>,
    num_free: usize,
) -> Option<DVector<f64>> {
    let pairs = || members.members.iter().map(|&index| &keyframes[index]).zip(members.free);
    let mut held = pairs().filter(|(_, free)| free.is_none());
    let (Some((anchor, _)), None) = (held.next(), held.next()) else { return None };
    let map_from_anchor = anchor.camera_from_map.inverse();
    let mut along = DVector::zeros(POSE * num_free);
    for (keyframe, number) in pairs() {
        let Some(number) = *number else { continue };
        let translation = (keyframe.camera_from_map * map_from_anchor).translation;
        along.fixed_rows_mut::<3>(POSE * number).copy_from(&translation);
    }
    // Where all poses are at one position there is no unit.
    (along.norm() > 0.0).then_some(along)
}

/// The points that a member's depth is moved to and that some keyframe agrees with.
fn seen_by(
    keyframes: &[WindowKeyframe],
    members: &Members<'_>,
    views: &Views,
    system: &System,
    camera: &Intrinsics,
    member: usize,
) -> Vec<Seen> {
    let to = &keyframes[members.members[member]];
    let mut seen = Vec::new();
    let mut sight: Option<(usize, SE3, ObserverView)> = None;
    for (slot, (view, inliers)) in views.points.iter().zip(system.inliers_by_point()).enumerate() {
        if inliers == 0 || to.is_host != (view.host == member) {
            continue;
        }
        let host = &keyframes[members.members[view.host]];
        let point = &host.points[view.point];
        if !(system.depth_deviation(slot) <= MAX_RELATIVE_STD_DEV * point.inverse_depth) {
            continue;
        }
        if view.host == member {
            seen.push(own(slot, point));
            continue;
        }
        let (_, to_from_host, sight) = match &sight {
            Some(known) if known.0 == view.host => known,
            _ => {
                let to_from_host = to.camera_from_map * host.camera_from_map.inverse();
                sight.insert((view.host, to_from_host, ObserverView::new(&to_from_host, camera)))
            }
        };
        if sight.sees(point) {
            seen.push(projected(slot, point, view.host, to_from_host));
        }
    }
    seen
}

fn own(slot: usize, point: &WindowPoint) -> Seen {
    let [x, y] = point.ray.map(f64::from);
    Seen {
        slot,
        from_host: None,
        phi: Vector4::new(1.0, x, y, point.inverse_depth.ln()),
        by_depth: 1.0 / point.inverse_depth,
        by_pose: Vector6::zeros(),
    }
}

fn projected(slot: usize, point: &WindowPoint, host: usize, to_from_host: &SE3) -> Seen {
    let [x, y] = point.ray.map(f64::from);
    let d = point.inverse_depth;
    let turned = to_from_host.rotation * Vector3::new(x, y, 1.0);
    let warped = turned + to_from_host.translation * d;
    let (x, y, inverse_depth) = (warped.x / warped.z, warped.y / warped.z, d / warped.z);
    Seen {
        slot,
        from_host: Some((host, *to_from_host)),
        phi: Vector4::new(1.0, x, y, inverse_depth.ln()),
        by_depth: 1.0 / d - to_from_host.translation.z / warped.z,
        by_pose: Vector6::new(0.0, 0.0, -inverse_depth, -y, x, 0.0),
    }
}

/// Mean square of the motion, in pixels, of a point in an image when its inverse depth is multiplied by e, over
/// comparisons of the points that are seen.
fn mean_squared_parallax(
    seen: &[Seen],
    keyframes: &[WindowKeyframe],
    members: &Members<'_>,
    views: &Views,
    camera: &Intrinsics,
) -> f64 {
    /// Every eighth point represents them all.
    const STRIDE: usize = 8;
    let (mut sum, mut count) = (0.0, 0.0f64);
    for view in seen.iter().step_by(STRIDE).map(|of| &views.points[of.slot]) {
        let host = &keyframes[members.members[view.host]];
        let point = &host.points[view.point];
        let map_from_host = host.camera_from_map.inverse();
        let ray = Vector3::new(f64::from(point.ray[0]), f64::from(point.ray[1]), 1.0);
        for link in views.links(view) {
            let observer = &keyframes[members.members[link.observer]];
            let observer_from_host = observer.camera_from_map * map_from_host;
            let moved = observer_from_host.translation * point.inverse_depth;
            let warped = observer_from_host.rotation * ray + moved;
            // Seen when the comparisons were chosen; the estimate may have moved it since.
            if !(warped.z >= MIN_DEPTH_RATIO) {
                continue;
            }
            let along = |axis: usize, focal: f64| {
                focal * (moved[axis] - warped[axis] / warped.z * moved.z) / warped.z
            };
            sum += along(0, camera.fx).powi(2) + along(1, camera.fy).powi(2);
            count += 1.0;
        }
    }
    sum / count
}

/// The equations of the modes, with the constant, over points; `None` where these do not determine them.
fn fit_of(seen: &[Seen]) -> Option<Cholesky<f64, Const<4>>> {
    if seen.len() < MIN_POINTS {
        return None;
    }
    seen.iter().map(|of| of.phi * of.phi.transpose()).sum::<Matrix4<f64>>().cholesky()
}

/// Weighted sums of ln d' over the points of a member, whose pose has this number, as functions of the free parameters.
fn functionals<const N: usize>(
    seen: &[Seen],
    weights_of: impl Fn(&Seen) -> SVector<f64, N>,
    members: &Members<'_>,
    num_free: usize,
    number: usize,
) -> Option<[Functional; N]> {
    let mut functionals = std::array::from_fn(|_| Functional::zero(num_free));
    // Sums over the points of one host: they share its pose.
    let mut of_host: Option<(usize, SE3, SMatrix<f64, N, POSE>)> = None;
    let settle = |(host, to_from_host, sum): (usize, SE3, SMatrix<f64, N, POSE>),
                  functionals: &mut [Functional; N]| {
        let by_host = sum * Pair::by_host(&to_from_host);
        for (row, functional) in functionals.iter_mut().enumerate() {
            functional.add_pose(number, &sum.row(row).transpose());
            if let Some(host) = members.free[host] {
                functional.add_pose(host, &by_host.row(row).transpose());
            }
        }
    };
    for of in seen {
        let weights = weights_of(of);
        for (weight, functional) in weights.iter().zip(&mut functionals) {
            functional.depths.push((of.slot, weight * of.by_depth));
        }
        let Some((host, to_from_host)) = of.from_host else { continue };
        if of_host.as_ref().is_some_and(|(known, ..)| *known != host) {
            settle(of_host.take()?, &mut functionals);
        }
        let (_, _, sum) = of_host.get_or_insert_with(|| (host, to_from_host, SMatrix::zeros()));
        *sum += weights * of.by_pose.transpose();
    }
    if let Some(rest) = of_host.take() {
        settle(rest, &mut functionals);
    }
    Some(functionals)
}
