//! Similarity of two images, independent of their cameras' poses: small blurred images, correlated over small shifts
//! (Klein, Murray 2008).

use crate::slam::image::NO_DATA;

/// Size of the small images.
pub(in crate::slam) const COLUMNS: usize = 32;
pub(in crate::slam) const ROWS: usize = 24;
/// Largest shift that is tried either way, pixels of the small image: 6° of a view 60° wide.
const REACH: usize = 3;
/// Columns and rows that are compared at every shift.
const INNER: [usize; 2] = [COLUMNS - 2 * REACH, ROWS - 2 * REACH];
/// The number of pixels compared.
const COUNT: f32 = (INNER[0] * INNER[1]) as f32;

/// A small image.
#[derive(Debug, Clone, PartialEq)]
pub struct Appearance {
    greys: Vec<f32>,
    /// `greys` without their slow variation over the image.
    details: Vec<f32>,
}

impl Appearance {
    /// Computes the appearance of a row-major image, with the mean grey where it has no data; `None` where it is too small or `pixels` does not match its size.
    pub fn of(pixels: &[u8], width: usize, height: usize) -> Option<Self> {
        if width < COLUMNS || height < ROWS || pixels.len() != width * height {
            return None;
        }
        let mut greys = Vec::with_capacity(COLUMNS * ROWS);
        for row in 0..ROWS {
            let rows = row * height / ROWS..(row + 1) * height / ROWS;
            for column in 0..COLUMNS {
                let columns = column * width / COLUMNS..(column + 1) * width / COLUMNS;
                let lines = rows.clone().map(|v| &pixels[v * width..][columns.clone()]);
                let [mut sum, mut count] = [0u32; 2];
                for &grey in lines.flatten() {
                    sum += u32::from(grey);
                    count += u32::from(grey != NO_DATA);
                }
                greys.push((count > 0).then(|| sum as f32 / count as f32));
            }
        }
        Some(Self::with(blurred(&completed(greys))))
    }

    fn with(greys: Vec<f32>) -> Self {
        /// Blurs that leave only the slow variation: 1.4 pixels together, a twentieth of the image.
        const BLURS: usize = 4;
        let slow = (0..BLURS).fold(greys.clone(), |greys, _| blurred(&greys));
        let details = greys.iter().zip(&slow).map(|(grey, slow)| grey - slow).collect();
        Self { greys, details }
    }

    /// This image from another viewpoint: `seen_at` gives the pixel of this image that shows what a pixel from there
    /// shows. Where it is none of them, the mean grey lowers the similarity to anything.
    pub(in crate::slam) fn resampled(&self, seen_at: impl Fn(usize) -> usize) -> Self {
        let grey = |pixel| self.greys.get(seen_at(pixel)).copied();
        Self::with(completed((0..COLUMNS * ROWS).map(grey).collect()))
    }

    /// Fine detail, row-major: light and large surfaces are removed, so that it tells apart views that share little.
    pub(in crate::slam) fn details(&self) -> &[f32] {
        &self.details
    }

    /// Correlation at the best shift, −1 to 1, invariant to brightness and contrast; −1 where either image has no
    /// contrast.
    pub fn similarity(&self, other: &Self) -> f32 {
        let mut inner: Vec<f32> = self.part([REACH, REACH]).flatten().copied().collect();
        let mean = inner.iter().sum::<f32>() / COUNT;
        inner.iter_mut().for_each(|grey| *grey -= mean);
        let variance = inner.iter().map(|grey| grey * grey).sum::<f32>() / COUNT;
        let places = (0..=2 * REACH).flat_map(|y| (0..=2 * REACH).map(move |x| [x, y]));
        places.map(|at| correlation(&inner, variance, other.part(at))).fold(-1.0, f32::max)
    }

    /// Rows of the inner-sized part that begins at column `x` and row `y`.
    fn part(&self, [x, y]: [usize; 2]) -> impl Iterator<Item = &[f32]> + Clone {
        let rows = self.greys[COLUMNS * y..].chunks_exact(COLUMNS).take(INNER[1]);
        rows.map(move |row| &row[x..x + INNER[0]])
    }
}

/// The mean grey in place of what is missing.
fn completed(greys: Vec<Option<f32>>) -> Vec<f32> {
    let count = greys.iter().flatten().count().max(1);
    let mean = greys.iter().flatten().sum::<f32>() / count as f32;
    greys.into_iter().map(|grey| grey.unwrap_or(mean)).collect()
}

