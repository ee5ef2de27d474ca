//! A camera that sees the arm of its robot in every frame, behind a mask.

use semidense::capture::image_file::write_gray_png;
use semidense::capture::mask::Mask;
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{MotionKind, MotionParams, SimulatorParams};
use semidense::capture::source::{FrameSource, FrameStamp};
use semidense::capture::source_error::SourceError;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::image::NO_DATA;
use semidense::slam::trajectory::StampedPose;

use crate::dim_light::tracked_and_error;

const FRAMES: u64 = 120;

/// The frames of another source with an arm in front: a checkered tenth of the image, in the middle below.
struct WithArm<S>(S);

/// Whether the arm covers a pixel.
fn is_arm(camera: &Intrinsics, index: usize) -> bool {
    let (u, v) = (index % camera.width, index / camera.width);
    v > camera.height * 3 / 5 && u.abs_diff(camera.width / 2) < camera.width / 8
}

impl<S: FrameSource> FrameSource for WithArm<S> {
    fn intrinsics(&self) -> Intrinsics {
        self.0.intrinsics()
    }

    fn num_frames(&self) -> Option<usize> {
        self.0.num_frames()
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        /// Squares of the arm's pattern, pixels.
        const SQUARE: usize = 8;
        let stamp = self.0.next_into(pixels);
        let camera = self.intrinsics();
        for (index, grey) in pixels.iter_mut().enumerate().filter(|(i, _)| is_arm(&camera, *i)) {
            let square = index % camera.width / SQUARE + index / camera.width / SQUARE;
            *grey = if square.is_multiple_of(2) { 60 } else { 190 };
        }
        stamp
    }

    fn ground_truth(&self) -> &[StampedPose] {
        self.0.ground_truth()
    }
}

fn replayed(with_mask: bool) -> RunRecord {
    let motion = MotionParams { kind: MotionKind::Handheld, ..MotionParams::default() };
    let params =
        SimulatorParams { frames: FRAMES as usize, motion, ..SimulatorParams::half_size() };
    let mut source = WithArm(Simulator::new(params).unwrap());
    let camera = source.intrinsics();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.png");
    let grey = |index| if is_arm(&camera, index) { 0 } else { 255 };
    let pixels: Vec<u8> = (0..camera.width * camera.height).map(grey).collect();
    write_gray_png(&path, camera.width, camera.height, &pixels).unwrap();
    let mask = with_mask.then(|| Mask::read(&path, &source).unwrap());
    let config = ReplayConfig { mask, ..ReplayConfig::default() };
    replay(&mut source, "arm", &config, &mut |_| true).unwrap()
}

#[test]
fn a_robots_arm_behind_a_mask_leaves_poses_and_depth_as_they_are() {
    let record = replayed(true);
    let (tracked, error_ratio) = tracked_and_error(&record);
    println!(
        "{tracked} of {FRAMES} tracked, ATE {error_ratio:?}; bare: {:?}",
        tracked_and_error(&replayed(false))
    );
    assert!(tracked >= 100, "{tracked}");
    assert!(error_ratio.unwrap() < 0.003, "{error_ratio:?}");
    let camera = record.map.keyframes[0].intrinsics;
    for keyframe in &record.map.keyframes {
        let missing = keyframe.image.iter().filter(|&&grey| grey == NO_DATA).count();
        let arm = (0..keyframe.image.len()).filter(|i| is_arm(&camera, *i)).count();
        assert_eq!(missing, arm);
        let index = |u: u16, v: u16| usize::from(v) * camera.width + usize::from(u);
        let on_arm = keyframe.points.iter().filter(|p| is_arm(&camera, index(p.u, p.v))).count();
        assert_eq!(on_arm, 0, "points on the arm of keyframe {}", keyframe.keyframe_id);
        assert!(keyframe.points.len() > 1000);
    }
}
