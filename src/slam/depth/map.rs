//! The semi-dense inverse-depth map of one keyframe: the image with its gradients, and a hypothesis
//! at every pixel that has one.

use rayon::prelude::*;

use crate::slam::depth::matching::PATTERN;
use crate::slam::image::buffer::Image;

/// Pixels nearer to the border than this carry no depth: the matching pattern reaches 2 pixels, its
/// gradients 1, and a bilinear sample 1 more.
pub const BORDER_PX: usize = 4;

/// Rows that a thread takes at least, where a row is cheap: waking another thread costs as much as
/// thousands of pixels.
pub(super) const BAND_ROWS: usize = 60;

/// A keyframe's image with its gradients, level 0.
#[derive(Debug, Clone)]
pub struct GradientImage {
    /// Brightness, 0 to 255.
    pub intensity: Image<f32>,
    /// ∂I/∂u by central difference, grey levels a pixel; 0 on the border.
    pub gradient_u: Image<f32>,
    /// ∂I/∂v by central difference, grey levels a pixel; 0 on the border.
    pub gradient_v: Image<f32>,
}

impl GradientImage {
    /// A black image.
    pub fn with_size(width: usize, height: usize) -> Self {
        let black = Image::filled(width, height, 0.0);
        Self { intensity: black.clone(), gradient_u: black.clone(), gradient_v: black }
    }

    /// Takes the grey values of a frame of the same size and differentiates them.
    pub fn fill(&mut self, pixels: &[u8]) {
        let (width, height) = (self.intensity.width(), self.intensity.height());
        let row = |v: usize| &pixels[v * width..(v + 1) * width];
        let intensity = self.intensity.pixels_mut().par_chunks_exact_mut(width);
        let gradient_u = self.gradient_u.pixels_mut().par_chunks_exact_mut(width);
        let gradient_v = self.gradient_v.pixels_mut().par_chunks_exact_mut(width);
        let rows = intensity.zip(gradient_u).zip(gradient_v).enumerate();
        rows.with_min_len(BAND_ROWS).for_each(|(v, ((intensity, gradient_u), gradient_v))| {
            let here = row(v);
            for (out, &grey) in intensity.iter_mut().zip(here) {
                *out = f32::from(grey);
            }
            if v == 0 || v + 1 == height {
                return;
            }
            let sides = here.iter().zip(&here[2..]);
            for (out, (&left, &right)) in gradient_u[1..].iter_mut().zip(sides) {
                *out = 0.5 * (f32::from(right) - f32::from(left));
            }
            let ends = row(v - 1).iter().zip(row(v + 1)).skip(1).take(width - 2);
            for (out, (&above, &below)) in gradient_v[1..].iter_mut().zip(ends) {
                *out = 0.5 * (f32::from(below) - f32::from(above));
            }
        });
    }

    /// Takes the brightness of an image of the same size and differentiates it.
    pub fn fill_from(&mut self, image: &Image<f32>) {
        for (out, &intensity) in self.intensity.pixels_mut().iter_mut().zip(image.pixels()) {
            *out = intensity;
        }
        self.differentiate();
    }

    fn differentiate(&mut self) {
        let (width, height) = (self.intensity.width(), self.intensity.height());
        let image = self.intensity.pixels();
        for v in 1..height - 1 {
            let inner = v * width + 1..v * width + width - 1;
            for (out, i) in
                self.gradient_u.pixels_mut()[inner.clone()].iter_mut().zip(inner.clone())
            {
                *out = 0.5 * (image[i + 1] - image[i - 1]);
            }
            for (out, i) in self.gradient_v.pixels_mut()[inner.clone()].iter_mut().zip(inner) {
                *out = 0.5 * (image[i + width] - image[i - width]);
            }
        }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.intensity.width()
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.intensity.height()
    }
}

/// A Gaussian hypothesis on the inverse depth of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Inverse depth as filtered from observations, 1/keyframe units.
    pub inverse_depth: f32,
    /// Its variance; negative where the pixel has no hypothesis.
    pub variance: f32,
    /// Inverse depth smoothed over consistent neighbours: what is published and searched around.
    pub smoothed: f32,
    /// How often it was confirmed less how often it failed; at 0 it is dropped.
    pub validity: u8,
    /// Whether it came from the keyframe before and carries that keyframe's observations.
    pub propagated: bool,
    /// Failures of a pixel without hypothesis: it is tried less often the more it failed.
    pub failures: u8,
}

impl Hypothesis {
    /// No hypothesis.
    pub const NONE: Self = Self {
        inverse_depth: 0.0,
        variance: -1.0,
        smoothed: 0.0,
        validity: 0,
        propagated: false,
        failures: 0,
    };

    /// Whether there is a hypothesis.
    #[inline]
    pub fn is_some(&self) -> bool {
        self.variance >= 0.0
    }

    /// Removes the hypothesis and remembers that this pixel failed.
    #[inline]
    pub fn reject(&mut self) {
        *self = Self { failures: self.failures.saturating_add(1), ..Self::NONE };
    }
}

/// The map of one keyframe.
#[derive(Debug, Clone)]
pub struct DepthMap {
    /// The keyframe's image.
    pub image: GradientImage,
    /// A hypothesis a pixel.
    pub hypotheses: Image<Hypothesis>,
    /// Whether a pixel has enough gradient to carry depth.
    pub candidates: Image<bool>,
    /// Σ (g_u², g_u g_v, g_v²) over the matching pattern around each candidate.
    pub structure: Image<[f32; 3]>,
    /// Memory for what arrives from the keyframe before, by band of its rows.
    pub(super) arrivals: Vec<Vec<Arrival>>,
}

/// A hypothesis on its way to a pixel of this place in the image.
pub(super) type Arrival = (u32, Hypothesis);

