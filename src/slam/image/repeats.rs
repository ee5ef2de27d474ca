//! Recognises frames that repeat the image before them, as in a video that was converted to a higher rate: bit for bit,
//! or nearly, where it was compressed again.

use crate::slam::image::sums::{SumPyramid, grey_per_sum};

/// Level that is compared, or the coarsest: noise of single pixels averages out in its blocks of 8×8.
const LEVEL: usize = 3;

/// Largest change of a repeated image, mean over blocks, grey levels: what noise of 3.5 grey levels, different in every
/// image, leaves. H.264 leaves up to 0.2; a hand-held camera's least change in 1349 frames was 0.5.
const MAX_CHANGE: f64 = 0.5;

/// … and as a share of the least of the last changes. H.264 leaves up to 0.04; a frame of that camera changed by 0.095 of
/// the change before it.
const MAX_CHANGE_RATIO: f64 = 0.1;

/// Number of those: a flash is two.
const NUM_CHANGES: usize = 3;

/// Most frames in a row that repeat an image nearly: as many as in a video at three times its rate. After them the camera
/// rests.
const MAX_NEAR_REPEATS: u32 = 2;

/// What a frame shows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Shown {
    /// Another image than the frames before it.
    #[default]
    New,
    /// The same image.
    Repeat,
    /// Nearly the same, once more than a video of a moving camera would repeat it: the camera rests.
    Rest,
}

impl Shown {
    /// Whether it shows another image.
    pub fn is_new(self) -> bool {
        self == Self::New
    }
}

/// The last image that repeats none, to which frames are compared.
#[derive(Debug, Default)]
pub struct Repeats {
    blocks: Vec<u16>,
    /// By how much each of the last images differed from the one before it, grey levels; the newest last.
    changes: [Option<f64>; NUM_CHANGES],
    /// Number of frames since that repeat it nearly.
    near_repeats: u32,
    /// What the last frame shows.
    shown: Shown,
    /// Set while the last frame is taken again.
    pub is_paused: bool,
}

impl Repeats {
    /// Levels of a pyramid that are needed.
    pub const NUM_LEVELS: usize = LEVEL + 1;

    /// With memory for frames of the size of `pyramid`.
    pub fn with_size_of(pyramid: &SumPyramid) -> Self {
        let (_, blocks) = compared(pyramid);
        Self { blocks: Vec::with_capacity(blocks.len()), ..Self::default() }
    }

    /// Takes the next frame; returns what it shows.
    pub fn observe(&mut self, pyramid: &SumPyramid) -> Shown {
        if !self.is_paused {
            self.shown = self.compare(pyramid);
        }
        self.shown
    }

    /// What the last frame shows.
    pub fn shown(&self) -> Shown {
        self.shown
    }

    fn compare(&mut self, pyramid: &SumPyramid) -> Shown {
        let (level, blocks) = compared(pyramid);
        let sums = mean_difference(&self.blocks, blocks);
        let change = sums.map(|sums| sums * f64::from(grey_per_sum(level)));
        if change == Some(0.0) {
            return Shown::Repeat;
        }
        let least = self.changes.iter().flatten().copied().fold(f64::INFINITY, f64::min);
        let most = MAX_CHANGE.min(MAX_CHANGE_RATIO * least);
        let is_near = change.is_some_and(|change| change <= most);
        if is_near && self.near_repeats < MAX_NEAR_REPEATS {
            self.near_repeats += 1;
            return Shown::Repeat;
        }
        self.blocks.clear();
        self.blocks.extend_from_slice(blocks);
        self.near_repeats = 0;
        // A repeat that was not recognised, as after a rest, would keep the next ones from being so.
        let last = self.changes[NUM_CHANGES - 1].unwrap_or(0.0);
        let is_step = |change: f64| change > MAX_CHANGE.min(MAX_CHANGE_RATIO * last);
        if is_near || change.is_none_or(is_step) {
            self.changes.rotate_left(1);
            self.changes[NUM_CHANGES - 1] = change;
        }
        if is_near { Shown::Rest } else { Shown::New }
    }
}

/// The level that is compared, and its blocks.
fn compared(pyramid: &SumPyramid) -> (usize, &[u16]) {
    let Some(coarsest) = pyramid.num_levels().checked_sub(1) else { return (0, &[]) };
    let level = LEVEL.min(coarsest);
    (level, pyramid.level(level).pixels())
}

/// Mean absolute difference of the blocks with data; `None` where there are none.
fn mean_difference(one: &[u16], other: &[u16]) -> Option<f64> {
    if one.len() != other.len() {
        return None;
    }
    let (mut sum, mut count) = (0, 0);
    for (&one, &other) in one.iter().zip(other) {
        sum += u64::from(one.abs_diff(other));
        count += u64::from(one.max(other) > 0);
    }
    (count > 0).then(|| sum as f64 / count as f64)
}

