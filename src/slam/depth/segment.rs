//! The search for a pattern on a segment of its epipolar line: 1-px steps, then Gauss–Newton along it.

use crate::slam::depth::epipolar::EpipolarLine;
use crate::slam::depth::matching::{MAX_STEPS, PATTERN, sum};
use crate::slam::image::quads::QuadImage;

/// The part of an epipolar line to be searched.
pub(super) struct Segment {
    /// The whole line.
    pub(super) line: EpipolarLine,
    /// Its far end, pixels.
    pub(super) start: (f32, f32),
    /// Unit vector towards larger inverse depth.
    pub(super) direction: (f32, f32),
    /// Pixels.
    pub(super) length: f32,
    /// Pattern offsets in the frame.
    pub(super) offsets_u: [f32; 8],
    pub(super) offsets_v: [f32; 8],
    /// Inverse of the 2×2 that turned them.
    pub(super) inverse_warp: [f32; 4],
}

impl Segment {
    /// The place `lambda` pixels from the start.
    #[inline(always)]
    pub(super) fn at(&self, lambda: f32) -> (f32, f32) {
        (self.start.0 + lambda * self.direction.0, self.start.1 + lambda * self.direction.1)
    }
}

/// The best match on a segment.
pub(super) struct Found {
    /// Where, pixels from the segment's start.
    pub(super) lambda: f32,
    /// What it costs there.
    pub(super) energy: f32,
    /// Energy of the second minimum over that of the best.
    pub(super) quality: f32,
    /// Places tried.
    pub(super) steps: usize,
}

/// Searches at 1-px steps and refines by Gauss–Newton.
#[inline(always)]
pub(super) fn search(image: &QuadImage, segment: &Segment, patch: &[f32; 8], dither: f32) -> Found {
    /// Steps this near to the best belong to the same minimum.
    const SAME_MINIMUM_STEPS: usize = 2;
    let steps = ((segment.length + dither).ceil() as usize + 1).min(MAX_STEPS - 1);
    let mut energies = [f32::INFINITY; MAX_STEPS];
    let mut best = 0;
    for step in 0..steps {
        energies[step] = energy(image, segment, patch, step as f32 - dither);
        if energies[step] < energies[best] {
            best = step;
        }
    }
    let second = energies[..steps]
        .iter()
        .enumerate()
        .filter(|(step, _)| step.abs_diff(best) > SAME_MINIMUM_STEPS)
        .fold(f32::INFINITY, |least, (_, &e)| least.min(e));
    /// Energies below one squared grey level are rounding.
    const LEAST_ENERGY: f32 = 1.0;
    let quality = second / energies[best].max(LEAST_ENERGY);
    let (lambda, energy) = refine(image, segment, patch, best as f32 - dither, energies[best]);
    Found { lambda, energy, quality, steps }
}

/// At most three Gauss–Newton steps along the line; a step that raises the energy is halved and taken
/// from where it started.
#[inline(always)]
fn refine(
    image: &QuadImage,
    segment: &Segment,
    patch: &[f32; 8],
    lambda: f32,
    start_energy: f32,
) -> (f32, f32) {
    const MAX_ITERATIONS: usize = 3;
    const MAX_STEP_PX: f32 = 0.5;
    /// Smaller steps are far below the error that is claimed.
    const CONVERGED_PX: f32 = 0.1;
    let mut best = (lambda, start_energy);
    let mut share = 1.0;
    for _ in 0..MAX_ITERATIONS {
        let step = gauss_newton_step(image, segment, patch, best.0);
        let step = share * step.clamp(-MAX_STEP_PX, MAX_STEP_PX);
        let candidate = best.0 + step;
        let energy = energy(image, segment, patch, candidate);
        if energy < best.1 {
            best = (candidate, energy);
        } else {
            share *= 0.5;
        }
        if !(step.abs() >= CONVERGED_PX) {
            break;
        }
    }
    best
}

/// The Gauss–Newton step of the Huber energy along the line.
#[inline(always)]
fn gauss_newton_step(image: &QuadImage, segment: &Segment, patch: &[f32; 8], lambda: f32) -> f32 {
    let here = samples(image, segment, lambda);
    let (ahead, behind) =
        (samples(image, segment, lambda + 1.0), samples(image, segment, lambda - 1.0));
    let (mut gradients, mut informations) = ([0.0; 8], [0.0; 8]);
    for k in 0..PATTERN.len() {
        let slope = 0.5 * (ahead[k] - behind[k]);
        let residual = here[k] - patch[k];
        let weight = HUBER_GREY / residual.abs().max(HUBER_GREY);
        gradients[k] = weight * slope * residual;
        informations[k] = weight * slope * slope;
    }
    -sum(&gradients) / (sum(&informations) + f32::MIN_POSITIVE)
}

/// Residuals beyond this many grey levels grow linearly.
const HUBER_GREY: f32 = 9.0;

/// Σ ρ(residual) of the pattern, ρ(r) = r² up to [`HUBER_GREY`], linear beyond.
#[inline(always)]
fn energy(image: &QuadImage, segment: &Segment, patch: &[f32; 8], lambda: f32) -> f32 {
    let samples = samples(image, segment, lambda);
    let mut energies = [0.0; 8];
    for k in 0..PATTERN.len() {
        let residual = samples[k] - patch[k];
        // 1 up to the bound, without a branch, so that the lanes go together.
        let weight = HUBER_GREY / residual.abs().max(HUBER_GREY);
        energies[k] = weight * (2.0 - weight) * residual * residual;
    }
    sum(&energies)
}

/// The frame at the pattern, `lambda` pixels along the segment.
#[inline(always)]
fn samples(image: &QuadImage, segment: &Segment, lambda: f32) -> [f32; 8] {
    let (u, v) = segment.at(lambda);
    image.sample(&segment.offsets_u.map(|offset| u + offset), &segment.offsets_v.map(|o| v + o))
}
