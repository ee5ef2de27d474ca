//! The semi-dense inverse-depth map of one keyframe: the image with its gradients, and a hypothesis at every pixel that
//! has one.

use rayon::prelude::*;

use crate::slam::depth::gradient_image::{BAND_ROWS, BORDER_PX, GradientImage};
use crate::slam::depth::hypotheses::Hypotheses;
pub use crate::slam::depth::hypotheses::Hypothesis;
use crate::slam::depth::pattern::PATTERN;
use crate::slam::image::buffer::Image;

/// Largest ‖g‖ of an 8-bit image: ½·255 in both directions.
const MAX_GRADIENT: f32 = 181.0;
/// Bins of gradient strength, by which candidates are thinned out.
const BINS: usize = 1024;

/// Position of a gradient of `strength` among the [`BINS`]; its integer part is the bin.
#[inline(always)]
fn bin(strength: f32) -> f32 {
    strength / MAX_GRADIENT * BINS as f32
}

/// Pixels whose structure is summed at once.
const LANES: usize = 8;

/// Σ (g_u², g_u g_v, g_v²) over the pattern around [`LANES`] pixels starting at `first`, by quantity.
#[inline(always)]
fn structure_of_block(image: &GradientImage, first: usize) -> [[f32; LANES]; 3] {
    let [mut uu, mut uv, mut vv] = [[0.0f32; LANES]; 3];
    for (x, y) in PATTERN {
        let from = first.wrapping_add_signed(y as isize * image.width() as isize + x as isize);
        for (k, (gu, gv)) in image.gradients(from..from + LANES).enumerate() {
            uu[k] += gu * gu;
            uv[k] += gu * gv;
            vv[k] += gv * gv;
        }
    }
    [uu, uv, vv]
}

/// The map of one keyframe.
#[derive(Debug, Clone)]
pub struct DepthMap {
    /// The keyframe's image.
    pub image: GradientImage,
    /// One hypothesis per pixel.
    pub hypotheses: Hypotheses,
    /// Whether a pixel has enough gradient to carry depth.
    pub candidates: Image<bool>,
    /// Σ (g_u², g_u g_v, g_v²) over the matching pattern around each candidate and each hypothesis that was restored;
    /// of another image, or zero, in maps that depth is only propagated to or from.
    pub structure: Image<[f32; 3]>,
    /// Memory for the hypotheses that arrive from the previous keyframe, by band of its rows.
    pub(super) reprojected: Vec<Vec<Reprojected>>,
}

/// A hypothesis and the index of the pixel it moves to.
pub(super) type Reprojected = (u32, Hypothesis);

impl DepthMap {
    /// An empty map for images of this size.
    pub fn with_size(width: usize, height: usize) -> Self {
        Self {
            image: GradientImage::with_size(width, height),
            hypotheses: Hypotheses::none(width, height),
            candidates: Image::filled(width, height, false),
            structure: Image::filled(width, height, [0.0; 3]),
            reprojected: Vec::new(),
        }
    }

    /// Restarts on a new image: no hypotheses, candidates where ‖g‖ ≥ `min_gradient`, which is raised for the whole
    /// image until at most `max_candidates` remain.
    pub fn restart(&mut self, pixels: &[u8], min_gradient: f32, max_candidates: usize) {
        self.restart_without_structure(pixels, min_gradient, max_candidates);
        self.sum_structure();
    }

    /// The same without the structure, which only observation needs: depth can be propagated to the map.
    pub fn restart_without_structure(
        &mut self,
        pixels: &[u8],
        min_gradient: f32,
        max_candidates: usize,
    ) {
        self.image.fill(pixels);
        let rows = self.hypotheses.pixels_mut().par_chunks_exact_mut(self.image.width());
        rows.with_min_len(BAND_ROWS).for_each(|row| row.fill(Hypothesis::NONE));
        self.choose_candidates(min_gradient, max_candidates);
    }

