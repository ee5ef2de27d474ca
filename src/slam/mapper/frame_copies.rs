//! Copies of frames that outlive them: one of each frame, however many keep it.

use std::sync::Arc;

use crate::slam::frame::FrameView;

/// Most copies that are kept for frames to come, one byte a pixel each: as many as come between two keyframes.
const MOST_SPARE: usize = 30;

/// The copies that somebody keeps, and memory for more.
#[derive(Debug, Default)]
pub(super) struct FrameCopies {
    copies: Vec<Arc<[u8]>>,
    /// The one of the frame at hand, by its sequence: a map begins with two frames in one step.
    current: Option<(u64, Arc<[u8]>)>,
}

impl FrameCopies {
    /// A new frame is at hand.
    pub(super) fn begin_frame(&mut self) {
        self.current = None;
    }

    /// The grey values of the frame at hand, copied when they are first asked for.
    pub(super) fn of(&mut self, frame: &FrameView<'_>) -> Arc<[u8]> {
        if let Some((_, copy)) = self.current.as_ref().filter(|(of, _)| *of == frame.sequence) {
            return Arc::clone(copy);
        }
        let copy = self.copy(frame.pixels);
        self.current = Some((frame.sequence, Arc::clone(&copy)));
        copy
    }

    /// Gives back the memory of copies that nobody keeps, where no more frames come.
    pub(super) fn forget_spare(&mut self) {
        self.current = None;
        self.copies.retain_mut(|copy| Arc::get_mut(copy).is_none());
    }

    fn copy(&mut self, pixels: &[u8]) -> Arc<[u8]> {
        // Nobody else keeps a copy that can be written to.
        let mut spare = 0;
        self.copies.retain_mut(|copy| {
            spare += usize::from(Arc::get_mut(copy).is_some());
            Arc::get_mut(copy).is_none() || spare <= MOST_SPARE
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
        copies.begin_frame();
        copies.of(&FrameView::new(&CAMERA, 0, 0, &pixels))
    }

    #[test]
    fn a_frame_is_copied_once_and_its_memory_is_used_again() {
        let mut copies = FrameCopies::default();
        let first = copy_of(&mut copies, 1);
        let same = copies.of(&FrameView::new(&CAMERA, 0, 0, &[]));
        assert!(Arc::ptr_eq(&first, &same));
        let second = copy_of(&mut copies, 2);
        assert!((first[0], second[0]) == (1, 2));
        let memory = first.as_ptr();
        drop((first, same));
        let third = copy_of(&mut copies, 3);
        assert!(third[0] == 3 && third.as_ptr() == memory && second[0] == 2);
    }

    #[test]
    fn two_frames_of_one_step_have_a_copy_each() {
        let pixels = [1u8, 2].map(|grey| vec![grey; CAMERA.width * CAMERA.height]);
        let frame = |k: usize| FrameView::new(&CAMERA, k as u64, 0, &pixels[k]);
        let mut copies = FrameCopies::default();
        copies.begin_frame();
        assert_eq!([0, 1, 1, 0].map(|k| copies.of(&frame(k))[0]), [1, 2, 2, 1]);
    }

    #[test]
    fn memory_of_few_images_is_kept() {
        let mut copies = FrameCopies::default();
        let kept: Vec<_> = (0..100).map(|grey| copy_of(&mut copies, grey)).collect();
        assert_eq!(copies.copies.len(), 100);
        drop(kept);
        let _ = copy_of(&mut copies, 0);
        assert_eq!(copies.copies.len(), MOST_SPARE);
        copies.forget_spare();
        assert_eq!(copies.copies.len(), 0);
    }
}
