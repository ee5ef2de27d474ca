//! Brightens the frames of a camera in dim light before anything is estimated from them.
//!
//! Thresholds on residuals and gradients are in grey levels, and an image whose contrast is as small as they are passes
//! every one of them: occlusions and wrong matches agree, and wrong poses are claimed. A factor on the grey levels gives
//! dim images the contrast of ordinary ones; their noise grows with it, to that of an ordinary camera.

/// Grey level below which 90 % of the first image lie when it is dim: a quarter of the range.
const DIM_GREY: u8 = 64;
/// The same of later images. A factor that changes within a run separates the views before and after it: with
/// [`DIM_GREY`] here, a video with dim passages has 2.6 % fewer frames tracked than with a factor of 1 throughout.
const LATER_DIM_GREY: u8 = DIM_GREY / 2;
/// Grey level below which 90 % of an image lie that has just been brightened, half of the range: enough contrast, with
/// room for light that comes into view. Noise is multiplied too: with 160, ICL office3 with an eighth of its light and a
/// noise of 8 after the factor does not start from three of four first frames.
const BRIGHTENED_GREY: u8 = 128;
/// Grey level below which 90 % of a brightened image stay, so that its bright parts are not saturated.
const BRIGHT_GREY: u8 = 224;
/// Binary logarithm of the largest factor: beyond 8 grey levels are too coarse to be tracked on.
const MAX_DOUBLINGS: u8 = 3;
/// Frames in a row that must be dim before the factor grows, 0.7 s at 30 Hz. A covered lens has passed by then, and a
/// passage into the dark has ended.
const DIM_FRAMES: u8 = 20;
/// Ratio of the mean grey levels of two images below which the exposure of a camera has settled between them. Cameras
/// settle within a second or two, by 26 % or more in [`SETTLING_FRAMES`]; a moving camera's images differ less.
const SETTLED_RATIO: f32 = 1.25;
/// Frames after which the first images are brightened although their light still changes, 2 s at 30 Hz: it is no
/// exposure that settles.
const MAX_UNSETTLED_FRAMES: u8 = 60;
/// Distance of the pixels that are measured, in columns and rows: some thousand of a VGA image.
const STEP_PX: usize = 8;

/// Frames whose first and last are compared before dim ones are brightened: a camera changes its exposure every few.
pub const SETTLING_FRAMES: usize = 6;

/// The light of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// Grey level below which 90 % of it lie.
    bright: u8,
    /// Mean grey level.
    mean: f32,
}

impl Light {
    /// The light of a row-major image with `width` columns; `None` for an image that is too small, or so dark that it
    /// shows nothing at any factor.
    pub fn of(pixels: &[u8], width: usize) -> Option<Self> {
        /// Below this, the largest factor does not reach [`DIM_GREY`].
        const MIN_USABLE_GREY: u8 = DIM_GREY >> MAX_DOUBLINGS;
        let mut counts = [0_u32; 256];
        let rows = pixels.chunks_exact(width.max(1)).skip(STEP_PX / 2).step_by(STEP_PX);
        for row in rows {
            for &grey in row.iter().skip(STEP_PX / 2).step_by(STEP_PX) {
                counts[usize::from(grey)] += 1;
            }
        }
        let measured: u32 = counts.iter().sum();
        let sum: u32 = (0..).zip(&counts).map(|(grey, count)| grey * count).sum();
        let mut brighter = measured / 10;
        let bright = (0..=u8::MAX).rev().find(|&grey| {
            let count = counts[usize::from(grey)];
            let is_reached = count > brighter;
            brighter = brighter.saturating_sub(count);
            is_reached
        })?;
        let mean = sum as f32 / measured as f32;
        (bright >= MIN_USABLE_GREY).then_some(Self { bright, mean })
    }

    /// Whether the first images of a stream are dim if one has this light.
    pub fn is_dim(&self) -> bool {
        self.bright < DIM_GREY
    }

    /// The grey level below which 90 % of it lie when it is doubled so often.
    fn brightened(&self, doublings: u8) -> u32 {
        u32::from(self.bright) << doublings
    }

    /// Whether the exposure has settled between this image and a later one.
    fn is_as_bright_as(&self, later: &Self) -> bool {
        self.mean.max(later.mean) <= SETTLED_RATIO * self.mean.min(later.mean)
    }
}

