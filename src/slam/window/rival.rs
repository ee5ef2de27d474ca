//! Checks whether the other motion that a start could have taken explains its first keyframes better.
//!
//! Two views of a plane are explained by two motions, with the translation and the normal of the plane exchanged
//! (Longuet-Higgins 1986), and two near views of a shallow scene nearly so. A start with the wrong one looks
//! consistent, and the joint estimate bends it until it fits; but the keyframes that follow fit the right one better.
//! The first keyframes are therefore estimated once more from the other motion, and the costs are compared.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::slam::geometry::se3::SE3;
use crate::slam::window::members::Chosen;
use crate::slam::window::plane::median;
use crate::slam::window::system::Members;
use crate::slam::window::{ADJUSTED_LEVELS, ALIGNMENT_LEVELS, MAX_ALIGNMENT_ITERATIONS, Window};

/// Fewest keyframes to compare: two are explained by both motions, three nearly.
const MIN_KEYFRAMES: usize = 4;
/// Cost of the rival over that of the start below which the start is wrong. Wrong starts on the floor have 0.49 to
/// 0.87, right ones of all recordings and rooms 1.21 and more.
const REFUTED: f64 = 0.95;
/// The same above which the start is right, and is not checked again: wrong ones have at most 0.92, right ones 1.48 and
/// more except for a few, which are checked to the end.
const CONFIRMED: f64 = 1.4;
/// Least share of the comparisons that the rival must make too: a rival that sees little costs little.
const MIN_COMPARED: f64 = 0.8;
/// Least inverse depth of a point on the rival's plane, as a share of that on the optical axis: a plane may rise above
/// the horizon.
const FARTHEST: f64 = 0.1;

/// A plane n, n · X = 1 in the first camera, and the motion to a second view, with the homography H = R + t nᵀ.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PlaneMotion {
    camera_from_first: SE3,
    normal: Vector3<f64>,
}

impl Window {
    /// Whether the rival of an epoch's start explains its first keyframes, which were just estimated, clearly better.
    pub(super) fn is_refuted(&mut self, chosen: &Chosen) -> bool {
        let epoch = self.keyframes[chosen.members[0]].epoch;
        let is_early = chosen.members.len() < MIN_KEYFRAMES;
        if !chosen.is_first || is_early || self.confirmed_epoch == Some(epoch) {
            return false;
        }
        let cost = self.mean_cost();
        let compared = self.solver.system.compared;
        let keep = |&member: &usize| {
            let keyframe = &self.keyframes[member];
            (keyframe.camera_from_map, keyframe.points.clone())
        };
        let kept: Vec<_> = chosen.members.iter().map(keep).collect();
        let is_comparable = self.estimate_rival(chosen)
            && self.solver.system.compared as f64 >= MIN_COMPARED * compared as f64;
        let of_rival = self.mean_cost();
        for (&member, kept) in chosen.members.iter().zip(kept) {
            let keyframe = &mut self.keyframes[member];
            (keyframe.camera_from_map, keyframe.points) = kept;
        }
        if is_comparable && of_rival > CONFIRMED * cost {
            self.confirmed_epoch = Some(epoch);
        }
        is_comparable && of_rival < REFUTED * cost
    }

    /// Mean cost of a comparison at the solver's state, including those that see something else.
    fn mean_cost(&self) -> f64 {
        let system = &self.solver.system;
        let others = (system.compared - system.inliers) as f64;
        let most = f64::from(self.robustness().most_energy);
        (system.inlier_cost + others * most) / system.compared.max(1) as f64
    }

