//! Uncertainty of the errors that all depth of the active keyframe shares: initialised by the start, updated by every
//! frame, propagated from keyframe to keyframe.

use nalgebra::{Matrix3, Matrix6};
use serde::{Deserialize, Serialize};

use crate::slam::depth::common_error::{JointCovariance, PoseByModes, SampledDepth};
use crate::slam::depth::map::DepthMap;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe_pose_covariance::KeyframePoseCovariance;
use crate::slam::modes::ModeCovariance;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{PoseEstimate, full_covariance};
use crate::slam::tracker::covariance_floor::displacement_covariance;
use crate::slam::window::marginals::Marginal;
use crate::slam::window::place_marginals::KeyframePoseMarginal;

/// Tuning of the covariance of common depth errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModeParams {
    /// Standard deviation of tilt and relief that every keyframe adds: relative depth error per unit of the ray's
    /// coordinates and of ln d. Covers what is not modelled; exact images leave 0.0005 to 0.0015.
    pub floor_std_dev: f64,
    /// Inflation of the covariance of a frame's pose error where it enters depth: errors of lens and shutter are
    /// similar in consecutive frames and do not average out.
    pub pose_inflation: f64,
    /// Inflation of the joint estimate's covariance, which takes residuals as independent although neighbouring samples
    /// share pixels.
    pub estimate_inflation: f64,
    /// Share of the variance of an image's displacement that has the shape of a mode: a displacement that is uniform
    /// over the image goes into the poses. With 0.3 the depth errors of exact images agree with P.
    pub displaced_share: f64,
}

impl Default for ModeParams {
    fn default() -> Self {
        Self {
            floor_std_dev: 0.001,
            pose_inflation: 9.0,
            estimate_inflation: 2.0,
            displaced_share: 0.3,
        }
    }
}

impl ModeParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("floor_std_dev", self.floor_std_dev, 0.0..=1.0)?;
        check_range("pose_inflation", self.pose_inflation, 0.0..=1e6)?;
        check_range("estimate_inflation", self.estimate_inflation, 0.0..=1e6)?;
        check_range("displaced_share", self.displaced_share, 0.0..=1e6)
    }

    fn floor(&self) -> Matrix3<f64> {
        Matrix3::from_diagonal_element(self.floor_std_dev * self.floor_std_dev)
    }
}

/// The covariance of the active keyframe's modes, and of the current frame.
#[derive(Debug, Default)]
pub(super) struct KeyframeModes {
    covariance: Matrix3<f64>,
    samples: SampledDepth,
    joint: Option<JointCovariance>,
    /// Mean square of the displacements of recent images, pixels².
    squared_displacement: Option<f64>,
}

impl KeyframeModes {
    /// Resets the modes: there is no depth yet, hence no error of it.
    pub(super) fn forget(&mut self) {
        self.covariance = Matrix3::zeros();
        self.joint = None;
    }

    /// Takes over the modes of a keyframe that becomes active, or has been estimated.
    pub(super) fn enter(&mut self, of_keyframe: &ModeCovariance, params: &ModeParams) {
        self.covariance = of_keyframe.matrix() - params.floor();
    }

    /// The mode covariance that a keyframe publishes.
    pub(super) fn published(&self, params: &ModeParams) -> ModeCovariance {
        ModeCovariance::bounded(&(self.covariance + params.floor()))
    }

    /// The mode covariance that a keyframe publishes after a joint estimate with this marginal: noise, plus the
    /// displacement of whole images, as measured for this camera.
    pub(super) fn of_estimate(&self, marginal: &Marginal, params: &ModeParams) -> ModeCovariance {
        let squared = self.squared_displacement.unwrap_or_default();
        let displaced = marginal.of_displaced * squared * params.displaced_share;
        let noise = marginal.modes * params.estimate_inflation;
        ModeCovariance::bounded(&(noise + displaced + params.floor()))
    }

    /// The place covariance that a keyframe publishes after that estimate: noise, plus its image's displacement, which
    /// all goes into its pose; `None` where the estimate has none.
    pub(super) fn pose_covariance_of_estimate(
        &self,
        marginal: &Marginal,
        params: &ModeParams,
    ) -> Option<KeyframePoseCovariance> {
        let KeyframePoseMarginal { noise, of_displaced } = marginal.place?;
        let displaced = of_displaced * self.squared_displacement.unwrap_or_default();
        Some(KeyframePoseCovariance::bounded(&(noise * params.estimate_inflation + displaced)))
    }

    /// Rescales after the unit of the depth has grown by `factor` since the current frame was considered.
    pub(super) fn rescale(&mut self, factor: f64) {
        self.samples.rescale(factor as f32);
        self.joint = self.joint.map(|joint| joint.rescaled(factor));
    }

