//! After warm-up neither tracking a frame nor preparing a keyframe nor tracing points allocates.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use semidense::slam::alignment::reference::{Reference, ReferenceParams};
use semidense::slam::depth::candidate::CandidateParams;
use semidense::slam::depth::epipolar::TwoView;
use semidense::slam::depth::immature::{IntervalParams, TraceFrame};
use semidense::slam::depth::interval::IntervalFilter;
use semidense::slam::depth::map::DepthMap;
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::quads::QuadImage;
use semidense::slam::keyframe::{DepthPoint, Keyframe, MapState};
use semidense::slam::pose::Brightness;
use semidense::slam::tracker::{Tracker, TrackerParams};

/// The system's allocator, counting.
struct Counting;

static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's contract.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const CAMERA: Intrinsics =
    Intrinsics { fx: 260.0, fy: 260.0, cx: 159.5, cy: 119.5, width: 320, height: 240 };

/// Smooth waves, shifted by `shift` pixels.
fn image(shift: f64) -> Vec<u8> {
    let (width, height) = (CAMERA.width, CAMERA.height);
    let grey = |u: usize, v: usize| {
        let (u, v) = (u as f64 - shift, v as f64);
        128.0 + 40.0 * (u * 0.19).sin() * (v * 0.13).cos() + 30.0 * (0.07 * u + 0.11 * v).sin()
    };
    (0..width * height).map(|i| grey(i % width, i / width) as u8).collect()
}

fn keyframe(keyframe_id: u64) -> Keyframe {
    let image = image(0.0);
    let pixels = (2..CAMERA.height - 2).flat_map(|v| (2..CAMERA.width - 2).map(move |u| (u, v)));
    let points = pixels.map(|(u, v)| DepthPoint {
        u: u as u16,
        v: v as u16,
        inverse_depth: 1.0,
        variance: 1e-3,
        intensity: f32::from(image[v * CAMERA.width + u]),
    });
    Keyframe {
        keyframe_id,
        epoch: 0,
        revision: keyframe_id,
        sequence: 0,
        capture_nanos: 0,
        map_state: MapState::Established,
        world_from_keyframe: Sim3::identity(),
        intrinsics: CAMERA,
        points: points.collect(),
        image,
    }
}

#[test]
fn a_frame_and_a_keyframe_allocate_nothing_after_warm_up() {
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    let mut spare = Some(Box::new(Reference::new(ReferenceParams::default())));
    let keyframes = [keyframe(0), keyframe(1), keyframe(2), keyframe(3)];
    let mut pixels: Vec<_> = (0..12).map(|i| image(0.4 * f64::from(i))).collect();
    // One unlike all others, so that other motions are tried and the frame is lost.
    pixels.push(image(0.0).iter().rev().map(|&grey| 255 - grey).collect());
    let (mut before, mut tracked) = (0, 0);
    for (index, keyframe) in keyframes.iter().enumerate() {
        if index == 2 {
            before = ALLOCATIONS.load(Ordering::Relaxed);
        }
        // Two references take turns, as in the shell: one in force, one being prepared.
        let mut reference =
            spare.take().unwrap_or_else(|| Box::new(Reference::new(ReferenceParams::default())));
        reference.prepare_into(keyframe);
        spare = tracker.adopt(reference);
        for (sequence, pixels) in pixels.iter().enumerate() {
            let frame = FrameView {
                sequence: (index * 100 + sequence) as u64,
                capture_nanos: (index * 100 + sequence) as i64 * 33_000_000,
                exposure_nanos: 0,
                width: CAMERA.width,
                height: CAMERA.height,
                pixels,
            };
            tracked += usize::from(tracker.track(&frame, &mut |_| true).state.is_tracked());
        }
    }
    let allocations = ALLOCATIONS.load(Ordering::Relaxed) - before;
    assert_eq!(allocations, 0, "in two keyframes of 13 frames each");
    assert!(tracked > 20, "only {tracked} frames were tracked: this measures nothing");
    tracing_points_allocates_nothing();
}

/// Two keyframes of points, each traced through some frames; the second one is in warm memory. Part of
/// the only test of this file: what another one allocated meanwhile would be counted.
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
            before = ALLOCATIONS.load(Ordering::Relaxed);
        }
        map.restart(&pixels, 1.0, 100_000);
        filter.restart_where_empty(&map);
        filter.restart_with_known(&mut map, &CandidateParams::default());
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
    let allocations = ALLOCATIONS.load(Ordering::Relaxed) - before;
    assert_eq!(allocations, 0, "in one keyframe of 4 frames");
    assert!(matched > 1000, "only {matched} matches: this measures nothing");
}
