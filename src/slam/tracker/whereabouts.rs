//! Whether a lost camera may be anywhere.

/// Where the camera is between its poses.
#[derive(Debug, Clone, Copy, Default)]
pub(super) enum Whereabouts {
    /// Near a keyframe that was created just now, on which it has had no pose yet.
    AtNewKeyframe,
    /// Where the mapper found it, from the next frame on.
    #[default]
    FromNextFrame,
    /// Where it was at this stamp, this number of frames ago.
    Known { nanos: i64, frames: u32 },
}

impl Whereabouts {
    /// On the first keyframe of an epoch.
    pub(super) fn on_first_keyframe(is_new: bool) -> Self {
        if is_new { Self::AtNewKeyframe } else { Self::FromNextFrame }
    }

    /// The camera has a pose at `nanos`.
    pub(super) fn known_at(nanos: i64) -> Self {
        Self::Known { nanos, frames: 0 }
    }

    /// Counts a frame.
    pub(super) fn observe(&mut self, nanos: i64) {
        match self {
            Self::AtNewKeyframe => {}
            Self::FromNextFrame => *self = Self::known_at(nanos),
            Self::Known { frames, .. } => *frames = frames.saturating_add(1),
        }
    }

    /// Whether a camera that is lost at `nanos` may be anywhere: for both a time and a number of frames, as a single
    /// frame of a slow camera takes as long.
    pub(super) fn is_unknown(&self, nanos: i64) -> bool {
        /// Time by the stamps within which it is near where it was.
        const MAX_NANOS: i64 = 200_000_000;
        /// The same in frames of a camera at 30 Hz.
        const MAX_FRAMES: u32 = 6;
        match *self {
            Self::AtNewKeyframe | Self::FromNextFrame => false,
            Self::Known { nanos: known, frames } => {
                nanos.saturating_sub(known) > MAX_NANOS && frames > MAX_FRAMES
            }
        }
    }
}
