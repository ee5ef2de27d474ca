//! Passes: all keyframes are estimated again during mapping, a piece at a time, whenever no new keyframe waits.
//!
//! The window frees only the newest keyframes: what a loop or a better plane implies for older ones has no effect until
//! a pass frees them too. A pass does what the conclusion does after the last frame, in smaller pieces.

use crate::slam::map::{Correction, Map};
use crate::slam::window::conclusion::MAX_NEWEST;
use crate::slam::window::{Adjustment, Window};

/// A change of the newest keyframe's unit (logarithm) or tilt (per unit of the ray's coordinates) above which those
/// around it were estimated with a wrong one: in recordings one of 80 estimates after an epoch's first keyframes is
/// beyond it, in rendered rooms none is beyond 0.02.
const MIN_JUMP: f64 = 0.1;
/// The same in standard deviations, where they are known.
const MIN_JUMP_SIGMAS: f64 = 5.0;

/// The progress of a pass, and the reasons for the next.
#[derive(Debug, Clone, Default)]
pub(super) struct Pass {
    /// Keyframes added since the last one began.
    pub added: usize,
    has_jumped: bool,
    /// A loop was closed: a pass is due, even where passes are disabled.
    is_called: bool,
    /// Where the pass continues; `None` where none is running.
    next: Option<PieceStart>,
    /// The start of the piece that is being estimated.
    piece: Option<PieceStart>,
}

/// A keyframe that a piece begins with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct PieceStart {
    epoch: u32,
    keyframe_id: u64,
}

impl Pass {
    /// Calls for a pass from the beginning.
    pub fn request(&mut self) {
        (self.is_called, self.next) = (true, None);
    }

    /// The piece that was being estimated has entered.
    pub fn finish_piece(&mut self) {
        self.piece = None;
    }
}

impl Window {
    /// Begins a piece of a pass, by [`Window::optimise`]; false where none is due. Call it when no new keyframe waits.
    pub fn begin_piece(&mut self) -> bool {
        self.pass.finish_piece();
        let Some(newest) = self.keyframes.len().checked_sub(1) else { return false };
        let of_epoch = self.of_epoch_up_to(newest);
        let pass_every = self.params.pass_every;
        let is_made = pass_every > 0 || self.pass.is_called || self.pass.next.is_some();
        if !is_made || self.is_short(&of_epoch) {
            return false;
        }
        let oldest = &self.keyframes[of_epoch[of_epoch.len().saturating_sub(MAX_NEWEST)]];
        let start = PieceStart { epoch: oldest.epoch, keyframe_id: oldest.keyframe_id };
        let pass = &mut self.pass;
        // A pass over an epoch that was left, or joined to another, ends.
        pass.next = pass.next.filter(|next| next.epoch == start.epoch);
        let is_due =
            pass.is_called || pass_every > 0 && (pass.has_jumped || pass.added >= pass_every);
        if pass.next.is_none() && is_due {
            *pass = Pass { next: Some(start), ..Pass::default() };
        }
        pass.piece = pass.next;
        pass.piece.is_some()
    }

    /// Whether the epoch is so short that all its keyframes are free with every new one.
    fn is_short(&self, of_epoch: &[usize]) -> bool {
        of_epoch.len() <= self.params.num_first.max(self.params.num_free)
    }

    /// Estimates the piece that was begun; `None` where none was.
    pub(super) fn adjust_piece(&mut self, newest: usize) -> Option<Adjustment> {
        let piece = self.pass.piece?;
        let of_epoch = self.of_epoch_up_to(newest);
        let length = self.params.pass_piece;
        let place =
            of_epoch.partition_point(|&k| self.keyframes[k].keyframe_id < piece.keyframe_id);
        // The last piece is as long as the others.
        let begin = place.min(of_epoch.len().saturating_sub(length));
        let end = (begin + length).min(of_epoch.len());
        let mut chosen = self.choose_piece(&of_epoch, begin, end);
        chosen.is_first = false;
        let adjustment = self.adjust(&chosen);
        self.free_unused_images(&chosen.members);
        // Each keyframe is free twice, among those before it and among those after it.
        let next = of_epoch.get(begin + length / 2).filter(|_| end < of_epoch.len());
        let keyframe_id = next.map(|&next| self.keyframes[next].keyframe_id);
        self.pass.next = keyframe_id.map(|keyframe_id| PieceStart { keyframe_id, ..piece });
        adjustment
    }

    /// The last estimate was dropped: its piece is estimated again.
    pub fn repeat_piece(&mut self) {
        if let Some(piece) = self.pass.piece.take() {
            self.pass.next = Some(piece);
        }
    }

    /// Whether the last estimate was of a piece of a pass.
    pub fn is_piece(&self) -> bool {
        self.pass.piece.is_some()
    }

    /// Watches a correction of the newest keyframes: where the newest one's unit or plane jumps, those before were
    /// estimated with a wrong one and a pass is due.
    pub fn request_pass_on_jump(&mut self, map: &Map, correction: &Correction) {
        let Some(newest) = self.keyframes.len().checked_sub(1) else { return };
        if self.is_piece() || self.is_short(&self.of_epoch_up_to(newest)) {
            return;
        }
        let id = self.keyframes[newest].keyframe_id;
        let corrected = correction.keyframes.iter().find(|of| of.keyframe_id == id);
        let (Some(was), Some(is)) = (map.get(id), corrected) else { return };
        let unit = (is.map_from_keyframe.scale / was.map_from_keyframe.scale).ln();
        let of_unit = is.relative_place.map(|place| place.matrix()[(6, 6)].sqrt());
        let of_tilt = is.modes.map(|modes| modes.std_devs());
        let jumps = [
            (unit, of_unit),
            (is.depth.per_x, of_tilt.map(|of| of.x)),
            (is.depth.per_y, of_tilt.map(|of| of.y)),
        ];
        self.pass.has_jumped |= jumps.iter().any(|(by, deviation)| {
            by.abs() > MIN_JUMP.max(MIN_JUMP_SIGMAS * deviation.unwrap_or(0.0))
        });
    }
}
