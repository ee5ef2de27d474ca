//! A round trip preserves every bit; invalid messages are refused, and nothing panics.

use nalgebra::Vector6;
use proptest::prelude::*;

use super::*;
use crate::slam::keyframe_pose_covariance::KeyframePoseMatrix;
use crate::slam::pose::{NO_KEYFRAME, Velocity};

fn transform() -> SE3 {
    SE3::exp(&Vector6::new(0.3, -0.2, 0.1, 0.4, 0.5, -0.6))
}

fn pose() -> PoseEstimate {
    PoseEstimate {
        sequence: 7,
        capture_nanos: -5,
        epoch: 3,
        revision: 99,
        keyframe_id: NO_KEYFRAME,
        state: TrackingState::Lost(LostReason::NoPoints),
        map_revision: 5,
        world_from_camera: transform(),
        map_from_camera: transform().inverse(),
        keyframe_from_camera: transform().inverse(),
        covariance: std::array::from_fn(|i| 0.1 / (i as f64 + 3.0)),
        map_covariance: std::array::from_fn(|i| 0.2 / (i as f64 + 3.0)),
        alignment_covariance: std::array::from_fn(|i| 0.01 / (i as f64 + 3.0)),
        velocity: Some(Velocity {
            linear: [0.4, -0.1, 0.7].into(),
            angular: [0.01, 0.2, -0.3].into(),
            covariance: std::array::from_fn(|i| 0.3 / (i as f64 + 3.0)),
        }),
        brightness: Brightness { a: 0.1, b: -3.0 },
        quality: Quality { in_view_ratio: 0.9, points: 123, ..Quality::default() },
        proposes_keyframe: true,
    }
}

fn keyframe() -> Keyframe {
    let point = DepthPoint { u: 19, v: 17, inverse_depth: 0.5, variance: 0.1, intensity: 9.0 };
    Keyframe {
        keyframe_id: 4,
        epoch: 1,
        revision: 8,
        sequence: 30,
        capture_nanos: 1_000,
        mode_covariance: ModeCovariance::of_std_devs([0.01, 0.02, 0.05]),
        place_covariance: KeyframePoseCovariance::bounded(&(KeyframePoseMatrix::identity() * 0.01)),
        ..Keyframe::at(
            Sim3::new(transform(), 1.3),
            Intrinsics { fx: 20.0, fy: 21.0, cx: 9.5, cy: 8.5, width: 20, height: 18 },
            vec![point; 3],
            (0..20 * 18).map(|i| (i % 256) as u8).collect(),
        )
    }
}

fn read(keyframe: &Keyframe) -> Result<Keyframe, MessageError> {
    let header = keyframe_header(keyframe);
    let image_header = keyframe_image_header(keyframe);
    keyframe_from_messages(&header, &keyframe.points, &image_header, &keyframe.image)
}

#[test]
fn poses_survive_bit_for_bit() {
    let timing = PoseTiming {
        realtime_nanos: 6,
        published_nanos: 5,
        latency_nanos: 4,
        track_nanos: 3,
        wake_nanos: 2,
    };
    let read = pose_from_message(&pose_message(&pose(), &timing)).unwrap();
    assert_eq!(read, pose());
    let bits = |t: &SE3| rigid_message(t).map(f64::to_bits);
    assert_eq!(bits(&read.world_from_camera), bits(&pose().world_from_camera));
    assert_eq!(bits(&read.map_from_camera), bits(&pose().map_from_camera));
}

#[test]
fn keyframes_survive_bit_for_bit() {
    assert_eq!(read(&keyframe()).unwrap(), keyframe());
    let pose = KeyframePose {
        keyframe_id: 4,
        revision: 7,
        map_from_keyframe: Sim3::new(transform(), 2.0),
    };
    assert_eq!(keyframe_pose_from_message(&keyframe_pose_message(&pose)).unwrap(), pose);
}