    /// Sums the structure around all candidates and hypotheses.
    pub(in crate::slam) fn sum_structure(&mut self) {
        let (width, height) = (self.image.width(), self.image.height());
        let (candidates, hypotheses, image) = (&self.candidates, &self.hypotheses, &self.image);
        let rows = self.structure.pixels_mut().par_chunks_exact_mut(width).enumerate();
        let inner = BORDER_PX..height - BORDER_PX;
        rows.with_min_len(BAND_ROWS).filter(|(v, _)| inner.contains(v)).for_each(|(v, row)| {
            let (candidates, hypotheses) = (candidates.row(v), hypotheses.row(v));
            for first in (BORDER_PX..width - BORDER_PX).step_by(LANES) {
                // The last block overlaps the one before it, so that it is complete.
                let first = first.min(width - BORDER_PX - LANES);
                let block = first..first + LANES;
                let is_candidate = candidates[block.clone()].iter().any(|&candidate| candidate);
                if !is_candidate && !hypotheses[block].iter().any(Hypothesis::is_some) {
                    continue;
                }
                let sums = structure_of_block(image, v * width + first);
                for (k, structure) in row[first..first + LANES].iter_mut().enumerate() {
                    *structure = sums.map(|plane| plane[k]);
                }
            }
        });
    }

    fn choose_candidates(&mut self, min_gradient: f32, max_candidates: usize) {
        let (width, height) = (self.image.width(), self.image.height());
        let image = &self.image;
        let rows = self.candidates.pixels_mut().par_chunks_exact_mut(width).enumerate();
        let enough = |strength: f32| strength >= min_gradient;
        let count = rows.with_min_len(BAND_ROWS).map(|(v, row)| {
            row.fill(false);
            if (BORDER_PX..height - BORDER_PX).contains(&v) {
                let strengths = image.strengths(v);
                let seen = strengths.zip(image.unsaturated(v));
                row[BORDER_PX..].iter_mut().zip(seen).for_each(|(c, (s, unsaturated))| {
                    *c = enough(s) & unsaturated;
                });
            }
            row.iter().map(|&candidate| usize::from(candidate)).sum::<usize>()
        });
        let count: usize = count.sum();
        if count <= max_candidates {
            return;
        }
        let histogram = self.histogram();
        let (mut kept, mut lowest) = (0, BINS);
        while lowest > 0 && kept + histogram[lowest - 1] as usize <= max_candidates {
            lowest -= 1;
            kept += histogram[lowest] as usize;
        }
        let image = &self.image;
        let lowest = lowest as f32;
        let rows = self.candidates.pixels_mut().par_chunks_exact_mut(width).enumerate();
        let inner = BORDER_PX..height - BORDER_PX;
        rows.with_min_len(BAND_ROWS).filter(|(v, _)| inner.contains(v)).for_each(|(v, row)| {
            let candidates = row[BORDER_PX..].iter_mut().zip(image.strengths(v));
            candidates.for_each(|(c, s)| *c &= bin(s) >= lowest);
        });
    }

    /// Number of candidates by strength of gradient.
    fn histogram(&self) -> [u32; BINS] {
        let (width, height) = (self.image.width(), self.image.height());
        let count_row = |mut histogram: [u32; BINS + 1], v: usize| {
            let candidates = &self.candidates.row(v)[BORDER_PX..width - BORDER_PX];
            for (&is_candidate, strength) in candidates.iter().zip(self.image.strengths(v)) {
                // Other pixels are counted too, in a separate bin, to avoid an unpredictable branch.
                let bin = (bin(strength) as usize).min(BINS - 1);
                histogram[if is_candidate { bin } else { BINS }] += 1;
            }
            histogram
        };
        type Bins = [u32; BINS + 1];
        let add = |one: Bins, other: Bins| std::array::from_fn(|bin| one[bin] + other[bin]);
        let rows = (BORDER_PX..height - BORDER_PX).into_par_iter().with_min_len(BAND_ROWS);
        let counts = rows.fold(|| [0; BINS + 1], count_row).reduce(|| [0; BINS + 1], add);
        std::array::from_fn(|bin| counts[bin])
    }

    /// Index of pixel `(u, v)` in the planes.
    pub(super) fn index(&self, u: u16, v: u16) -> usize {
        usize::from(v) * self.image.width() + usize::from(u)
    }

    /// Number of hypotheses.
    pub fn num_hypotheses(&self) -> usize {
        self.hypotheses.count()
    }

