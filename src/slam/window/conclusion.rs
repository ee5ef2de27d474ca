//! The final estimate of all keyframes, after the last frame.
//!
//! Keyframes that the window fixed early are free again: in rendered rooms the trajectory error is halved or better.

use crate::slam::window::members::Chosen;
use crate::slam::window::{Adjustment, Window};

/// Keyframes that are free together: bounds memory (the equations, about 170 bytes a comparison) and time.
const PIECE: usize = 40;
/// Keyframes from one piece to the next: each is free twice, among those before it and among those after it.
const STEP: usize = 20;
/// Newest keyframes that are estimated once more: six pieces take a few seconds.
pub(super) const MAX_NEWEST: usize = 120;
/// Most iterations of a level: further ones only lower the part of the cost that is due to interpolation.
const MAX_ITERATIONS: u32 = 15;

impl Window {
    /// Estimates the newest keyframes of the epoch, at most `MAX_NEWEST`, piece by piece.
    pub(super) fn adjust_all(&mut self, newest: usize) -> Option<Adjustment> {
        let of_epoch = self.of_epoch_up_to(newest);
        let mut last = None;
        let mut begin = of_epoch.len().saturating_sub(MAX_NEWEST);
        loop {
            let end = (begin + PIECE).min(of_epoch.len());
            let chosen = self.choose_piece(&of_epoch, begin, end);
            last = self.adjust_within(&chosen, MAX_ITERATIONS).or(last);
            self.free_unused_images(&chosen.members);
            if end == of_epoch.len() {
                return last;
            }
            begin += STEP;
        }
    }

    /// Estimates the newest keyframes of the epoch, as many as are free together.
    pub(super) fn adjust_newest(&mut self, newest: usize) -> Option<Adjustment> {
        let of_epoch = self.of_epoch_up_to(newest);
        let (begin, end) = (of_epoch.len().saturating_sub(PIECE), of_epoch.len());
        let chosen = self.choose_piece(&of_epoch, begin, end);
        let adjustment = self.adjust(&chosen);
        self.free_unused_images(&chosen.members);
        adjustment
    }

    /// The keyframes `begin..end` of an epoch, which are free, and those around them that hold them in place.
    pub(super) fn choose_piece(&self, of_epoch: &[usize], begin: usize, end: usize) -> Chosen {
        let (before, piece) = of_epoch[..end].split_at(begin);
        let after = &of_epoch[end..];
        let outside: Vec<usize> = before.iter().chain(after).copied().collect();
        let (mut fixed, mut free) = (Vec::new(), Vec::new());
        for group in self.groups(piece) {
            let held_by = self.covisible(&outside, &[group[0], group[group.len() - 1]]);
            let is_oldest = before.is_empty() && group[0] == piece[0];
            // A group that nothing holds would drift freely.
            if !held_by.is_empty() || is_oldest || group.len() == piece.len() {
                fixed.extend(held_by);
                free.extend(group);
            }
        }
        fixed.sort_unstable();
        fixed.dedup();
        free.sort_unstable();
        Chosen::new(fixed, &free, before.is_empty(), true)
    }
}
