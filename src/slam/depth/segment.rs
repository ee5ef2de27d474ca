//! The segment of an epipolar line that an interval allows.

use crate::slam::depth::epipolar::EpipolarLine;
use crate::slam::depth::line_search::{Along, MAX_STEPS};
use crate::slam::image::quads::QuadImage;
use crate::slam::image::quads_kernel::Sampled;
use crate::slam::kernel::Portable;

/// The segment of an epipolar line to be searched.
pub(super) struct Segment {
    /// The whole line.
    pub(super) line: EpipolarLine,
    /// The end of smallest inverse depth, pixels.
    pub(super) start: (f32, f32),
    /// Unit vector towards larger inverse depth.
    pub(super) direction: (f32, f32),
    /// Length, pixels.
    pub(super) length: f32,
    /// Pattern offsets in the frame.
    pub(super) offsets_u: [f32; 8],
    pub(super) offsets_v: [f32; 8],
    /// Inverse of the 2×2 warp that turned them.
    pub(super) inverse_warp: [f32; 4],
}

impl Segment {
    /// The position `lambda` pixels from the start.
    #[inline(always)]
    pub(super) fn at(&self, lambda: f32) -> (f32, f32) {
        (self.start.0 + lambda * self.direction.0, self.start.1 + lambda * self.direction.1)
    }
}

/// The best match on a segment.
pub(super) struct SegmentMatch {
    /// Position, pixels from the segment's start.
    pub(super) lambda: f32,
    /// Cost there.
    pub(super) energy: f32,
    /// Energy of the second minimum over that of the best.
    pub(super) quality: f32,
    /// Number of positions tried.
    pub(super) steps: usize,
}

/// Searches a segment for the patch, starting `dither` pixels before its start.
#[inline(always)]
pub(super) fn search(
    image: &QuadImage,
    segment: &Segment,
    patch: &[f32; 8],
    dither: f32,
) -> SegmentMatch {
    /// Energies below one squared grey level are rounding error.
    const MIN_ENERGY: f32 = 1.0;
    /// Reach of the refinement, pixels: to the steps next to the best.
    const REFINE_REACH_PX: f32 = 1.5;
    let along = Along {
        frame: Sampled { image, sampler: Portable },
        intensity: patch,
        direction: segment.direction,
        u: segment.offsets_u.map(|offset| segment.start.0 + offset),
        v: segment.offsets_v.map(|offset| segment.start.1 + offset),
    };
    let steps = ((segment.length + dither).ceil() as usize + 1).min(MAX_STEPS - 1);
    let best = along.scan(-dither, steps - 1);
    let quality = best.second / best.cost.max(MIN_ENERGY);
    // The interval filter keeps no gradients of its patch: the frame's are nearly the same.
    let (lambda, energy) = along.refine(&best, |lambda| along.gradients(lambda), REFINE_REACH_PX);
    SegmentMatch { lambda, energy, quality, steps }
}