    /// Mean smoothed inverse depth of the hypotheses; `None` if there are none.
    pub fn mean_inverse_depth(&self) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0usize);
        let mut memory = Vec::new();
        for v in 0..self.image.height() {
            let (row, known) =
                (self.hypotheses.row(v), self.hypotheses.known_columns(v, &mut memory));
            count += known.len();
            known.iter().for_each(|&u| sum += f64::from(row[usize::from(u)].smoothed));
        }
        (count > 0).then(|| sum / count as f64)
    }

    /// Multiplies every inverse depth by `factor` and every variance by its square.
    pub fn rescale(&mut self, factor: f32) {
        self.rescale_by(|_, _| factor);
    }

    /// The same with a separate factor for each pixel `(u, v)`.
    pub fn rescale_by(&mut self, factor_at: impl Fn(usize, usize) -> f32 + Sync) {
        let rows = self.hypotheses.pixels_mut().par_chunks_exact_mut(self.image.width());
        rows.with_min_len(BAND_ROWS).enumerate().for_each(|(v, row)| {
            for (u, h) in row.iter_mut().enumerate().filter(|(_, h)| h.is_some()) {
                let factor = factor_at(u, v);
                h.inverse_depth *= factor;
                h.smoothed *= factor;
                h.variance *= factor * factor;
                h.independent *= factor * factor;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::depth::gain::Uncertainty;

    #[test]
    fn black_and_white_pixels_and_their_neighbours_carry_no_depth() {
        let (width, height) = (24, 16);
        let stripes = |light: u8| {
            let grey = move |i: usize| if i % width % 4 < 2 { 40 } else { light };
            (0..width * height).map(grey).collect::<Vec<u8>>()
        };
        let candidates = |pixels: &[u8]| {
            let mut map = DepthMap::with_size(width, height);
            map.restart(pixels, 5.0, usize::MAX);
            map.candidates.pixels().iter().filter(|c| **c).count()
        };
        assert!(candidates(&stripes(200)) > 50);
        assert_eq!(candidates(&stripes(255)), 0);
        let mut dark = stripes(200);
        dark[8 * width + 10] = 1;
        assert_eq!(candidates(&stripes(200)) - candidates(&dark), 5);
    }

    #[test]
    fn both_parts_of_a_variance_change_with_the_unit() {
        let mut map = DepthMap::with_size(16, 16);
        let known = Hypothesis { variance: 3.0, independent: 1.0, ..Hypothesis::NONE };
        map.hypotheses.pixels_mut()[100] = known;
        map.rescale(2.0);
        let left = map.hypotheses.pixels()[100].uncertainty();
        assert_eq!(left, Uncertainty { variance: 12.0, independent: 4.0 });
    }

    #[test]
    fn candidates_are_bounded_and_have_gradient() {
        let (width, height) = (64, 64);
        let pixels: Vec<u8> =
            (0..width * height).map(|i| ((i * i * 31 + i * 7) % 251) as u8).collect();
        let mut map = DepthMap::with_size(width, height);
        map.restart(&pixels, 5.0, 100_000);
        let all = map.candidates.pixels().iter().filter(|&&c| c).count();
        map.restart(&pixels, 5.0, 500);
        let some = map.candidates.pixels().iter().filter(|&&c| c).count();
        assert!(all > 1000 && some <= 500 && some > 100, "{all} {some}");
        assert!(!map.candidates.at(1, 30) && !map.candidates.at(30, 2));
    }

    #[test]
    fn candidates_and_structure_match_a_computation_by_pixel() {
        let (width, height) = (61, 45);
        let pixels: Vec<u8> =
            (0..width * height).map(|i| ((i * i * 31 + i * 7) % 251 + 2) as u8).collect();
        let mut map = DepthMap::with_size(width, height);
        map.restart(&pixels, 40.0, 700);
        let strength = |i: usize| {
            let (gu, gv) = map.image.gradient(i);
            (gu * gu + gv * gv).sqrt()
        };
        let weakest = |wanted: bool, worst: fn(f32, f32) -> f32, start: f32| {
            let inner = (BORDER_PX..height - BORDER_PX)
                .flat_map(|v| (BORDER_PX..width - BORDER_PX).map(move |u| v * width + u));
            let chosen = inner.filter(|&i| map.candidates.pixels()[i] == wanted);
            chosen.map(strength).fold(start, worst)
        };
        let kept = weakest(true, f32::min, f32::INFINITY);
        let left = weakest(false, f32::max, 0.0);
        assert!(kept >= 40.0 && kept > left, "{kept} {left}");
        for v in 0..height {
            for u in (0..width).filter(|&u| map.candidates.at(u, v)) {
                let mut sums = [0.0f32; 3];
                for (x, y) in PATTERN {
                    let i = (v as i32 + y) as usize * width + (u as i32 + x) as usize;
                    let (gu, gv) = map.image.gradient(i);
                    sums[0] += gu * gu;
                    sums[1] += gu * gv;
                    sums[2] += gv * gv;
                }
                assert_eq!(map.structure.at(u, v).map(f32::to_bits), sums.map(f32::to_bits));
            }
        }
    }
}