    /// Moves the first keyframes to their poses by the rival's motion and estimates them; false without a rival.
    fn estimate_rival(&mut self, chosen: &Chosen) -> bool {
        let first = chosen.members[0];
        let map_from_first = self.keyframes[first].camera_from_map.inverse();
        let Some(plane) = self.plane_of(first) else { return false };
        let motions = chosen.members.iter().skip(1).map(|&member| {
            let camera_from_first = self.keyframes[member].camera_from_map * map_from_first;
            PlaneMotion { camera_from_first, normal: plane }.rival()
        });
        let motions: Option<Vec<PlaneMotion>> = motions.collect();
        let Some(motions) = motions else { return false };
        // The one with the largest baseline determines the plane best.
        let baseline = |of: &&PlaneMotion| of.camera_from_first.translation.norm();
        let Some(widest) = motions.iter().max_by(|a, b| baseline(a).total_cmp(&baseline(b))) else {
            return false;
        };
        let normal = widest.normal;
        self.move_onto_plane(first, &normal);
        for (place, motion) in motions.iter().enumerate() {
            let member = chosen.members[place + 1];
            // Its plane is not that of the widest: convert to the unit of that one.
            let mut camera_from_first = motion.camera_from_first;
            camera_from_first.translation *= motion.normal.norm() / normal.norm();
            self.keyframes[member].camera_from_map = camera_from_first * map_from_first.inverse();
            if !self.align_last(
                &chosen.members[..=place + 1],
                &ALIGNMENT_LEVELS,
                MAX_ALIGNMENT_ITERATIONS,
            ) {
                return false;
            }
            let camera_from_first = self.keyframes[member].camera_from_map * map_from_first;
            let turned = camera_from_first.rotation * normal;
            self.move_onto_plane(
                member,
                &(turned / (1.0 + turned.dot(&camera_from_first.translation))),
            );
        }
        let members =
            Members { members: &chosen.members, free: &chosen.free, depths_are_free: true };
        self.run(&members, &ADJUSTED_LEVELS, self.params.max_first_iterations, |_, _| true)
    }

    /// The plane that is nearest to most points of a keyframe.
    fn plane_of(&self, member: usize) -> Option<Vector3<f64>> {
        /// Iterations: the weights have settled.
        const ITERATIONS: usize = 10;
        /// Distance from the plane at which a point counts half, as a share of the median inverse depth.
        const HALF_WEIGHT: f64 = 0.1;
        let points = self.keyframes[member].points.iter().filter(|point| point.is_alive);
        let points: Vec<(Vector3<f64>, f64)> = points
            .map(|point| {
                let ray = Vector3::new(f64::from(point.ray[0]), f64::from(point.ray[1]), 1.0);
                (ray, point.inverse_depth)
            })
            .collect();
        let scale = HALF_WEIGHT * median(points.iter().map(|(_, depth)| *depth).collect());
        let mut plane: Option<Vector3<f64>> = None;
        for _ in 0..ITERATIONS {
            let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
            for (ray, inverse_depth) in &points {
                let off = plane.map_or(0.0, |plane| plane.dot(ray) - inverse_depth);
                let weight = 1.0 / (1.0 + (off / scale).powi(2));
                normal += weight * ray * ray.transpose();
                right += weight * *inverse_depth * ray;
            }
            plane = Some(normal.cholesky()?.solve(&right));
        }
        plane
    }

    /// Moves a keyframe's points onto a plane in its camera.
    fn move_onto_plane(&mut self, member: usize, normal: &Vector3<f64>) {
        let least = FARTHEST * normal.z.abs();
        for point in &mut self.keyframes[member].points {
            let ray = Vector3::new(f64::from(point.ray[0]), f64::from(point.ray[1]), 1.0);
            point.inverse_depth = normal.dot(&ray).max(least);
            point.is_alive = true;
        }
    }
}

