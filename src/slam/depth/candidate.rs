//! Chooses pixels worth a depth, evenly over the image: the strongest of each block where there is much texture, weaker
//! ones too where there is little (Engel, Koltun, Cremers 2018 §3.2).

use serde::{Deserialize, Serialize};

use crate::slam::depth::gradient_image::{BORDER_PX, GradientImage};
use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the choice.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CandidateParams {
    /// Number of pixels wanted. The choice exceeds it by at most a tenth; it is smaller where texture is missing.
    pub wanted: usize,
}

/// Side of the regions with separate thresholds, pixels: large against texture, small against the image.
const REGION_PX: usize = 32;
/// Required excess of a gradient over the median of its region, grey levels per pixel. The noise of a camera, 3 grey
/// levels, gives a gradient of 2.
const THRESHOLD_OFFSET: f32 = 4.0;

impl Default for CandidateParams {
    fn default() -> Self {
        Self { wanted: 2000 }
    }
}

impl CandidateParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("wanted", self.wanted, 10..=100_000)
    }
}

/// A pixel that may carry depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Candidate {
    /// Column.
    pub u: u16,
    /// Row.
    pub v: u16,
}

/// Chooses candidates; reuses its memory from image to image.
#[derive(Debug, Default)]
pub struct CandidateSelector {
    squared_gradient: Vec<f32>,
    thresholds: Vec<f32>,
    smoothed_thresholds: Vec<f32>,
    /// Regions per row.
    columns: usize,
}

/// Each octave of blocks (d, 2d, 4d) accepts this share of the previous threshold: the literature's value, weak pixels
/// only where nothing better is near.
const OCTAVE_THRESHOLD_RATIO: f32 = 0.75;
const OCTAVES: usize = 3;

impl CandidateSelector {
    /// Chooses candidates of `image` into `chosen`, block by block: the same image and parameters give the same choice.
    pub fn choose(
        &mut self,
        image: &GradientImage,
        params: &CandidateParams,
        chosen: &mut Vec<Candidate>,
    ) {
        /// Maximum number of adjustments of the block size; one usually lands within a few per cent.
        const MAX_ROUNDS: usize = 5;
        /// Relative deviation from the wanted number at which a choice is accepted.
        const TOLERANCE: f64 = 0.1;
        chosen.clear();
        let (width, height) = (image.width(), image.height());
        if width <= 2 * BORDER_PX || height <= 2 * BORDER_PX {
            return;
        }
        self.measure(image);
        let wanted = params.wanted.max(1) as f64;
        let mut block = ((width * height) as f64 / wanted).sqrt().max(1.0);
        for _ in 0..MAX_ROUNDS {
            self.choose_by_block(image, block as usize, chosen);
            let ratio = chosen.len() as f64 / wanted;
            let next = (block * ratio.sqrt()).clamp(1.0, width as f64);
            if (ratio - 1.0).abs() <= TOLERANCE || next as usize == block as usize {
                break;
            }
            block = next;
        }
        thin_out(chosen, params.wanted + params.wanted / 10);
    }

    /// Computes squared gradients, and the threshold of each region: its median gradient plus the offset, averaged with
    /// the neighbouring regions.
    fn measure(&mut self, image: &GradientImage) {
        let (width, height) = (image.width(), image.height());
        let gradients = image.gradients(0..width * height);
        self.squared_gradient.clear();
        self.squared_gradient.extend(gradients.map(|(gu, gv)| gu * gu + gv * gv));
        self.columns = width.div_ceil(REGION_PX);
        let rows = height.div_ceil(REGION_PX);
        self.thresholds.clear();
        for region in 0..rows * self.columns {
            let (left, top) =
                (region % self.columns * REGION_PX, region / self.columns * REGION_PX);
            let mut histogram = [0u32; 256];
            let mut count = 0;
            for v in top..(top + REGION_PX).min(height) {
                let row = v * width + left..v * width + (left + REGION_PX).min(width);
                for squared in &self.squared_gradient[row] {
                    histogram[(squared.sqrt() as usize).min(255)] += 1;
                    count += 1;
                }
            }
            let mut below = 0;
            let median = histogram.iter().position(|n| {
                below += n;
                2 * below >= count
            });
            self.thresholds.push(median.unwrap_or(0) as f32 + THRESHOLD_OFFSET);
        }
        self.smoothed_thresholds.clear();
        for region in 0..rows * self.columns {
            let (column, row) = (region % self.columns, region / self.columns);
            let (mut sum, mut count) = (0.0, 0.0);
            for y in row.saturating_sub(1)..(row + 2).min(rows) {
                for x in column.saturating_sub(1)..(column + 2).min(self.columns) {
                    sum += self.thresholds[y * self.columns + x];
                    count += 1.0;
                }
            }
            self.smoothed_thresholds.push(sum / count);
        }
    }

