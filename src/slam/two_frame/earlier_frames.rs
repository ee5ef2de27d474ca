//! Earlier frames of a start, which the depths of every motion must explain as well.
//!
//! Two views of a plane are explained by two motions, with the translation and the normal of the plane exchanged
//! (Longuet-Higgins 1986), and two near views of a shallow scene nearly so. The plane of the wrong motion rotates along
//! the camera's path, the true one does not: depths found in one frame fit the others only where they are right.

use std::collections::VecDeque;

use rayon::prelude::*;

use crate::slam::image::buffer::Image;
use crate::slam::two_frame::fit::{FitInput, FitParams, FitScratch, Freedom, fit_level};
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::{System, compare};

/// Levels on which an earlier frame scores a motion, coarse to fine: motions differ by pixels, and half of the
/// resolution is a quarter of the time and memory.
const LEVELS: std::ops::RangeInclusive<usize> = 1..=2;

/// One earlier frame.
#[derive(Debug)]
struct EarlierFrame {
    /// Its images, finest kept level first.
    images: Vec<Image<f32>>,
    /// Its fit without translation: the initial value for its pose.
    rotation: State,
}

/// The latest frames before the current one.
#[derive(Debug, Default)]
pub struct EarlierFrames {
    kept: VecDeque<EarlierFrame>,
}

impl EarlierFrames {
    /// Forgets all frames.
    pub fn clear(&mut self) {
        self.kept.clear();
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Adds a frame (all its levels, and its fit without translation), keeping at most `most`.
    pub fn push(&mut self, images: &[Image<f32>], rotation: &State, most: usize) {
        while self.kept.len() >= most.max(1) {
            self.kept.pop_front();
        }
        let (finest, coarsest) = scoring_levels(images.len());
        let images = images[finest..=coarsest].to_vec();
        self.kept.push_back(EarlierFrame { images, rotation: rotation.clone() });
    }

    /// Lets the gain of all of them vary over the image.
    pub fn free_slopes(&mut self) {
        self.kept.iter_mut().for_each(|frame| frame.rotation.free_slopes());
    }

    /// Energies of the earlier frames with the depths of two motions, each frame at the pose that fits it best, over
    /// the points that both see. `input` gives points and intrinsics. The sums are in the order of the frames.
    pub fn compare(
        &self,
        input: &FitInput<'_>,
        inverse_depths: [&[f32]; 2],
        params: &FitParams,
    ) -> [f64; 2] {
        let (finest, coarsest) = scoring_levels(input.intrinsics.len());
        let fit = |frame: &EarlierFrame, inverse_depths: &[f32]| -> System {
            let input = FitInput { images: &frame.images, finest, ..*input };
            let mut state = frame.rotation.clone();
            state.inverse_depths.clear();
            state.inverse_depths.extend_from_slice(inverse_depths);
            let mut scratch = FitScratch::default();
            for level in (finest..=coarsest).rev() {
                fit_level(&input, level, Freedom::Pose, &mut state, &mut scratch, params);
            }
            scratch.system
        };
        let energies: Vec<[f64; 2]> = self
            .kept
            .par_iter()
            .map(|frame| {
                let [one, other] = inverse_depths.map(|depths| fit(frame, depths));
                compare(&one, &other)
            })
            .collect();
        energies.iter().fold([0.0, 0.0], |sum, energy| [0, 1].map(|i| sum[i] + energy[i]))
    }
}

/// Finest and coarsest of `levels` that score.
fn scoring_levels(levels: usize) -> (usize, usize) {
    let last = levels.saturating_sub(1);
    ((*LEVELS.start()).min(last), (*LEVELS.end()).min(last))
}