impl PlaneMotion {
    /// The other motion and plane with the same homography, the plane in front of the camera; `None` where the two do
    /// not differ or a number is invalid (Ma, Soatto, Košecká, Sastry 2004 §5.3).
    fn rival(&self) -> Option<Self> {
        let Self { camera_from_first, normal } = self;
        let rotation = camera_from_first.rotation.to_rotation_matrix().into_inner();
        let homography = rotation + camera_from_first.translation * normal.transpose();
        let svd = homography.svd(false, true);
        let rows = svd.v_t?;
        // The largest first.
        let [s1, s2, s3] = svd.singular_values.into();
        let [v1, v2, v3] = [0, 1, 2].map(|i| rows.row(i).transpose());
        let homography = homography / s2;
        let (a, c) = ((s1 / s2).powi(2) - 1.0, 1.0 - (s3 / s2).powi(2));
        /// Below this the two views differ only by a rotation.
        const MIN_DIFFERENCE: f64 = 1e-9;
        if !(a + c > MIN_DIFFERENCE) || !homography.iter().all(|x| x.is_finite()) {
            return None;
        }
        let (a, c) = (a.max(0.0), c.max(0.0));
        let solution = |sign: f64| {
            let along = (v1 * c.sqrt() + v3 * (sign * a.sqrt())) / (a + c).sqrt();
            let across = v2.cross(&along);
            let from = Matrix3::from_columns(&[v2, along, across]);
            let (to2, to_along) = (homography * v2, homography * along);
            let to = Matrix3::from_columns(&[to2, to_along, to2.cross(&to_along)]);
            let rotation = to * from.transpose();
            let translation = (homography - rotation) * across;
            (rotation, translation, across)
        };
        let differs = |of: &(Matrix3<f64>, Vector3<f64>, Vector3<f64>)| (of.0 - rotation).norm();
        let [one, other] = [1.0, -1.0].map(solution);
        let (rotation, translation, direction) =
            if differs(&one) > differs(&other) { one } else { other };
        // As far away along the optical axis as the plane was.
        let factor = normal.z / direction.z;
        let (normal, translation) = (direction * factor, translation / factor);
        let rotation = Rotation3::from_matrix_unchecked(rotation);
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        let is_finite = normal.iter().chain(&translation).all(|x| x.is_finite());
        is_finite.then_some(Self { camera_from_first: SE3 { rotation, translation }, normal })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::test_scene::CAMERA;
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::tests::room;

    #[test]
    fn the_rival_has_the_same_homography_and_its_rival_is_the_original_motion() {
        let normal = Vector3::new(0.2, -0.3, 0.9);
        for twist in [[0.1, 0.02, -0.03, 0.02, -0.05, 0.01], [0.0, 0.01, 0.2, 0.0, 0.01, -0.03]] {
            let camera_from_first = SE3::exp(&Vector6::from(twist));
            let motion = PlaneMotion { camera_from_first, normal };
            let homography = |of: &PlaneMotion| {
                let rotation = of.camera_from_first.rotation.to_rotation_matrix().into_inner();
                rotation + of.camera_from_first.translation * of.normal.transpose()
            };
            let rival = motion.rival().unwrap();
            assert!((homography(&rival) - homography(&motion)).norm() < 1e-9);
            assert!((rival.normal - normal).norm() > 0.1, "{rival:?}");
            assert!((rival.normal.z - normal.z).abs() < 1e-9);
            let back = rival.rival().unwrap();
            assert!((back.camera_from_first.log() - camera_from_first.log()).norm() < 1e-6);
            assert!((back.normal - normal).norm() < 1e-6);
        }
        let turned = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.1, 0.2, 0.0));
        assert!(PlaneMotion { camera_from_first: turned, normal }.rival().is_none());
        let broken = Vector3::new(f64::NAN, 0.0, 1.0);
        assert!(PlaneMotion { camera_from_first: turned, normal: broken }.rival().is_none());
    }

    #[test]
    fn the_right_motion_is_confirmed_and_the_wrong_one_is_refuted() {
        let mut window = Window::new(CAMERA, WindowParams::default());
        window.keyframes = room(|_, _| (1.0, 0.0)).keyframes;
        let chosen = window.choose_members(window.keyframes.len() - 1);
        window.adjust(&chosen).unwrap();
        let right = window.keyframes.clone();
        assert!(!window.is_refuted(&chosen));
        assert!(window.keyframes == right, "asking changes nothing");
        assert_eq!(window.confirmed_epoch, Some(0), "it is not asked about again");
        window.confirmed_epoch = None;
        assert!(window.estimate_rival(&chosen));
        assert!(window.is_refuted(&chosen));
    }
}