#[test]
fn every_state_has_its_codes() {
    let mut seen = 0;
    for (state, reason) in (0..6).flat_map(|s| (0..6).map(move |r| (s, r))) {
        if let Ok(read) = state_from_codes(state, reason) {
            assert_eq!(codes_from_state(read), (state, reason));
            seen += 1;
        }
    }
    assert_eq!(seen, 2 + 5 + 5);
}

#[test]
fn invalid_keyframes_are_refused() {
    let good = keyframe();
    let with = |change: &dyn Fn(&mut Keyframe)| {
        let mut keyframe = good.clone();
        change(&mut keyframe);
        read(&keyframe)
    };
    assert!(matches!(with(&|k| k.points[2].u = 20), Err(MessageError::InvalidPoint { index: 2 })));
    assert!(with(&|k| k.points[1].variance = f32::NAN).is_err());
    assert!(with(&|k| k.points = vec![k.points[0]; MAX_KEYFRAME_POINTS + 1]).is_err());
    assert!(with(&|k| k.image = k.image[..5].into()).is_err());
    assert!(with(&|k| k.intrinsics.fx = f64::INFINITY).is_err());
    assert!(with(&|k| k.intrinsics.width = 1 << 30).is_err());
    assert!(with(&|k| k.world_from_keyframe.scale = 0.0).is_err());
    for broken in [[f64::NAN; 6], [0.1, 1.0, 0.0, 0.1, 0.0, 0.1]] {
        let mut header = keyframe_header(&good);
        header.mode_covariance = broken;
        let image_header = keyframe_image_header(&good);
        let read = keyframe_from_messages(&header, &good.points, &image_header, &good.image);
        assert_eq!(read, Err(MessageError::InvalidNumber { field: "mode_covariance" }));
    }
    let with = |index: usize, value: f64| {
        let mut triangle = good.place_covariance.upper_triangle();
        triangle[index] = value;
        triangle
    };
    // NaN, a negative variance, a correlation above 1, an absurdly large variance.
    for broken in [with(5, f64::NAN), with(7, -0.01), with(1, 0.02), with(27, 1e9)] {
        let mut header = keyframe_header(&good);
        header.place_covariance = broken;
        let image_header = keyframe_image_header(&good);
        let read = keyframe_from_messages(&header, &good.points, &image_header, &good.image);
        assert_eq!(read, Err(MessageError::InvalidNumber { field: "place_covariance" }));
    }
    let (header, mut image_header) = (keyframe_header(&good), keyframe_image_header(&good));
    image_header.keyframe_id = 5;
    let other = keyframe_from_messages(&header, &good.points, &image_header, &good.image);
    assert_eq!(other, Err(MessageError::OtherKeyframe { keyframe_id: 4, image_id: 5 }));
}

#[test]
fn poses_with_an_invalid_covariance_are_refused() {
    let with = |index: usize, value: f64| {
        let mut message = pose_message(&pose(), &PoseTiming::default());
        message.map_covariance[index] = value;
        pose_from_message(&message)
    };
    assert!(with(1, -0.1).is_ok() && with(20, 0.0).is_ok());
    for (index, value) in [(1, f64::NAN), (0, -1e-9), (20, -0.1), (11, f64::INFINITY)] {
        let refused = Err(MessageError::InvalidNumber { field: "map_covariance" });
        assert_eq!(with(index, value), refused, "{index} {value}");
    }
}

#[test]
fn invalid_velocities_are_refused() {
    let good = pose_message(&pose(), &PoseTiming::default());
    let read = |change: &dyn Fn(&mut PoseMessage)| {
        let mut message = good;
        change(&mut message);
        pose_from_message(&message).map(|read| read.velocity.is_some())
    };
    assert_eq!(read(&|_| {}), Ok(true));
    // Covariances between two axes may be negative.
    assert_eq!(read(&|message| message.velocity_covariance[1] = -0.1), Ok(true));
    assert_eq!(read(&|message| message.has_velocity = 0), Ok(false));
    let unknown = Err(MessageError::UnknownCode { field: "has_velocity", code: 2 });
    assert_eq!(read(&|message| message.has_velocity = 2), unknown);
    let refused = Err(MessageError::InvalidNumber { field: "velocity" });
    assert_eq!(read(&|message| message.linear_velocity[2] = f64::NAN), refused);
    assert_eq!(read(&|message| message.angular_velocity[0] = f64::INFINITY), refused);
    assert_eq!(read(&|message| message.velocity_covariance[1] = f64::NAN), refused);
    for diagonal in [0, 6, 11, 15, 18, 20] {
        assert_eq!(read(&|message| message.velocity_covariance[diagonal] = -1e-9), refused);
    }
}

