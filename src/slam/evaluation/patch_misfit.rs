//! Misfit between where the map predicts a patch and where the image shows it.
//!
//! Patches of the earlier keyframe, 5 × 5 pixels of the reduced image, are warped into the later one by the final poses
//! and their depth, and the shift with the highest normalised correlation (ZNCC) around that position is searched:
//! where poses, scales and depth agree it is zero. Gain and offset of the camera drop out. Images are reduced to about
//! 320 columns, so that neither the time nor the reach depends on the camera.

use crate::slam::evaluation::shared_view::SharedView;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;

/// Approximate number of columns of the reduced image.
const REDUCED_WIDTH: usize = 320;
/// Largest shift along each axis as a share of the image's width: 12 px of 640. Beyond, repeated texture is found as
/// often as the patch itself.
pub const REACH: f64 = 0.01875;
/// Half side of a patch, reduced pixels.
const HALF_PATCH: i32 = 2;
/// Pixels of a patch.
const PATCH: usize = 25;
/// Patches per pair: their median shift is accurate to a tenth of its value.
const PATCHES: usize = 64;
/// Points among which those with the most structure in both directions are chosen.
const CANDIDATES: usize = 400;
/// Correlation from which a patch counts as found; unrelated texture stays below in a search of this size.
const FOUND: f64 = 0.8;
/// Fewest patches for a median.
const MIN_PATCHES: usize = 16;
/// Smallest share of patches found for their shifts to mean anything; below, the reach stands in for the median.
const MIN_FOUND: f64 = 0.3;
/// Misfit of a pair of keyframes in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchMisfit {
    /// Median shift of the patches that were found, pixels of the full image; the reach of the search
    /// where hardly any was.
    pub median_px: f64,
    /// Share of the patches that were found.
    pub found: f64,
    /// Whether there are enough patches for a meaningful median.
    pub has_texture: bool,
}

/// A keyframe's image at reduced resolution.
#[derive(Debug, Clone)]
pub struct ReducedImage {
    image: Image<f32>,
    /// Side of a reduced pixel, full-resolution pixels.
    factor: usize,
    /// Largest shift, reduced pixels.
    radius: usize,
}

impl ReducedImage {
    /// Averages blocks of pixels. The image must have the size of the intrinsics.
    pub fn of(keyframe: &Keyframe) -> Self {
        let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
        let factor = ((width + REDUCED_WIDTH / 2) / REDUCED_WIDTH).max(1);
        let mut image = Image::filled(width / factor, height / factor, 0.0f32);
        let columns = image.width();
        for (index, pixel) in image.pixels_mut().iter_mut().enumerate() {
            let (u, v) = (factor * (index % columns), factor * (index / columns));
            let rows = (v..v + factor).map(|row| &keyframe.image[row * width + u..][..factor]);
            let sum: u32 = rows.flatten().map(|&value| u32::from(value)).sum();
            *pixel = sum as f32 / (factor * factor) as f32;
        }
        let radius = (REACH * columns as f64).round().max(1.0) as usize;
        Self { image, factor, radius }
    }

    /// Converts a full-resolution pixel coordinate.
    fn reduced(&self, x: f64) -> f32 {
        ((x + 0.5) / self.factor as f64 - 0.5) as f32
    }
}

/// A patch of the earlier keyframe: its pixels minus their mean, and their projections into the later one.
struct Patch {
    pixels: [f32; PATCH],
    norm: f32,
    places: [[f32; 2]; PATCH],
    structure: f32,
}

/// Measures a pair.
pub fn patch_misfit(
    view: &SharedView<'_>,
    earlier: &ReducedImage,
    later: &ReducedImage,
) -> PatchMisfit {
    let seen = view.projections(CANDIDATES).filter(|(_, projection)| projection.is_some());
    let mut patches: Vec<Patch> = seen
        .filter_map(|(point, _)| {
            let centre = [f64::from(point.u), f64::from(point.v)];
            patch(view, earlier, later, centre, f64::from(point.inverse_depth))
        })
        .collect();
    patches.sort_by(|a, b| b.structure.total_cmp(&a.structure));
    patches.truncate(PATCHES);
    let mut shifts: Vec<f64> = patches.iter().filter_map(|p| best_shift(p, later)).collect();
    let found = shifts.len() as f64 / patches.len().max(1) as f64;
    shifts.sort_by(f64::total_cmp);
    // Patches that one of the two does not see are not found either: of a good pair these are few.
    let reach_px = REACH * view.into.intrinsics.width as f64;
    let median_px = if found < MIN_FOUND { reach_px } else { shifts[shifts.len() / 2] };
    PatchMisfit { median_px, found, has_texture: patches.len() >= MIN_PATCHES }
}