    /// Chooses the strongest pixel above its threshold in each block; where a 2×2 or 4×4 group of blocks has none, the
    /// strongest above a lower threshold.
    fn choose_by_block(&self, image: &GradientImage, block: usize, chosen: &mut Vec<Candidate>) {
        chosen.clear();
        let (width, height) = (image.width(), image.height());
        let largest = block << (OCTAVES - 1);
        for top in (BORDER_PX..height - BORDER_PX).step_by(largest) {
            for left in (BORDER_PX..width - BORDER_PX).step_by(largest) {
                self.choose_in(image, left, top, block, OCTAVES - 1, chosen);
            }
        }
    }

    /// Chooses in one block of the given octave; returns whether any pixel was chosen.
    fn choose_in(
        &self,
        image: &GradientImage,
        left: usize,
        top: usize,
        block: usize,
        octave: usize,
        chosen: &mut Vec<Candidate>,
    ) -> bool {
        let (width, height) = (image.width(), image.height());
        if left >= width - BORDER_PX || top >= height - BORDER_PX {
            return false;
        }
        if octave > 0 {
            let half = block << (octave - 1);
            let mut any = false;
            for (x, y) in [(0, 0), (half, 0), (0, half), (half, half)] {
                any |= self.choose_in(image, left + x, top + y, block, octave - 1, chosen);
            }
            if any {
                return true;
            }
        }
        let side = block << octave;
        let share = OCTAVE_THRESHOLD_RATIO.powi(octave as i32);
        let mut best = None;
        let mut strongest = 0.0;
        for v in top..(top + side).min(height - BORDER_PX) {
            for u in left..(left + side).min(width - BORDER_PX) {
                let squared = self.squared_gradient[v * width + u];
                let threshold = share * self.threshold(u, v);
                if squared > strongest && squared > threshold * threshold {
                    strongest = squared;
                    best = Some(Candidate { u: u as u16, v: v as u16 });
                }
            }
        }
        chosen.extend(best);
        best.is_some()
    }

    fn threshold(&self, u: usize, v: usize) -> f32 {
        self.smoothed_thresholds[v / REGION_PX * self.columns + u / REGION_PX]
    }
}

/// Keeps `most` of the candidates, evenly spaced in the list.
fn thin_out(chosen: &mut Vec<Candidate>, most: usize) {
    let all = chosen.len();
    if all <= most {
        return;
    }
    for i in 0..most {
        chosen[i] = chosen[i * all / most];
    }
    chosen.truncate(most);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn choose(pixels: &[u8], wanted: usize) -> Vec<Candidate> {
        let mut image = GradientImage::with_size(CAMERA.width, CAMERA.height);
        image.fill(pixels);
        let mut chosen = Vec::new();
        let params = CandidateParams { wanted };
        CandidateSelector::default().choose(&image, &params, &mut chosen);
        chosen
    }

    #[test]
    fn the_wanted_number_is_met_and_spread_over_the_image() {
        let pixels = Scene::new(1).render(&CAMERA, &SE3::identity()).noisy(2.0, 1);
        for wanted in [200, 1000, 3000] {
            let chosen = choose(&pixels, wanted);
            assert!(chosen.len() * 10 >= wanted * 8 && chosen.len() * 10 <= wanted * 11);
            let mut cells = [0usize; 16];
            for c in &chosen {
                cells[usize::from(c.v) * 4 / CAMERA.height * 4
                    + usize::from(c.u) * 4 / CAMERA.width] += 1;
            }
            let least = cells.iter().min().unwrap();
            assert!(least * 16 * 3 >= chosen.len(), "{cells:?}");
        }
    }

    #[test]
    fn weak_texture_is_chosen_where_nothing_better_is_near() {
        // Left half strong, right half a tenth of it.
        let strong = Scene::new(2).render(&CAMERA, &SE3::identity()).noisy(0.0, 1);
        let pixels: Vec<u8> = strong
            .iter()
            .enumerate()
            .map(|(i, &g)| if i % CAMERA.width < 160 { g } else { 115 + g / 10 })
            .collect();
        let chosen = choose(&pixels, 1000);
        let weak = chosen.iter().filter(|c| c.u > 165).count();
        assert!(weak * 10 > chosen.len(), "{weak} of {}", chosen.len());
    }

    #[test]
    fn a_blank_image_gives_none_and_no_pixel_is_chosen_twice() {
        assert!(choose(&vec![128; CAMERA.width * CAMERA.height], 500).is_empty());
        let pixels = Scene::new(3).render(&CAMERA, &SE3::identity()).noisy(3.0, 2);
        let mut chosen: Vec<_> = choose(&pixels, 5000).iter().map(|c| (c.v, c.u)).collect();
        let all = chosen.len();
        chosen.sort_unstable();
        chosen.dedup();
        assert_eq!(chosen.len(), all);
    }
}
