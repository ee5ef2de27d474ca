//! Copies of frames that outlive them: one per frame, shared by all that keep it.

use std::sync::Arc;

use crate::slam::frame::FrameView;
use crate::slam::image::repeats::{Repeats, Shown};
use crate::slam::image::sums::SumPyramid;

/// Most unused copies that are kept for later frames, one byte a pixel each: as many as lie between two keyframes.
const MAX_SPARE: usize = 30;

/// The copies in use, and buffers for more.
#[derive(Debug, Default)]
pub(super) struct FrameCopies {
    copies: Vec<Arc<[u8]>>,
    /// The copy of the current frame.
    current: Option<Arc<[u8]>>,
    /// That of the frame before it.
    previous: Option<Arc<[u8]>>,
    repeats: Repeats,
    pyramid: SumPyramid,
    is_repeat: bool,
}

impl FrameCopies {
    /// Begins a new frame, which is consistent and of the camera's size.
    pub(super) fn begin_frame(&mut self, frame: &FrameView<'_>) {
        self.begin_copy();
        let (width, height) = (frame.width, frame.height);
        if !self.pyramid.has_size(width, height, Repeats::NUM_LEVELS, 1) {
            self.pyramid = SumPyramid::with_size(width, height, Repeats::NUM_LEVELS, 1);
        }
        self.pyramid.fill(frame.pixels);
        self.is_repeat = self.repeats.observe(&self.pyramid) == Shown::Repeat;
    }

    /// Begins another copy.
    pub(super) fn begin_copy(&mut self) {
        self.previous = self.current.take();
        self.is_repeat = false;
    }

    /// Whether the current frame repeats the image of the previous one.
    pub(super) fn is_repeat(&self) -> bool {
        self.is_repeat
    }

    /// Whether the current frame repeats an image that was copied: a frame that was not used, as a lost one, has no copy.
    pub(super) fn repeats_copied(&self) -> bool {
        self.is_repeat && self.previous.is_some()
    }

    /// The grey values of the current frame, copied at the first call; of a repeat the previous frame's.
    pub(super) fn of(&mut self, frame: &FrameView<'_>) -> Arc<[u8]> {
        if let Some(copy) = &self.current {
            return Arc::clone(copy);
        }
        let copy = match &self.previous {
            Some(previous) if self.is_repeat => Arc::clone(previous),
            _ => self.copy(frame.pixels),
        };
        self.current = Some(Arc::clone(&copy));
        copy
    }

    /// Frees the copies that are not in use; the others are freed when their last reference is dropped.
    pub(super) fn free_unused(&mut self) {
        *self = Self::default();
    }

    fn copy(&mut self, pixels: &[u8]) -> Arc<[u8]> {
        // A copy that can be written to is not in use.
        let mut spare = 0;
        self.copies.retain_mut(|copy| {
            spare += usize::from(Arc::get_mut(copy).is_some());
            Arc::get_mut(copy).is_none() || spare <= MAX_SPARE
        });
        for copy in &mut self.copies {
            if let Some(memory) = Arc::get_mut(copy).filter(|of| of.len() == pixels.len()) {
                memory.copy_from_slice(pixels);
                return Arc::clone(copy);
            }
        }
        let copy: Arc<[u8]> = pixels.into();
        self.copies.push(Arc::clone(&copy));
        copy
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::CAMERA;

    fn copy_of(copies: &mut FrameCopies, grey: u8) -> Arc<[u8]> {
        let pixels = vec![grey; CAMERA.width * CAMERA.height];
        let frame = FrameView::new(&CAMERA, 0, 0, &pixels);
        copies.begin_frame(&frame);
        copies.of(&frame)
    }

    #[test]
    fn a_frame_is_copied_once_and_its_memory_is_reused() {
        let mut copies = FrameCopies::default();
        let first = copy_of(&mut copies, 1);
        let same = copies.of(&FrameView::new(&CAMERA, 0, 0, &[]));
        assert!(Arc::ptr_eq(&first, &same));
        let second = copy_of(&mut copies, 2);
        assert!((first[0], second[0]) == (1, 2));
        let memory = first.as_ptr();
        drop((first, same));
        let repeated = copy_of(&mut copies, 2);
        assert!(Arc::ptr_eq(&second, &repeated));
        let third = copy_of(&mut copies, 3);
        assert!(third[0] == 3 && third.as_ptr() == memory && second[0] == 2);
    }

    #[test]
    fn a_bounded_number_of_unused_copies_is_kept() {
        let mut copies = FrameCopies::default();
        let kept: Vec<_> = (0..100).map(|grey| copy_of(&mut copies, grey)).collect();
        assert_eq!(copies.copies.len(), 100);
        drop(kept);
        // A frame without a copy, after which the last one's is unused as well.
        copies.begin_copy();
        let _ = copy_of(&mut copies, 0);
        assert_eq!(copies.copies.len(), MAX_SPARE);
        let kept = copy_of(&mut copies, 7);
        copies.free_unused();
        assert_eq!((Arc::strong_count(&kept), kept[0]), (1, 7));
    }
}