impl DepthMap {
    /// An empty map for images of this size.
    pub fn with_size(width: usize, height: usize) -> Self {
        Self {
            image: GradientImage::with_size(width, height),
            hypotheses: Image::filled(width, height, Hypothesis::NONE),
            candidates: Image::filled(width, height, false),
            structure: Image::filled(width, height, [0.0; 3]),
            arrivals: Vec::new(),
        }
    }

    /// Starts over on a new image: no hypotheses, candidates where ‖g‖ ≥ `min_gradient`, raised
    /// evenly until at most `max_candidates` remain.
    pub fn restart(&mut self, pixels: &[u8], min_gradient: f32, max_candidates: usize) {
        self.image.fill(pixels);
        let rows = self.hypotheses.pixels_mut().par_chunks_exact_mut(self.image.width());
        rows.with_min_len(BAND_ROWS).for_each(|row| row.fill(Hypothesis::NONE));
        self.choose_candidates(min_gradient, max_candidates);
        self.sum_structure();
    }

    fn sum_structure(&mut self) {
        let width = self.image.width();
        let candidates = &self.candidates;
        let gradient_u = self.image.gradient_u.pixels();
        let gradient_v = self.image.gradient_v.pixels();
        let offsets = PATTERN.map(|(x, y)| y as isize * width as isize + x as isize);
        self.structure.pixels_mut().par_chunks_exact_mut(width).enumerate().for_each(|(v, row)| {
            for (u, structure) in row.iter_mut().enumerate().filter(|(u, _)| candidates.at(*u, v)) {
                let centre = v * width + u;
                *structure = offsets.iter().fold([0.0; 3], |[uu, uv, vv], &offset| {
                    let i = centre.wrapping_add_signed(offset);
                    let (gu, gv) = (gradient_u[i], gradient_v[i]);
                    [uu + gu * gu, uv + gu * gv, vv + gv * gv]
                });
            }
        });
    }

    fn choose_candidates(&mut self, min_gradient: f32, max_candidates: usize) {
        /// Largest ‖g‖ of an 8-bit image: ½·255 in both directions.
        const MAX_GRADIENT: f32 = 181.0;
        const BINS: usize = 1024;
        let bin = |strength: f32| ((strength / MAX_GRADIENT * BINS as f32) as usize).min(BINS - 1);
        let (width, height) = (self.image.width(), self.image.height());
        let gradient_u = self.image.gradient_u.pixels();
        let gradient_v = self.image.gradient_v.pixels();
        let strength =
            |i: usize| (gradient_u[i] * gradient_u[i] + gradient_v[i] * gradient_v[i]).sqrt();
        let inner = |v: usize| v * width + BORDER_PX..(v + 1) * width - BORDER_PX;
        let rows = BORDER_PX..height - BORDER_PX;
        let count_row = |mut histogram: [u32; BINS], v: usize| {
            for strength in inner(v).map(strength).filter(|s| *s >= min_gradient) {
                histogram[bin(strength)] += 1;
            }
            histogram
        };
        let add =
            |one: [u32; BINS], other: [u32; BINS]| std::array::from_fn(|bin| one[bin] + other[bin]);
        let rows = rows.into_par_iter().with_min_len(BAND_ROWS);
        let histogram = rows.fold(|| [0; BINS], count_row).reduce(|| [0; BINS], add);
        let mut kept = 0;
        let mut lowest = BINS;
        while lowest > 0 && kept + histogram[lowest - 1] as usize <= max_candidates {
            lowest -= 1;
            kept += histogram[lowest] as usize;
        }
        let rows = self.candidates.pixels_mut().par_chunks_exact_mut(width).enumerate();
        rows.with_min_len(BAND_ROWS).for_each(|(v, row)| {
            row.fill(false);
            if (BORDER_PX..height - BORDER_PX).contains(&v) {
                for (is_candidate, i) in row[BORDER_PX..].iter_mut().zip(inner(v)) {
                    let strength = strength(i);
                    *is_candidate = strength >= min_gradient && bin(strength) >= lowest;
                }
            }
        });
    }

    /// Place of pixel `(u, v)` in the planes.
    pub(super) fn index(&self, u: u16, v: u16) -> usize {
        usize::from(v) * self.image.width() + usize::from(u)
    }

    /// Number of hypotheses.
    pub fn num_hypotheses(&self) -> usize {
        self.hypotheses.pixels().iter().filter(|h| h.is_some()).count()
    }

    /// Mean smoothed inverse depth of the hypotheses; `None` without any.
    pub fn mean_inverse_depth(&self) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0usize);
        for h in self.hypotheses.pixels().iter().filter(|h| h.is_some()) {
            sum += f64::from(h.smoothed);
            count += 1;
        }
        (count > 0).then(|| sum / count as f64)
    }

    /// Multiplies every inverse depth by `factor` and every variance by its square.
    pub fn rescale(&mut self, factor: f32) {
        let rows = self.hypotheses.pixels_mut().par_chunks_exact_mut(self.image.width());
        rows.with_min_len(BAND_ROWS).for_each(|row| {
            for h in row.iter_mut().filter(|h| h.is_some()) {
                h.inverse_depth *= factor;
                h.smoothed *= factor;
                h.variance *= factor * factor;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_central_differences() {
        let (width, height) = (20, 16);
        let pixels: Vec<u8> =
            (0..width * height).map(|i| ((i % width) * 5 + (i / width) * 3) as u8).collect();
        let mut image = GradientImage::with_size(width, height);
        image.fill(&pixels);
        assert_eq!(image.gradient_u.at(7, 8), 5.0);
        assert_eq!(image.gradient_v.at(7, 8), 3.0);
        assert_eq!(image.gradient_u.at(0, 8), 0.0);
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
}
