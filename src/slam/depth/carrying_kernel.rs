//! Carrying some rows of hypotheses to the next keyframe, compiled for the vector units that the
//! processor has.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use std::ops::Range;

use crate::slam::depth::map::Reprojected;

/// What carries the hypotheses of rows.
pub(super) trait RowCarrier {
    /// Carries the hypotheses of some source rows, in their order.
    fn carry_rows(&self, rows: Range<usize>, reprojected: &mut Vec<Reprojected>);
}

/// A version of [`RowCarrier::carry_rows`].
pub(super) type CarryingKernel<C> = fn(&C, Range<usize>, &mut Vec<Reprojected>);

/// The best version for this processor.
pub(super) fn carrying_kernel<C: RowCarrier>() -> CarryingKernel<C> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return |carrier, rows, reprojected| {
            // SAFETY: the processor has AVX2, as was just asked.
            unsafe { carry_rows_avx2(carrier, rows, reprojected) }
        };
    }
    carry_rows_portable
}

/// The explanation of the others.
fn carry_rows_portable<C: RowCarrier>(
    carrier: &C,
    rows: Range<usize>,
    reprojected: &mut Vec<Reprojected>,
) {
    carrier.carry_rows(rows, reprojected)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn carry_rows_avx2<C: RowCarrier>(
    carrier: &C,
    rows: Range<usize>,
    reprojected: &mut Vec<Reprojected>,
) {
    carrier.carry_rows(rows, reprojected)
}

#[cfg(test)]
mod tests {
    use crate::slam::depth::gradient_image::BORDER_PX;
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::depth::epipolar::TwoView;
    use crate::slam::depth::map::{DepthMap, Hypothesis};
    use crate::slam::depth::propagation::{PropagationParams, Reprojection};
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    #[test]
    fn every_version_gives_the_bits_of_the_projection_of_each_pixel() {
        let scene = Scene::new(6);
        let new_from_old = SE3::exp(&Vector6::new(0.1, -0.02, 0.05, 0.01, 0.02, -0.03));
        let mut maps = [SE3::identity(), new_from_old.inverse()].map(|world_from_camera| {
            let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
            map.restart(&scene.render(&CAMERA, &world_from_camera).noisy(2.0, 1), 5.0, 100_000);
            map
        });
        let depth = scene.render(&CAMERA, &SE3::identity()).inverse_depth;
        for (i, h) in maps[0].hypotheses.pixels_mut().iter_mut().enumerate() {
            let smoothed = depth.pixels()[i];
            let known = Hypothesis { smoothed, variance: 1e-4, validity: 9, ..Hypothesis::NONE };
            *h = if i % 5 < 3 { known } else { Hypothesis::NONE };
        }
        let params = PropagationParams::default();
        let view = TwoView::new(&CAMERA, &new_from_old);
        let carrier = Reprojection::new(&maps[0], &maps[1], view, (1.02, -1.0), &params);
        let rows = BORDER_PX..CAMERA.height - BORDER_PX;
        let (mut portable, mut fast) = (Vec::new(), Vec::new());
        carry_rows_portable(&carrier, rows.clone(), &mut portable);
        carrying_kernel()(&carrier, rows.clone(), &mut fast);
        assert_eq!(portable, fast);
        // Where and with what depth each must arrive, by the geometry of a single pixel.
        let mut expected = Vec::new();
        for (u, v) in rows.flat_map(|v| (0..CAMERA.width).map(move |u| (u, v))) {
            let from = maps[0].hypotheses.at(u, v);
            let Some(at) = view.line(u as f32, v as f32).project(from.smoothed) else { continue };
            if from.is_some() {
                let index = (at.v + 0.5) as usize * CAMERA.width + (at.u + 0.5) as usize;
                expected.push((index as u32, (from.smoothed * at.depth_ratio).to_bits()));
            }
        }
        let mut expected = expected.into_iter();
        let arrived = portable.iter().map(|(index, h)| (*index, h.inverse_depth.to_bits()));
        assert!(portable.len() > 3000, "{}", portable.len());
        assert!(arrived.into_iter().all(|arrival| expected.any(|other| other == arrival)));
    }
}
