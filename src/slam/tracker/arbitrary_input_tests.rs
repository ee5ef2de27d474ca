//! The tracker accepts arbitrary input: no panic, nothing non-finite, and a good frame is tracked afterwards.

use nalgebra::{Matrix6, Vector6};
use proptest::prelude::*;

use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::scene::{Noise, Plane};
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::UNKNOWN_VARIANCE;
use crate::slam::pose::full_covariance;
use crate::slam::tracker::tests::is_clean;
use crate::slam::tracker::{Tracker, TrackerParams};

const CAMERA: Intrinsics =
    Intrinsics { fx: 80.0, fy: 80.0, cx: 47.2, cy: 35.7, width: 96, height: 72 };

fn plane() -> Plane {
    Plane::new([0.12, -0.2, 0.95], [8.0, 80.0], &CAMERA)
}

/// Numbers that a broken or malicious message may contain.
fn hostile_number() -> impl Strategy<Value = f32> {
    const EXTREMES: [f32; 17] = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        0.0,
        -0.0,
        -1.0,
        f32::MAX,
        f32::MIN,
        f32::MIN_POSITIVE,
        1e-40,
        1e-15,
        1e-6,
        1e6,
        1e15,
        1e20,
        3e38,
        1.0,
    ];
    prop::sample::select(EXTREMES.to_vec())
}

/// Damage done to a keyframe.
#[derive(Debug, Clone)]
struct Harm {
    /// Number of points that are left.
    points: usize,
    /// Every n-th point gets the numbers below.
    stride: usize,
    inverse_depth: Option<f32>,
    variance: Option<f32>,
    intensity: f32,
    place: Option<(u16, u16)>,
    scale: f64,
    map_scale: f64,
    image: Picture,
}

fn harm() -> impl Strategy<Value = Harm> {
    let points = prop::sample::select(vec![0, 1, 2, 7, 60, 100_000]);
    let number = || prop::option::of(hostile_number());
    let place = prop::option::of(any::<(u16, u16)>());
    let scale = || {
        let scales = vec![1.0, 1.0, 1.0, 0.0, -1.0, 1e-300, 1e200, 1e300, f64::NAN];
        prop::sample::select(scales)
    };
    let scales = (scale(), scale());
    (points, 1usize..5, number(), number(), hostile_number(), place, scales, picture()).prop_map(
        |(points, stride, inverse_depth, variance, intensity, place, scales, image)| Harm {
            points,
            stride,
            inverse_depth,
            variance,
            intensity,
            place,
            scale: scales.0,
            map_scale: scales.1,
            image,
        },
    )
}

impl Harm {
    fn done_to(&self, mut keyframe: Keyframe) -> Keyframe {
        keyframe.points.truncate(self.points);
        for point in keyframe.points.iter_mut().step_by(self.stride) {
            point.inverse_depth = self.inverse_depth.unwrap_or(point.inverse_depth);
            point.variance = self.variance.unwrap_or(point.variance);
            point.intensity = self.intensity;
            (point.u, point.v) = self.place.unwrap_or((point.u, point.v));
        }
        keyframe.world_from_keyframe.scale = self.scale;
        keyframe.map_from_keyframe.scale = self.map_scale;
        keyframe.image = self.image.pixels(&keyframe.image).into();
        keyframe
    }
}

/// Images that a camera may deliver.
#[derive(Debug, Clone)]
enum Picture {
    Constant(u8),
    Noise(u64),
    Saturated(u8),
    Halves,
    WrongSize(usize),
    AsItIs,
}

fn picture() -> impl Strategy<Value = Picture> {
    prop_oneof![
        any::<u8>().prop_map(Picture::Constant),
        Just(Picture::Constant(0)),
        Just(Picture::Constant(255)),
        any::<u64>().prop_map(Picture::Noise),
        (2u8..200).prop_map(Picture::Saturated),
        Just(Picture::Halves),
        (0usize..20_000).prop_map(Picture::WrongSize),
        Just(Picture::AsItIs),
        Just(Picture::AsItIs),
    ]
}

impl Picture {
    fn pixels(&self, good: &[u8]) -> Vec<u8> {
        match *self {
            Self::Constant(grey) => vec![grey; good.len()],
            Self::Noise(seed) => {
                let mut noise = Noise(seed);
                good.iter().map(|_| noise.bits() as u8).collect()
            }
            Self::Saturated(gain) => good.iter().map(|grey| grey.saturating_mul(gain)).collect(),
            Self::Halves => {
                (0..good.len()).map(|i| if i < good.len() / 2 { 0 } else { 255 }).collect()
            }
            Self::WrongSize(size) => vec![100; size],
            Self::AsItIs => good.to_vec(),
        }
    }
}