#[test]
fn a_pose_without_velocity_has_zeros_in_its_message() {
    let without = PoseEstimate { velocity: None, ..pose() };
    let timing = PoseTiming { realtime_nanos: 1_700_000_000_123_456_789, ..PoseTiming::default() };
    let message = pose_message(&without, &timing);
    assert_eq!((message.has_velocity, message.realtime_nanos), (0, timing.realtime_nanos));
    let zeros = ([0.0; 3], [0.0; 3], [0.0; 21]);
    let [linear, angular] = [message.linear_velocity, message.angular_velocity];
    assert_eq!((linear, angular, message.velocity_covariance), zeros);
    assert_eq!(pose_from_message(&message), Ok(without));
}

#[test]
fn invalid_frames_are_refused() {
    let pixels = vec![0; 20 * 18];
    let header = FrameHeader {
        intrinsics: [20.0, 21.0, 9.5, 8.5],
        width: 20,
        height: 18,
        stride: 20,
        ..FrameHeader::default()
    };
    assert!(frame_from_message(&header, &pixels).is_ok());
    for hostile in [
        FrameHeader { stride: 21, ..header },
        FrameHeader { width: u32::MAX, stride: u32::MAX, ..header },
        FrameHeader { height: 0, ..header },
        FrameHeader { height: 19, ..header },
        FrameHeader { intrinsics: [f64::NAN; 4], ..header },
    ] {
        assert!(frame_from_message(&hostile, &pixels).is_err(), "{hostile:?}");
    }
}

proptest! {
    #[test]
    fn no_pose_message_panics_or_brings_in_a_broken_number(
        bits in prop::array::uniform32(any::<u64>()), codes in prop::array::uniform4(0_u32..6),
        has_transform in any::<bool>(), has_covariances in any::<bool>(),
    ) {
        let mut message = pose_message(&pose(), &PoseTiming::default());
        let number = |i: usize| f64::from_bits(bits[i]);
        (message.state, message.reason) = (codes[0], codes[1]);
        message.proposes_keyframe = codes[2];
        if !has_transform {
            message.world_from_camera = std::array::from_fn(number);
        }
        if !has_covariances {
            message.covariance = std::array::from_fn(|i| number(i + 7));
            message.map_covariance = std::array::from_fn(|i| number(i + 5));
            message.alignment_covariance = std::array::from_fn(|i| number(i + 8));
        }
        message.residual_rmse = number(31);
        message.has_velocity = codes[3];
        message.linear_velocity = std::array::from_fn(|i| number(i + 3));
        message.velocity_covariance = std::array::from_fn(|i| number(i + 11));
        if let Ok(read) = pose_from_message(&message) {
            prop_assert!(read.world_from_camera.is_finite());
            prop_assert!(read.covariance.iter().all(|c| c.is_finite()));
            prop_assert!(read.map_covariance.iter().all(|c| c.is_finite()));
            prop_assert!(read.velocity.is_none_or(|v| v.covariance.iter().chain(&v.linear).all(|x| x.is_finite())));
        }
    }

    #[test]
    fn quaternions_that_are_none_are_refused(q in prop::array::uniform4(-2.0..2.0_f64)) {
        let message = [q[0], q[1], q[2], q[3], 0.0, 0.0, 0.0];
        let is_unit = (q.iter().map(|x| x * x).sum::<f64>().sqrt() - 1.0).abs() < 1e-6;
        prop_assert_eq!(rigid_from_message(&message, "x").is_ok(), is_unit);
    }
}