/// The factor on the grey levels of a stream of frames: 1, 2, 4 or 8. It follows lasting changes of light alone, and
/// falls at once where the image would become too bright.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Brightening {
    doublings: u8,
    /// Dim frames in a row.
    dim_frames: u8,
    /// First frames that were dim while the exposure settled.
    unsettled_frames: u8,
    has_begun: bool,
}

impl Brightening {
    /// The factor on the grey levels of the last frame.
    pub fn factor(&self) -> u8 {
        1 << self.doublings
    }

    /// Whether the light of the first frames has set the factor; until then it is 1, and [`Brightening::follow`] looks
    /// at a later frame.
    pub fn has_begun(&self) -> bool {
        self.has_begun
    }

    /// Sets the factor for the next frame, row-major with `width` columns. `later` is the light of the last of the
    /// [`SETTLING_FRAMES`] that begin with it: dim first frames are brightened once both are equally bright, since an
    /// exposure that settles would undo it step by step. A frame without any light has no effect on the factor.
    pub fn follow(&mut self, pixels: &[u8], width: usize, later: Option<Light>) {
        if let Some(light) = Light::of(pixels, width) {
            self.adapt(light, later);
        }
    }

    /// Brightens the frame.
    pub fn apply(&self, pixels: &mut [u8]) {
        if self.doublings > 0 {
            let (factor, largest) = (self.factor(), u8::MAX >> self.doublings);
            for pixel in pixels {
                // Above the largest the result is saturated.
                *pixel = if *pixel > largest { u8::MAX } else { *pixel * factor };
            }
        }
    }

    /// Adapts the factor to the light of an image.
    fn adapt(&mut self, light: Light, later: Option<Light>) {
        if !self.has_begun {
            let settled = later.is_none_or(|later| light.is_as_bright_as(&later));
            self.has_begun =
                !light.is_dim() || settled || self.unsettled_frames >= MAX_UNSETTLED_FRAMES;
            self.unsettled_frames = self.unsettled_frames.saturating_add(1);
            if self.has_begun && light.is_dim() {
                self.raise(light);
            }
            return;
        }
        while self.doublings > 0 && light.brightened(self.doublings) > u32::from(BRIGHT_GREY) {
            self.doublings -= 1;
        }
        let is_dim = light.brightened(self.doublings) < u32::from(LATER_DIM_GREY);
        self.dim_frames = if is_dim { self.dim_frames + 1 } else { 0 };
        if self.dim_frames >= DIM_FRAMES {
            self.raise(light);
            self.dim_frames = 0;
        }
    }