/// The last pose of the camera: anywhere, also with every point behind it.
fn pose() -> impl Strategy<Value = SE3> {
    let size = prop::sample::select(vec![0.0, 0.01, 0.3, 3.0, 1e3, 1e9, 1e30]);
    (size, prop::array::uniform3(-1.0f64..1.0), prop::array::uniform3(-3.1f64..3.1)).prop_map(
        |(size, t, r)| {
            SE3::exp(&Vector6::new(size * t[0], size * t[1], size * t[2], r[0], r[1], r[2]))
        },
    )
}

fn stamp() -> impl Strategy<Value = i64> {
    prop_oneof![Just(i64::MIN), Just(i64::MAX), Just(0), 0i64..1_000_000_000]
}

fn view(pixels: &[u8], sequence: u64, capture_nanos: i64) -> FrameView<'_> {
    FrameView::new(&CAMERA, sequence, capture_nanos, pixels)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 192, failure_persistence: None, ..Default::default() })]

    #[test]
    fn whatever_comes_in_what_goes_out_is_finite(
        harm in harm(),
        pictures in prop::collection::vec((picture(), stamp(), any::<u64>()), 1..4),
        before in prop::option::of(pose()),
        was_lost in any::<bool>(),
        iterations in prop::option::of(0u32..6),
    ) {
        let good = plane().keyframe(&CAMERA, 2, 0.02);
        let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&harm.done_to(good.clone()))));
        if let Some(before) = before {
            tracker.memory.motion.observe(0, &before);
        }
        tracker.memory.was_lost = was_lost;
        for (picture, capture_nanos, sequence) in pictures {
            let pixels = picture.pixels(&good.image);
            let mut left = iterations;
            let mut budget = |_: usize| left.as_mut().is_none_or(|left| {
                *left = left.saturating_sub(1);
                *left > 0
            });
            let estimate = tracker.track(&view(&pixels, sequence, capture_nanos), &mut budget);
            prop_assert!(is_clean(&estimate), "{estimate:?}");
        }
        // After a sound keyframe of the next epoch all is forgotten.
        let next = Keyframe { keyframe_id: 4, epoch: good.epoch + 1, ..good.clone() };
        tracker.adopt(Box::new(Reference::prepare(&next)));
        let estimate = tracker.track(&view(&good.image, 9, 9), &mut |_| true);
        prop_assert!(estimate.state.is_tracked(), "{estimate:?}");
    }
}

#[test]
fn a_keyframe_pose_that_overflows_leaves_the_pose_in_the_map_unknown() {
    let good = plane().keyframe(&CAMERA, 2, 0.02);
    for (x, scale) in [(1.0, 1e200), (1e160, 1.0)] {
        let place = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
        let hostile = Keyframe { map_from_keyframe: Sim3::new(place, scale), ..good.clone() };
        let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&hostile)));
        let estimate = tracker.track(&view(&good.image, 0, 0), &mut |_| true);
        assert!(is_clean(&estimate) && estimate.state.is_tracked(), "{estimate:?}");
        let unknown = Matrix6::from_diagonal_element(UNKNOWN_VARIANCE);
        assert_eq!(full_covariance(&estimate.map_covariance), unknown);
        assert!(full_covariance(&estimate.covariance).norm() < 1.0);
    }
}

#[test]
fn the_smallest_images_neither_panic_nor_give_wrong_poses() {
    for (width, height) in [(16, 16), (17, 16), (16, 33), (20, 200)] {
        let camera = Intrinsics { cx: 7.5, cy: 7.5, width, height, ..CAMERA };
        let plane = Plane::new([0.12, -0.2, 0.95], [8.0, 80.0], &camera);
        let keyframe = plane.keyframe(&camera, 1, 0.02);
        let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        for (sequence, image) in
            [&keyframe.image[..], &vec![0; width * height], &keyframe.image].into_iter().enumerate()
        {
            let view = FrameView::new(&camera, sequence as u64, sequence as i64, image);
            let estimate = tracker.track(&view, &mut |_| true);
            assert!(is_clean(&estimate), "{estimate:?}");
            assert_eq!(
                estimate.state.is_tracked(),
                sequence != 1,
                "{width}×{height}: {estimate:?}"
            );
            let error = estimate.keyframe_from_camera.log().norm();
            assert!(sequence == 1 || error < 1e-3, "{width}×{height}: {error}");
        }
    }
}
