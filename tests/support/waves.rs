//! Smooth waves on a wall at depth 1: frames that can be tracked, and a keyframe of the wall.

use semidense::service::clock::{now_nanos, realtime_of};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::wire::message::FrameHeader;

/// The camera that sees them.
pub const CAMERA: Intrinsics = Intrinsics::pinhole(320, 240, 260.0);

/// The header of a frame that is sent now.
pub fn header(sequence: u64) -> FrameHeader {
    let now = now_nanos();
    FrameHeader {
        sequence,
        capture_nanos: now,
        clock_nanos: now,
        realtime_nanos: realtime_of(now),
        sent_nanos: now,
        exposure_nanos: 0,
        intrinsics: [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
        width: CAMERA.width as u32,
        height: CAMERA.height as u32,
        stride: CAMERA.width as u32,
        gain: 0.0,
    }
}

/// The waves, shifted by `shift` pixels.
pub fn image(shift: f64) -> Vec<u8> {
    let grey = |u: usize, v: usize| {
        let (u, v) = (u as f64 - shift, v as f64);
        128.0 + 40.0 * (u * 0.19).sin() * (v * 0.13).cos() + 30.0 * (0.07 * u + 0.11 * v).sin()
    };
    (0..CAMERA.width * CAMERA.height)
        .map(|i| grey(i % CAMERA.width, i / CAMERA.width) as u8)
        .collect()
}

/// A keyframe with depth at every pixel.
pub fn keyframe(keyframe_id: u64) -> Keyframe {
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
        revision: keyframe_id,
        ..Keyframe::at(Sim3::identity(), CAMERA, points.collect(), image)
    }
}
