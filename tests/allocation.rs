//! After warm-up, tracking or holding a frame, preparing a keyframe and tracing points do not allocate.

#[allow(dead_code, reason = "every test uses its part of what they share")]
#[path = "support/counting_allocator.rs"]
mod counting_allocator;
#[allow(dead_code, reason = "every test uses its part of what they share")]
#[path = "support/waves.rs"]
mod waves;

use semidense::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch};
use semidense::slam::depth::candidate::CandidateParams;
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::immature::{IntervalParams, TraceFrame};
use semidense::slam::depth::interval::IntervalFilter;
use semidense::slam::depth::map::DepthMap;
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::pose::{Brightness, DegradedReason, TrackingState};
use semidense::slam::tracker::{Tracker, TrackerParams};

use counting_allocator::{allocations, count_everywhere};
use waves::{CAMERA, image, keyframe};

#[test]
fn a_frame_and_a_keyframe_allocate_nothing_after_warm_up() {
    count_everywhere();
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    let mut spare = Some(Box::new(Reference::new(ReferenceParams::default())));
    let mut scratch = ReferenceScratch::default();
    let keyframes = [keyframe(0), keyframe(1), keyframe(2), keyframe(3)];
    let mut pixels: Vec<_> = (0..12).map(|i| image(0.4 * f64::from(i))).collect();
    // One unlike all others, so that other motions are tried and the frame is lost.
    pixels.push(image(0.0).iter().rev().map(|&grey| 255 - grey).collect());
    let (mut before, mut tracked) = (0, 0);
    for (index, keyframe) in keyframes.iter().enumerate() {
        if index == 2 {
            before = allocations();
        }
        // Two references alternate, as in the process: one active, one being prepared.
        let mut reference =
            spare.take().unwrap_or_else(|| Box::new(Reference::new(ReferenceParams::default())));
        reference.prepare_into(keyframe, &mut scratch);
        spare = tracker.adopt(reference);
        for (sequence, pixels) in pixels.iter().enumerate() {
            let frame = FrameView::new(
                &CAMERA,
                (index * 100 + sequence) as u64,
                (index * 100 + sequence) as i64 * 33_000_000,
                pixels,
            );
            tracked += usize::from(tracker.track(&frame, &mut |_| true).state.is_tracked());
        }
    }
    let allocated = allocations() - before;
    assert_eq!(allocated, 0, "in two keyframes of 13 frames each");
    assert!(tracked > 20, "only {tracked} frames were tracked: this measures nothing");
    tracing_points_allocates_nothing();
    holding_a_view_allocates_nothing();
}

/// A wall of waves around the camera, seen from its centre at this angle, radians.
fn panorama(angle: f64) -> Vec<u8> {
    let grey = |u: usize, v: usize| {
        let (x, y) = ((u as f64 - CAMERA.cx) / CAMERA.fx, (v as f64 - CAMERA.cy) / CAMERA.fy);
        let (along, up) = (260.0 * (x.atan() + angle), 260.0 * y / x.hypot(1.0));
        let waves = 40.0 * (along * 0.19).sin() * (up * 0.13).cos();
        128.0 + waves + 30.0 * (0.031 * along + 0.11 * up).sin() + 20.0 * (0.053 * along).cos()
    };
    (0..CAMERA.width * CAMERA.height)
        .map(|i| grey(i % CAMERA.width, i / CAMERA.width) as u8)
        .collect()
}

/// Pans away from a keyframe: tracked frames run in warm memory, and so do all held ones.
fn holding_a_view_allocates_nothing() {
    const FRAMES: u64 = 40;
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    let known = panorama(0.0);
    let mut known_here = keyframe(0);
    for point in &mut known_here.points {
        point.intensity =
            f32::from(known[usize::from(point.v) * CAMERA.width + usize::from(point.u)]);
    }
    known_here.image = known.into();
    tracker.adopt(Box::new(Reference::prepare(&known_here)));
    let pixels: Vec<_> = (0..FRAMES).map(|k| panorama(0.045 * k as f64)).collect();
    let (mut before, mut held) = (0, 0);
    for (sequence, pixels) in (0..).zip(&pixels) {
        if sequence == 4 {
            before = allocations();
        }
        let frame = FrameView::new(&CAMERA, sequence, sequence as i64 * 33_000_000, pixels);
        let estimate = tracker.track(&frame, &mut |_| true);
        held += u64::from(estimate.state == TrackingState::Degraded(DegradedReason::Turning));
        tracker.prepare_next();
    }
    assert_eq!(allocations() - before, 0, "in frames 4 to {FRAMES} of a pan");
    assert!(held > 10, "only {held} frames were held: this measures nothing");
}

/// Two keyframes of points, each traced through some frames; the second one runs in warm memory. Part of the only test
/// of this file: allocations of a concurrent test would be counted.
fn tracing_points_allocates_nothing() {
    let (mut map, mut filter) =
        (DepthMap::with_size(CAMERA.width, CAMERA.height), IntervalFilter::default());
    let params = IntervalParams::default();
    let frames = [1.0, 2.0, 3.0, 4.0].map(|shift| {
        let mut frame = QuadImage::with_size(CAMERA.width, CAMERA.height);
        frame.fill(&image(shift));
        frame
    });
    let pixels = image(0.0);
    let (mut before, mut matched) = (0, 0);
    for keyframe in 0..3 {
        if keyframe == 2 {
            before = allocations();
        }
        map.restart(&pixels, 1.0, 100_000);
        filter.restart_where_empty(&map);
        filter.restart_from_map(&mut map, &CandidateParams::default());
        for (frame, shift) in frames.iter().zip(1..) {
            let mut moved = SE3::identity();
            // A wall at depth 1 moves by `shift` pixels.
            moved.translation.x = f64::from(shift) / CAMERA.fx;
            let view = TwoView::new(&CAMERA, &moved);
            let traced = TraceFrame { image: frame, view, brightness: Brightness::default() };
            matched += filter.trace(&traced, &params).good;
            filter.write_into(&mut map, &params);
        }
        filter.hand_over(&mut map, &params);
    }
    let allocated = allocations() - before;
    assert_eq!(allocated, 0, "in one keyframe of 4 frames");
    assert!(matched > 1000, "only {matched} matches: this measures nothing");
}