#[cfg(test)]
mod tests {
    use super::Shown::{New, Repeat, Rest};
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    /// What the frames show of a camera that is at `places` and whose images have this noise.
    fn shown(places: &[f64], noise: f64) -> Vec<Shown> {
        let scene = Scene::new(1);
        let mut pyramid =
            SumPyramid::with_size(CAMERA.width, CAMERA.height, Repeats::NUM_LEVELS, 1);
        let mut repeats = Repeats::with_size_of(&pyramid);
        let frames = places.iter().zip(0..).map(|(&x, seed)| {
            let pose = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
            pyramid.fill(&scene.render(&CAMERA, &pose).noisy(noise, seed));
            repeats.observe(&pyramid)
        });
        frames.collect()
    }

    #[test]
    fn images_of_a_doubled_or_tripled_rate_are_repeats() {
        for noise in [0.0, 2.0] {
            let doubled = [0.0, 0.0, 0.1, 0.1, 0.2, 0.2];
            assert_eq!(shown(&doubled, noise), [New, Repeat, New, Repeat, New, Repeat], "{noise}");
            let tripled = [0.0, 0.1, 0.1, 0.1, 0.2];
            assert_eq!(shown(&tripled, noise), [New, New, Repeat, Repeat, New], "{noise}");
        }
    }

    #[test]
    fn of_a_camera_that_rests_two_noisy_images_count_as_repeats_and_all_exact_ones() {
        let rests = [0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2];
        let noisy = [New, New, Repeat, Repeat, Rest, New, New, New];
        assert_eq!(shown(&rests, 2.0), noisy);
        let exact = [New, New, Repeat, Repeat, Repeat, Repeat, Repeat, New];
        assert_eq!(shown(&rests, 0.0), exact);
    }

    #[test]
    fn after_a_rest_repeats_are_recognised_again() {
        let doubled = |steps: std::ops::Range<usize>| steps.flat_map(|step| [0.1 * step as f64; 2]);
        let places: Vec<_> = [0.0; 6].into_iter().chain(doubled(1..7)).collect();
        let seen = shown(&places, 2.0);
        assert_eq!(seen[3], Rest);
        assert_eq!(seen[12..], [New, Repeat].repeat(3), "{seen:?}");
        let slow: Vec<_> = doubled(0..3).chain([0.201; 2]).chain(doubled(3..9)).collect();
        let seen = shown(&slow, 0.5);
        assert_eq!(seen[14..], [New, Repeat].repeat(3), "{seen:?}");
    }

    #[test]
    fn a_camera_that_moves_slower_and_slower_repeats_nothing() {
        let slower: Vec<_> = (0..8).map(|k| 0.2 * (1.0 - 0.3_f64.powi(k))).collect();
        assert!(shown(&slower, 0.0).iter().all(|&shown| shown == New));
    }

    #[test]
    fn after_a_flash_a_slow_camera_repeats_nothing() {
        let mut repeats = Repeats::default();
        let mut pyramid = SumPyramid::with_size(64, 64, Repeats::NUM_LEVELS, 1);
        // A step brightens a quarter of the pixels by one; step 0 is the flash.
        let seen = [1, 4, 7, 0, 8, 9, 10].map(|step: usize| {
            let mut pixels = vec![if step == 0 { 200 } else { 100 }; 64 * 64];
            pixels.iter_mut().step_by(4).for_each(|grey| *grey += step as u8);
            pyramid.fill(&pixels);
            repeats.observe(&pyramid)
        });
        assert_eq!(seen, [New; 7]);
    }

    #[test]
    fn the_change_is_that_of_the_blocks_with_data() {
        let (width, height) = (64, 64);
        for (rows, last) in [(height, Repeat), (8, New)] {
            let mut repeats = Repeats::default();
            let mut pyramid = SumPyramid::with_size(width, height, Repeats::NUM_LEVELS, 1);
            let mut seen = |grey: u8, raised: usize| {
                let mut pixels = vec![0; width * height];
                pixels[..rows * width].fill(grey);
                pixels[..raised * 8 * width].iter_mut().for_each(|grey| *grey += 1);
                pyramid.fill(&pixels);
                repeats.observe(&pyramid)
            };
            // The upper eighth brightens by one.
            let seen = [seen(100, 0), seen(150, 0), seen(150, 1)];
            assert_eq!(seen, [New, New, last], "{rows} rows");
        }
    }

    #[test]
    fn images_without_data_or_of_another_size_are_none() {
        let mut repeats = Repeats::default();
        for (side, grey) in [(64, 0), (64, 0), (64, 9), (64, 0), (32, 9), (32, 9)] {
            let mut pyramid = SumPyramid::with_size(side, side, Repeats::NUM_LEVELS, 1);
            pyramid.fill(&vec![grey; side * side]);
            let is_second = repeats.blocks.len() == 16 && grey == 9 && side == 32;
            let expected = if is_second { Repeat } else { New };
            assert_eq!(repeats.observe(&pyramid), expected, "{side} {grey}");
        }
        assert_eq!(repeats.observe(&SumPyramid::default()), New);
    }
}