/// Blurs with the weights (1, 2, 1) / 4 along rows and along columns.
fn blurred(greys: &[f32]) -> Vec<f32> {
    let of = |greys: &[f32], at: [usize; 2], step: [usize; 2]| {
        let grey = |x: usize, y: usize| greys[y.min(ROWS - 1) * COLUMNS + x.min(COLUMNS - 1)];
        let [x, y] = at;
        let before = grey(x.saturating_sub(step[0]), y.saturating_sub(step[1]));
        0.25 * (before + 2.0 * grey(x, y) + grey(x + step[0], y + step[1]))
    };
    let pass = |greys: &[f32], step: [usize; 2]| -> Vec<f32> {
        (0..COLUMNS * ROWS).map(|k| of(greys, [k % COLUMNS, k / COLUMNS], step)).collect()
    };
    pass(&pass(greys, [1, 0]), [0, 1])
}

/// Correlation of greys of mean 0 and this variance with rows of another image; −1 where either has no contrast.
fn correlation<'a>(centred: &[f32], variance: f32, rows: impl Iterator<Item = &'a [f32]>) -> f32 {
    /// Variance, grey levels², up to which an image has too little contrast to compare.
    const MIN_VARIANCE: f32 = 1.0;
    let [mut sum, mut squares, mut common] = [0.0f32; 3];
    for (ours, theirs) in centred.chunks_exact(INNER[0]).zip(rows) {
        for (a, b) in ours.iter().zip(theirs) {
            sum += b;
            squares += b * b;
            common += a * b;
        }
    }
    let variance_of_other = squares / COUNT - (sum / COUNT) * (sum / COUNT);
    match variance.min(variance_of_other) > MIN_VARIANCE {
        true => common / COUNT / (variance * variance_of_other).sqrt(),
        false => -1.0,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn seen(twist: [f64; 6], seed: u64) -> Appearance {
        let view = Scene::new(3).render(&CAMERA, &SE3::exp(&Vector6::from(twist)));
        Appearance::of(&view.noisy(2.0, seed), CAMERA.width, CAMERA.height).unwrap()
    }

    #[test]
    fn a_view_is_similar_after_a_small_turn_and_in_other_light() {
        let here = seen([0.0; 6], 1);
        let turned = seen([0.05, 0.0, 0.1, 0.05, 0.06, 0.02], 2);
        let elsewhere = seen([0.0, 0.0, 0.0, 0.0, 1.5, 0.0], 3);
        assert!(here.similarity(&turned) > 0.8, "{}", here.similarity(&turned));
        assert!(here.similarity(&elsewhere) < 0.7, "{}", here.similarity(&elsewhere));
        let darker = Appearance::with(here.greys.iter().map(|grey| 0.4 * grey + 9.0).collect());
        assert!(here.similarity(&darker) > 0.999);
    }

    #[test]
    fn a_uniform_image_matches_nothing_and_an_invalid_one_has_no_appearance() {
        let wall = Appearance::of(&[70; 100 * 80], 100, 80).unwrap();
        assert_eq!(wall.similarity(&wall), -1.0);
        assert_eq!(Appearance::of(&[0; 20 * 80], 20, 80), None);
        assert_eq!(Appearance::of(&[0; 99], 100, 80), None);
    }

    #[test]
    fn what_a_mask_hides_makes_no_views_similar() {
        let hide = |mut image: Vec<u8>| {
            let half = image.len() / 2;
            image[half..].fill(NO_DATA);
            Appearance::of(&image, CAMERA.width, CAMERA.height).unwrap()
        };
        let view = |twist: [f64; 6], seed| {
            Scene::new(3).render(&CAMERA, &SE3::exp(&Vector6::from(twist))).noisy(2.0, seed)
        };
        let here = hide(view([0.0; 6], 1));
        let turned = hide(view([0.0, 0.0, 0.0, 0.0, 0.06, 0.0], 2));
        let elsewhere = hide(view([0.0, 0.0, 0.0, 0.0, 1.5, 0.0], 3));
        assert!(here.similarity(&turned) > 0.8, "{}", here.similarity(&turned));
        assert!(here.similarity(&elsewhere) < 0.7, "{}", here.similarity(&elsewhere));
    }
}
