//! The tracing of immature points, compiled for the processor's vector units.
//!
//! A single source: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::depth::immature::{ImmaturePoint, IntervalParams, TraceCounts, TraceFrame};
use crate::slam::kernel::{Body, Instructions};

/// Points that are traced one after another.
pub(super) struct Tracing<'a> {
    pub points: &'a mut [ImmaturePoint],
    pub frame: &'a TraceFrame<'a>,
    pub params: &'a IntervalParams,
}

impl Body for Tracing<'_> {
    type Output = TraceCounts;

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> TraceCounts {
        self.points.iter_mut().fold(TraceCounts::default(), |counts, point| {
            if point.is_ended() {
                return counts.plus(TraceCounts { ended: 1, ..Default::default() });
            }
            counts.plus(TraceCounts::of(point.trace(self.frame, self.params)))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::depth::epipolar::TwoView;
    use crate::slam::depth::gradient_image::GradientImage;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::image::quads::QuadImage;
    use crate::slam::kernel::Kernel;
    use crate::slam::pose::Brightness;
    use crate::slam::test_scene::{CAMERA, Scene};
    use nalgebra::Vector6;

    #[test]
    fn every_version_gives_the_same_bits() {
        let scene = Scene::new(5);
        let moved = SE3::exp(&Vector6::new(0.05, 0.01, 0.02, 0.0, 0.01, 0.0));
        let mut image = GradientImage::with_size(CAMERA.width, CAMERA.height);
        image.fill(&scene.render(&CAMERA, &SE3::identity()).noisy(2.0, 1));
        let mut frame = QuadImage::with_size(CAMERA.width, CAMERA.height);
        frame.fill(&scene.render(&CAMERA, &moved).noisy(2.0, 2));
        let view = TwoView::new(&CAMERA, &moved.inverse());
        let frame = TraceFrame { image: &frame, view, brightness: Brightness { a: 0.02, b: -1.0 } };
        let pixels = (20..220).step_by(3).flat_map(|v| (20..300).step_by(5).map(move |u| (u, v)));
        let mut portable: Vec<_> =
            pixels.filter_map(|(u, v)| ImmaturePoint::new(&image, u, v)).collect();
        let mut fast = portable.clone();
        let params = IntervalParams::default();
        for _ in 0..2 {
            let trace = |kernel: Kernel, points| {
                kernel.run(Tracing { points, frame: &frame, params: &params })
            };
            let counts = trace(Kernel::Portable, &mut portable);
            assert_eq!(trace(Kernel::fastest(), &mut fast), counts);
        }
        let bits = |p: &ImmaturePoint| {
            let max = p.max_inverse_depth.map(f32::to_bits);
            (p.status, p.min_inverse_depth.to_bits(), max, p.quality.to_bits())
        };
        assert!(portable.iter().filter(|p| p.max_inverse_depth.is_some()).count() > 300);
        assert!(portable.iter().map(bits).eq(fast.iter().map(bits)));
    }
}
