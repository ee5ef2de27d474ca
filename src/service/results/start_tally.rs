//! What frames came to while there was no map.

use crate::slam::mapper::situation::StartFrame;

/// What frames came to while there was no map, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StartTally {
    /// Frames without texture that were dark.
    pub dark: u64,
    /// Frames without texture that were overexposed.
    pub overexposed: u64,
    /// Other frames without texture.
    pub textureless: u64,
    /// Frames that did not show what the first of the start does.
    pub unmatched: u64,
    /// Frames in which the camera had not moved.
    pub still: u64,
    /// Frames that a rotation explains.
    pub turned: u64,
    /// Frames with too little parallax.
    pub little_parallax: u64,
}

impl StartTally {
    /// Counts a frame.
    pub fn count(&mut self, frame: Option<StartFrame>) {
        match frame {
            None | Some(StartFrame::Begun) => {}
            Some(StartFrame::Dark) => self.dark += 1,
            Some(StartFrame::Overexposed) => self.overexposed += 1,
            Some(StartFrame::Textureless) => self.textureless += 1,
            Some(StartFrame::Unmatched) => self.unmatched += 1,
            Some(StartFrame::Still) => self.still += 1,
            Some(StartFrame::Turned) => self.turned += 1,
            Some(StartFrame::LittleParallax) => self.little_parallax += 1,
        }
    }

    pub(super) fn sum(&self) -> u64 {
        let without_texture = self.dark + self.overexposed + self.textureless;
        without_texture + self.unmatched + self.still + self.turned + self.little_parallax
    }
}
