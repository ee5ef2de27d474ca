//! Recognises frames that repeat the image before them, as in a video that was converted to a higher rate: bit for bit,
//! or nearly, where it was compressed again.

use crate::slam::image::sums::{SumPyramid, grey_per_sum};

/// Level that is compared: noise of single pixels averages out in its blocks of 8×8.
const LEVEL: usize = 3;

/// Largest change of a repeated image, mean over blocks, grey levels: what noise of 4 grey levels, added anew to every
/// pixel, leaves. H.264 leaves up to 0.2; a hand-held camera's least change in 1349 frames was 0.5.
const MAX_CHANGE: f64 = 0.5;

/// … and as a share of the change before it. H.264 leaves up to 0.04; that camera's steps shrank to 0.095 at most.
const MAX_CHANGE_RATIO: f64 = 0.1;

/// Most frames in a row that repeat an image nearly: as many as in a video at three times its rate. After them the camera
/// stands still.
const MAX_INEXACT: u32 = 2;

/// The last image that repeats none, to which frames are compared.
#[derive(Debug, Default)]
pub struct Repeats {
    blocks: Vec<u16>,
    /// By how much it differed from the one before it, grey levels.
    change: Option<f64>,
    /// Number of frames since that repeat it nearly.
    inexact: u32,
    /// Whether the last frame repeats it.
    is_repeat: bool,
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

    /// Takes the next frame; returns whether it repeats the image before it.
    pub fn observe(&mut self, pyramid: &SumPyramid) -> bool {
        if !self.is_paused {
            self.is_repeat = self.compare(pyramid);
        }
        self.is_repeat
    }

    /// Whether the last frame repeats the image before it.
    pub fn is_repeat(&self) -> bool {
        self.is_repeat
    }

    fn compare(&mut self, pyramid: &SumPyramid) -> bool {
        let (level, blocks) = compared(pyramid);
        let change =
            mean_difference(&self.blocks, blocks).map(|sum| sum * f64::from(grey_per_sum(level)));
        if change == Some(0.0) {
            return true;
        }
        let is_small = |change: f64| {
            change <= MAX_CHANGE && self.change.is_none_or(|last| change <= MAX_CHANGE_RATIO * last)
        };
        if self.inexact < MAX_INEXACT && change.is_some_and(is_small) {
            self.inexact += 1;
            return true;
        }
        self.blocks.clear();
        self.blocks.extend_from_slice(blocks);
        (self.change, self.inexact) = (change, 0);
        false
    }
}

/// The level that is compared, and its blocks.
fn compared(pyramid: &SumPyramid) -> (usize, &[u16]) {
    let Some(coarsest) = pyramid.num_levels().checked_sub(1) else { return (0, &[]) };
    let level = LEVEL.min(coarsest);
    (level, pyramid.level(level).pixels())
}

/// Mean absolute difference of the blocks that have data in both; `None` where there are none.
fn mean_difference(one: &[u16], other: &[u16]) -> Option<f64> {
    if one.len() != other.len() {
        return None;
    }
    let (mut sum, mut count) = (0, 0);
    for (&one, &other) in one.iter().zip(other) {
        let has_data = one.min(other) > 0;
        sum += if has_data { u64::from(one.abs_diff(other)) } else { 0 };
        count += u64::from(has_data);
    }
    (count > 0).then(|| sum as f64 / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    /// Which frames repeat the one before, of a camera that is at `steps` and whose images have this noise.
    fn repeats(steps: &[f64], noise: f64) -> Vec<bool> {
        let scene = Scene::new(1);
        let mut pyramid =
            SumPyramid::with_size(CAMERA.width, CAMERA.height, Repeats::NUM_LEVELS, 1);
        let mut repeats = Repeats::with_size_of(&pyramid);
        let frames = steps.iter().zip(0..).map(|(&x, seed)| {
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
            assert_eq!(
                repeats(&doubled, noise),
                [false, true, false, true, false, true],
                "{noise}"
            );
            let tripled = [0.0, 0.1, 0.1, 0.1, 0.2];
            assert_eq!(repeats(&tripled, noise), [false, false, true, true, false], "{noise}");
        }
    }

    #[test]
    fn of_a_camera_that_rests_two_noisy_images_count_as_repeats_and_all_exact_ones() {
        let rests = [0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2];
        let two = [false, false, true, true, false, false, false, false];
        assert_eq!(repeats(&rests, 2.0), two);
        assert_eq!(
            repeats(&rests, 0.0),
            rests.map(|x| x == 0.1).map({
                let mut is_first = true;
                move |at_rest| at_rest && !std::mem::take(&mut is_first)
            })
        );
    }

    #[test]
    fn a_camera_that_moves_slower_and_slower_repeats_nothing() {
        let slower: Vec<_> = (0..8).map(|k| 0.2 * (1.0 - 0.3_f64.powi(k))).collect();
        assert!(repeats(&slower, 0.0).iter().all(|is_repeat| !is_repeat));
    }

    #[test]
    fn images_without_common_data_or_of_another_size_are_none() {
        let mut repeats = Repeats::default();
        for (side, grey) in [(64, 0), (64, 0), (64, 9), (64, 0), (32, 9), (32, 9)] {
            let mut pyramid = SumPyramid::with_size(side, side, Repeats::NUM_LEVELS, 1);
            pyramid.fill(&vec![grey; side * side]);
            let is_second = repeats.blocks.len() == 16 && grey == 9 && side == 32;
            assert_eq!(repeats.observe(&pyramid), is_second, "{side} {grey}");
        }
        assert!(!repeats.observe(&SumPyramid::default()));
    }
}