    /// Initialises the modes of depth that was found in a single second frame, whose pose has this covariance.
    pub(super) fn begin(
        &mut self,
        depth: &DepthMap,
        intrinsics: &Intrinsics,
        current_from_keyframe: &SE3,
        pose: &Matrix6<f64>,
    ) {
        self.samples.take(depth, intrinsics);
        let by_pose = self.samples.modes_by_pose(current_from_keyframe);
        self.joint = by_pose.map(|by_pose| JointCovariance::of_start(&by_pose, pose));
        self.covariance = self.joint.map_or_else(Matrix3::zeros, |joint| joint.modes);
    }

    /// Considers a frame before it is observed on `depth`, whose unit in the keyframe's is `unit`.
    pub(super) fn begin_frame(
        &mut self,
        depth: &DepthMap,
        unit: f64,
        intrinsics: &Intrinsics,
        pose: &PoseEstimate,
        params: &ModeParams,
    ) {
        /// Weight of the newest image: averages about as many as lie between two keyframes.
        const NEWEST: f64 = 0.1;
        let squared = pose.quality.displacement_px.powi(2);
        let mean = self.squared_displacement.get_or_insert(squared);
        *mean += NEWEST * (squared - *mean);
        self.samples.take(depth, intrinsics);
        let noise = pose_noise(intrinsics, pose, unit) * params.pose_inflation;
        // A pose that is given without covariance is exact: it does not follow the depth.
        let is_estimated = noise.trace() > 0.0;
        let frame_from_keyframe = in_unit(&pose.keyframe_from_camera, unit);
        let follows = match is_estimated {
            true => self.samples.d_pose_d_modes(&frame_from_keyframe),
            false => Some(PoseByModes::zeros()),
        };
        self.joint =
            follows.map(|follows| JointCovariance::of_aligned(&self.covariance, &follows, &noise));
    }

    /// Updates the modes after that frame was observed.
    pub(super) fn update_after_observation(&mut self, depth: &DepthMap, frame_from_keyframe: &SE3) {
        let Some(joint) = &mut self.joint else { return };
        if let Some(response) = self.samples.response_to_observation(depth, frame_from_keyframe) {
            *joint = joint.after(&response);
            self.covariance = joint.modes;
        }
    }

    /// Propagates the modes to that frame, the next keyframe, from those of the previous one and its pose error.
    pub(super) fn propagate_modes(
        &mut self,
        frame_from_keyframe: &SE3,
        intrinsics: &Intrinsics,
        params: &ModeParams,
    ) {
        let response = self.samples.response_to_propagation(frame_from_keyframe, intrinsics);
        if let (Some(joint), Some(response)) = (self.joint.take(), response) {
            self.covariance = joint.after(&response).modes;
        }
        self.covariance += params.floor();
    }
}

/// `frame_from_keyframe` in the unit of the keyframe's depth.
pub(super) fn in_unit(keyframe_from_camera: &SE3, unit: f64) -> SE3 {
    let mut frame_from_keyframe = keyframe_from_camera.inverse();
    frame_from_keyframe.translation /= unit;
    frame_from_keyframe
}