/// The patch around a full-resolution pixel; `None` near the edge of either image or without structure.
fn patch(
    view: &SharedView<'_>,
    earlier: &ReducedImage,
    later: &ReducedImage,
    [u, v]: [f64; 2],
    inverse_depth: f64,
) -> Option<Patch> {
    let (mut pixels, mut places) = ([0.0; PATCH], [[0.0; 2]; PATCH]);
    let step = earlier.factor as f64;
    for (index, (pixel, place)) in pixels.iter_mut().zip(&mut places).enumerate() {
        let (column, row) = (index as i32 % 5 - HALF_PATCH, index as i32 / 5 - HALF_PATCH);
        let (u, v) = (u + step * f64::from(column), v + step * f64::from(row));
        *pixel = sample(&earlier.image, earlier.reduced(u), earlier.reduced(v))?;
        let projection = view.project(u, v, inverse_depth)?;
        *place = [later.reduced(projection.u), later.reduced(projection.v)];
        // Every shift must stay inside.
        let reach = later.radius as f32 + 1.0;
        let inside = |x: f32, side: usize| x >= reach && x < side as f32 - 1.0 - reach;
        if !(inside(place[0], later.image.width()) && inside(place[1], later.image.height())) {
            return None;
        }
    }
    let structure = smallest_eigenvalue(&pixels);
    let mean = pixels.iter().sum::<f32>() / PATCH as f32;
    pixels.iter_mut().for_each(|pixel| *pixel -= mean);
    let norm = pixels.iter().map(|pixel| pixel * pixel).sum::<f32>().sqrt();
    (structure > 0.0).then_some(Patch { pixels, norm, places, structure })
}

/// The smaller eigenvalue of Σ ∇I ∇Iᵀ: large where a shift in any direction is visible.
fn smallest_eigenvalue(pixels: &[f32; PATCH]) -> f32 {
    let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
    for row in 1..4 {
        for column in 1..4 {
            let at = 5 * row + column;
            let (x, y) = (pixels[at + 1] - pixels[at - 1], pixels[at + 5] - pixels[at - 5]);
            (a, b, c) = (a + x * x, b + x * y, c + y * y);
        }
    }
    (a + c) / 2.0 - (((a - c) / 2.0).powi(2) + b * b).sqrt()
}

/// Length of the best shift, pixels of the full image; `None` where nothing correlates.
fn best_shift(patch: &Patch, later: &ReducedImage) -> Option<f64> {
    let (side, radius) = (2 * later.radius + 1, later.radius as f64);
    let place = |index: usize| (index % side, index / side);
    let score = |index: usize| {
        let (column, row) = place(index);
        let shift = [column as f64 - radius, row as f64 - radius];
        correlation(patch, &later.image, shift.map(|x| x as f32))
    };
    let scores: Vec<f32> = (0..side * side).map(score).collect();
    let best = (0..scores.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b]))?;
    if f64::from(scores[best]) < FOUND {
        return None;
    }
    let (column, row) = place(best);
    let around = |at: usize, step: usize| match at > 0 && at + 1 < side {
        true => peak(scores[best - step], scores[best], scores[best + step]),
        false => 0.0,
    };
    let along = column as f64 - radius + around(column, 1);
    let across = row as f64 - radius + around(row, side);
    Some(later.factor as f64 * along.hypot(across))
}

/// Position of the peak of the parabola through three scores, −½ to ½.
fn peak(before: f32, at: f32, after: f32) -> f64 {
    let curvature = f64::from(before - 2.0 * at + after);
    if curvature >= 0.0 {
        return 0.0;
    }
    (0.5 * f64::from(before - after) / curvature).clamp(-0.5, 0.5)
}

/// ZNCC of a patch with the image at its projected positions, shifted.
fn correlation(patch: &Patch, image: &Image<f32>, shift: [f32; 2]) -> f32 {
    /// Avoids division by zero in a flat image, grey levels.
    const FLAT: f32 = 1e-3;
    let (mut sum, mut squared, mut product) = (0.0f32, 0.0f32, 0.0f32);
    for (pixel, place) in patch.pixels.iter().zip(&patch.places) {
        let Some(value) = sample(image, place[0] + shift[0], place[1] + shift[1]) else {
            return -1.0;
        };
        sum += value;
        squared += value * value;
        product += value * pixel;
    }
    let variance = (squared - sum * sum / PATCH as f32).max(0.0);
    product / (variance.sqrt() * patch.norm + FLAT)
}

/// Bilinear interpolation; `None` outside the image.
#[inline]
fn sample(image: &Image<f32>, u: f32, v: f32) -> Option<f32> {
    if !(u >= 0.0 && v >= 0.0) {
        return None;
    }
    let (column, row) = (u as usize, v as usize);
    let upper = column + row * image.width();
    let is_inside = column + 1 < image.width() && row + 1 < image.height();
    let pixels = image.pixels().get(upper..=upper + image.width() + 1).filter(|_| is_inside)?;
    let (du, dv) = (u - column as f32, v - row as f32);
    let above = pixels[0] + (pixels[1] - pixels[0]) * du;
    let [left, right] = [pixels[image.width()], pixels[image.width() + 1]];
    let below = left + (right - left) * du;
    Some(above + (below - above) * dv)
}
