//! The input of the alignment: waves of every length, and a keyframe that shows them.

use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS};

/// Common camera sizes: VGA, EuRoC, HD.
pub const SIZES: [(usize, usize); 3] = [(640, 480), (752, 480), (1280, 720)];

/// Every fifth pixel has depth, 61 000 at 640×480, or fewer where that exceeds the capacity of a keyframe.
const PIXELS_PER_POINT: usize = 5;

pub fn camera((width, height): (usize, usize)) -> Intrinsics {
    let focal = 0.82 * width as f64;
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    Intrinsics { fx: focal, fy: focal, cx, cy, width, height }
}

/// Waves of every length with noise, shifted by `shift` pixels.
pub fn image(camera: &Intrinsics, shift: f64) -> Vec<u8> {
    let mut seed = 1u32;
    let mut grey = |u: usize, v: usize| {
        let (u, v) = (u as f64 - shift, v as f64);
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let noise = f64::from(seed >> 24) / 64.0 - 2.0;
        let coarse = 45.0 * (0.031 * u + 0.4).sin() * (0.027 * v).cos();
        let fine = 35.0 * (0.23 * u + 0.05 * v).sin() * (0.19 * v - 0.03 * u).sin();
        (128.0 + coarse + fine + noise) as u8
    };
    let (width, height) = (camera.width, camera.height);
    (0..width * height).map(|i| grey(i % width, i / width)).collect()
}

pub fn keyframe(camera: &Intrinsics) -> Keyframe {
    let image = image(camera, 0.0);
    let width = camera.width;
    let step = PIXELS_PER_POINT.max(image.len().div_ceil(MAX_KEYFRAME_POINTS));
    let points = (0..image.len()).step_by(step).map(|i| DepthPoint {
        u: (i % width) as u16,
        v: (i / width) as u16,
        inverse_depth: 1.0,
        variance: 1e-3,
        intensity: f32::from(image[i]),
    });
    Keyframe::at(Sim3::identity(), *camera, points.collect(), image)
}

/// Frame `sequence` of a recording at 30 Hz.
pub fn frame<'a>(sequence: u64, camera: &Intrinsics, pixels: &'a [u8]) -> FrameView<'a> {
    FrameView::new(camera, sequence, sequence as i64 * 33_000_000, pixels)
}