    /// Raises the factor as far as an image allows.
    fn raise(&mut self, light: Light) {
        while self.doublings < MAX_DOUBLINGS
            && light.brightened(self.doublings + 1) <= u32::from(BRIGHTENED_GREY)
        {
            self.doublings += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 160;

    /// An image whose grey levels rise along the rows, from 0 to `largest`.
    fn ramp(largest: usize) -> Vec<u8> {
        (0..WIDTH * 120).map(|i| ((i % WIDTH) * largest / (WIDTH - 1)) as u8).collect()
    }

    fn brightened(brightening: &mut Brightening, image: &[u8]) -> Vec<u8> {
        let mut pixels = image.to_vec();
        brightening.follow(image, WIDTH, Light::of(image, WIDTH));
        brightening.apply(&mut pixels);
        pixels
    }

    #[test]
    fn an_image_in_ordinary_light_is_left_unchanged() {
        let mut brightening = Brightening::default();
        for largest in [80, 120, 255] {
            let image = ramp(largest);
            assert_eq!(brightened(&mut brightening, &image), image);
            assert_eq!(brightening.factor(), 1);
        }
    }

    #[test]
    fn the_first_dim_image_sets_the_factor_that_its_light_requires() {
        for (largest, factor) in [(60, 2), (30, 4), (15, 8), (10, 8)] {
            let mut brightening = Brightening::default();
            let image = ramp(largest);
            let expected: Vec<u8> = image.iter().map(|grey| grey * factor).collect();
            assert_eq!(brightened(&mut brightening, &image), expected);
            assert_eq!(brightening.factor(), factor);
        }
    }

    #[test]
    fn a_black_image_stays_black_and_decides_nothing() {
        let mut brightening = Brightening::default();
        let black = vec![3; WIDTH * 120];
        for _ in 0..100 {
            assert_eq!(brightened(&mut brightening, &black), black);
        }
        assert_eq!(brightening.factor(), 1);
        brightened(&mut brightening, &ramp(30));
        assert_eq!(brightening.factor(), 4);
        // A covered lens keeps it, and the frames before and after it are equally bright.
        assert_eq!(brightened(&mut brightening, &black), [12; WIDTH * 120]);
        assert_eq!(brightening.factor(), 4);
    }

    #[test]
    fn a_short_shadow_changes_nothing_and_a_lasting_one_does() {
        let mut brightening = Brightening::default();
        let (light, shadow) = (ramp(200), ramp(30));
        brightened(&mut brightening, &light);
        for _ in 0..10 {
            for _ in 1..DIM_FRAMES {
                assert_eq!(brightened(&mut brightening, &shadow), shadow);
            }
            assert_eq!(brightened(&mut brightening, &light), light);
        }
        for _ in 1..DIM_FRAMES {
            assert_eq!(brightened(&mut brightening, &shadow), shadow);
        }
        brightened(&mut brightening, &shadow);
        assert_eq!(brightening.factor(), 4);
    }

    #[test]
    fn light_lowers_the_factor_with_its_first_image() {
        let mut brightening = Brightening::default();
        brightened(&mut brightening, &ramp(15));
        assert_eq!(brightening.factor(), 8);
        for (largest, factor) in [(40, 4), (120, 2), (255, 1), (70, 1)] {
            brightened(&mut brightening, &ramp(largest));
            assert_eq!(brightening.factor(), factor, "{largest}");
        }
    }

    #[test]
    fn highlights_of_a_dim_image_are_saturated() {
        let mut brightening = Brightening::default();
        let mut image = ramp(30);
        image[..WIDTH].fill(200);
        let pixels = brightened(&mut brightening, &image);
        assert!(pixels[..WIDTH].iter().all(|&grey| grey == u8::MAX));
        assert_eq!(pixels[WIDTH..], image[WIDTH..].iter().map(|grey| 4 * grey).collect::<Vec<_>>());
    }

    #[test]
    fn an_exposure_that_settles_is_waited_for() {
        let mut brightening = Brightening::default();
        let mut settles = |largest, later| {
            let image = ramp(largest);
            let mut pixels = image.clone();
            brightening.follow(&image, WIDTH, Light::of(&ramp(later), WIDTH));
            brightening.apply(&mut pixels);
            (pixels == image, brightening.has_begun(), brightening.factor())
        };
        // Rising and falling.
        assert_eq!(settles(20, 30), (true, false, 1));
        assert_eq!(settles(30, 20), (true, false, 1));
        assert_eq!(settles(28, 30), (false, true, 4));
        // From the first image in ordinary light on, it follows the rule for later ones.
        let mut brightening = Brightening::default();
        brightening.follow(&ramp(30), WIDTH, Light::of(&ramp(80), WIDTH));
        brightening.follow(&ramp(80), WIDTH, Light::of(&ramp(200), WIDTH));
        assert!(brightening.has_begun());
        let dim = ramp(50);
        for _ in 0..2 * DIM_FRAMES {
            assert_eq!(brightened(&mut brightening, &dim), dim);
        }
    }

    #[test]
    fn light_that_never_settles_is_brightened_in_the_end() {
        let mut brightening = Brightening::default();
        for _ in 0..MAX_UNSETTLED_FRAMES {
            brightening.follow(&ramp(30), WIDTH, Light::of(&ramp(60), WIDTH));
            assert_eq!(brightening.factor(), 1);
        }
        brightening.follow(&ramp(30), WIDTH, Light::of(&ramp(60), WIDTH));
        assert_eq!(brightening.factor(), 4);
    }

    #[test]
    fn images_of_any_size_are_accepted() {
        for (len, width) in [(0, 0), (0, 8), (1, 1), (3, 0), (30, 4), (7, 100)] {
            let mut pixels = vec![20; len];
            let mut brightening = Brightening::default();
            brightening.follow(&pixels, width, None);
            brightening.apply(&mut pixels);
            assert_eq!(pixels.len(), len);
        }
    }
}