/// Covariance of a frame's pose error apart from what follows from the modes of the depth: noise of single points, and
/// displacements of the whole image. In the unit of the depth.
fn pose_noise(intrinsics: &Intrinsics, pose: &PoseEstimate, unit: f64) -> Matrix6<f64> {
    let mut of_alignment = full_covariance(&pose.alignment_covariance);
    for i in 0..3 {
        of_alignment.row_mut(i).scale_mut(1.0 / unit);
        of_alignment.column_mut(i).scale_mut(1.0 / unit);
    }
    of_alignment + displacement_covariance(pose.quality.displacement_px, intrinsics, 1.0)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector3, Vector6};

    use super::*;
    use crate::slam::depth::map::Hypothesis;
    use crate::slam::frame::FrameView;
    use crate::slam::pose::Quality;
    use crate::slam::test_scene::{CAMERA, Scene};

    /// Depth of a scene at every candidate pixel.
    fn depth() -> DepthMap {
        let view = Scene::new(3).render(&CAMERA, &SE3::identity());
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        map.restart(&view.noisy(1.0, 1), 5.0, usize::MAX);
        for v in 5..CAMERA.height - 5 {
            for u in 5..CAMERA.width - 5 {
                let d = view.inverse_depth.at(u, v);
                let index = v * CAMERA.width + u;
                if map.candidates.pixels()[index] {
                    map.hypotheses.pixels_mut()[index] = Hypothesis {
                        inverse_depth: d,
                        smoothed: d,
                        variance: (0.05 * d).powi(2),
                        validity: 9,
                        ..Hypothesis::NONE
                    };
                }
            }
        }
        map
    }

    /// The same after a frame that halved every variance.
    fn narrowed(map: &DepthMap) -> DepthMap {
        let mut after = map.clone();
        for hypothesis in after.hypotheses.pixels_mut().iter_mut().filter(|h| h.is_some()) {
            hypothesis.inverse_depth *= 1.0001;
            hypothesis.variance *= 0.5;
        }
        after
    }

    fn pose(place: Vector6<f64>, displacement_px: f64) -> PoseEstimate {
        let frame = FrameView {
            sequence: 0,
            capture_nanos: 0,
            exposure_nanos: 0,
            width: CAMERA.width,
            height: CAMERA.height,
            pixels: &[],
        };
        PoseEstimate {
            keyframe_from_camera: SE3::exp(&place),
            quality: Quality { displacement_px, ..Quality::default() },
            ..PoseEstimate::unknown(&frame)
        }
    }

    /// Standard deviations after this many frames at `place`, whose images are displaced by `displacement_px`.
    fn after_frames(
        frames: usize,
        displacement_px: f64,
        begun_at: f64,
        place: Vector6<f64>,
    ) -> Vector3<f64> {
        let params =
            ModeParams { floor_std_dev: 0.0, pose_inflation: 1.0, ..ModeParams::default() };
        let (map, mut modes) = (depth(), KeyframeModes::default());
        let (after, pose) = (narrowed(&map), pose(place, displacement_px));
        modes.enter(&ModeCovariance::of_std_devs([begun_at; 3]), &params);
        for _ in 0..frames {
            modes.begin_frame(&map, 1.0, &CAMERA, &pose, &params);
            modes.update_after_observation(&after, &in_unit(&pose.keyframe_from_camera, 1.0));
        }
        modes.published(&params).std_devs()
    }

    const SIDEWAYS: [f64; 6] = [0.25, 0.05, 0.1, 0.01, -0.02, 0.01];

    #[test]
    fn pose_errors_cause_depth_errors_that_grow_as_the_baseline_shrinks() {
        let near = Vector6::from(SIDEWAYS.map(|x| 0.3 * x));
        let exact = after_frames(3, 0.0, 0.0, SIDEWAYS.into());
        assert_eq!(exact, Vector3::zeros());
        let (little, much) = (
            after_frames(3, 0.1, 0.0, SIDEWAYS.into()),
            after_frames(3, 1.0, 0.0, SIDEWAYS.into()),
        );
        let close = after_frames(3, 1.0, 0.0, near);
        for mode in 0..3 {
            assert!((much[mode] / little[mode] - 10.0).abs() < 1e-3, "{much} {little}");
            assert!(much[mode] > 1e-4 && close[mode] > 2.0 * much[mode], "{close} {much}");
        }
    }

    #[test]
    fn exact_poses_remove_old_errors_and_estimated_ones_only_the_part_they_do_not_absorb() {
        let begun = 0.1;
        let of_exact = after_frames(6, 0.0, begun, SIDEWAYS.into());
        assert!(of_exact.max() < 0.05 * begun, "{of_exact}");
        // A pose that follows the depth keeps the error that hides in the pose.
        let of_estimated = after_frames(6, 1e-3, begun, SIDEWAYS.into());
        assert!(of_estimated.norm() < 0.95 * begun * 3f64.sqrt(), "{of_estimated}");
        assert!(of_estimated.max() > 3.0 * of_exact.max(), "{of_estimated} {of_exact}");
    }

    #[test]
    fn a_keyframe_keeps_its_covariance_and_every_change_adds_the_floor() {
        let params =
            ModeParams { floor_std_dev: 0.01, pose_inflation: 1.0, ..ModeParams::default() };
        let mut modes = KeyframeModes::default();
        let said = ModeCovariance::of_std_devs([0.03, 0.05, 0.07]);
        modes.enter(&said, &params);
        assert!((modes.published(&params).matrix() - said.matrix()).norm() < 1e-15);
        let map = depth();
        let still = pose(Vector6::zeros(), 0.0);
        modes.begin_frame(&map, 1.0, &CAMERA, &still, &params);
        modes.propagate_modes(&SE3::identity(), &CAMERA, &params);
        let grown = modes.published(&params).matrix() - said.matrix();
        assert!((grown - Matrix3::from_diagonal_element(1e-4)).norm() < 1e-6, "{grown}");
    }
}
