//! A source whose images are corrected as they are read: dim ones are brightened, the rolling shutter is undone, and a
//! mask hides what is not the scene. That images are dim is logged in any case.

use std::collections::VecDeque;
use std::fs::File;
use std::ops::DerefMut;
use std::os::fd::BorrowedFd;

use crate::capture::mask::{Mask, mark_hidden};
use crate::capture::source::{Arrival, FrameLosses, FrameSource, FrameStamp, Notice};
use crate::capture::source_error::SourceError;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::brightening::{Brightening, Light, SETTLING_FRAMES};
use crate::slam::image::buffer::Image;
use crate::slam::rolling_shutter::RollingShutter;
use crate::slam::trajectory::StampedPose;

/// What is corrected in the images of a source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corrections {
    /// Whether dim images are brightened.
    pub brighten: bool,
    /// Time in which all rows are read out, seconds; 0 is a global shutter, `None` what the rig says.
    pub readout_s: Option<f64>,
}

impl Default for Corrections {
    fn default() -> Self {
        Self { brighten: true, readout_s: None }
    }
}

/// The frames of a source, corrected. While its first frames are dim it reads a few ahead, to see whether the exposure
/// still settles; with a rolling shutter it reads the second before it returns the first.
pub(crate) struct Corrected<S> {
    source: S,
    /// Whether dim frames are brightened; otherwise their light is only measured.
    brightens: bool,
    mask: Option<Mask>,
    brightening: Brightening,
    /// `None` where all rows are exposed together.
    rolling_shutter: Option<RollingShutter>,
    /// Largest factor so far.
    max_factor: u8,
    /// Frames that were read ahead, in order.
    ahead: VecDeque<AheadFrame>,
}

/// A frame that was read ahead, or why there is none.
struct AheadFrame {
    stamp: Result<Option<FrameStamp>, SourceError>,
    pixels: Vec<u8>,
}

impl AheadFrame {
    fn light(&self, width: usize) -> Option<Light> {
        matches!(self.stamp, Ok(Some(_))).then(|| Light::of(&self.pixels, width)).flatten()
    }
}

impl<S> Corrected<S>
where
    S: DerefMut + Send,
    S::Target: FrameSource,
{
    /// Corrects the frames of `source`, and hides the pixels of `mask`.
    pub fn new(source: S, corrections: &Corrections, mask: Option<Mask>) -> Self {
        let of_source = source.readout_s();
        let readout_s = of_source.map_or(0.0, |of_rig| corrections.readout_s.unwrap_or(of_rig));
        let rolling_shutter = (readout_s > 0.0).then(|| {
            tracing::info!(
                "rolling shutter: undone, rows are read out in {:.1} ms",
                1e3 * readout_s
            );
            RollingShutter::new(&source.camera(), &source.intrinsics(), readout_s)
        });
        if let Some(mask) = &mask {
            tracing::info!("the mask hides {:.0} % of the image", 100.0 * mask.hidden());
        }
        Self {
            source,
            brightens: corrections.brighten,
            mask,
            brightening: Brightening::default(),
            rolling_shutter,
            max_factor: 1,
            ahead: VecDeque::new(),
        }
    }

    /// Reads the source's next frame; what is hidden is black, so that it does not count as light.
    fn read_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        let stamp = self.source.next_into(pixels)?;
        self.mask.iter().for_each(|mask| mask.hide(pixels));
        Ok(stamp)
    }

    /// The largest factor by which grey levels were multiplied; `None` where brightening is off.
    pub fn max_factor(&self) -> Option<u8> {
        self.brightens.then_some(self.max_factor)
    }

    /// Whether another frame must be read before the next one is corrected.
    fn needs_more(&self) -> bool {
        let width = self.source.intrinsics().width;
        let is_dim = |first: &AheadFrame| first.light(width).is_some_and(|light| light.is_dim());
        let light_settles = self.brightens
            && !self.brightening.has_begun()
            && self.ahead.len() < SETTLING_FRAMES
            && self.ahead.front().is_none_or(is_dim);
        // The motion of the first image is measured to the second.
        let lacks_second = self.ahead.len() < 2
            && self.rolling_shutter.as_ref().is_some_and(|shutter| !shutter.has_begun());
        (light_settles || lacks_second)
            && self.ahead.back().is_none_or(|last| matches!(last.stamp, Ok(Some(_))))
    }

    /// Undoes the rolling shutter of a frame.
    fn undo_rolling_shutter(&mut self, capture_nanos: i64, pixels: &mut [u8]) {
        let Some(shutter) = &mut self.rolling_shutter else { return };
        if !shutter.has_begun()
            && let Some(AheadFrame { stamp: Ok(Some(next)), pixels: next_pixels }) =
                self.ahead.front()
        {
            let mut second = next_pixels.clone();
            if self.brightens {
                self.brightening.apply(&mut second);
            }
            if !self.source.marks_hidden() {
                mark_hidden(self.mask.as_ref(), &mut second);
            }
            shutter.look_ahead((capture_nanos, pixels), (next.capture_nanos, &second));
        }
        shutter.undo(capture_nanos, pixels);
    }

    fn read_ahead(&mut self) {
        let Intrinsics { width, height, .. } = self.source.intrinsics();
        let mut pixels = vec![0; width * height];
        let stamp = self.read_into(&mut pixels);
        self.ahead.push_back(AheadFrame { stamp, pixels });
    }

    /// Brightens a frame and logs a change of the factor.
    fn brighten(&mut self, pixels: &mut [u8]) {
        let width = self.source.intrinsics().width;
        let later = self.ahead.iter().rev().find_map(|frame| frame.light(width));
        let before = self.brightening.factor();
        self.brightening.follow(pixels, width, later);
        if self.brightens {
            self.brightening.apply(pixels);
        }
        let factor = self.brightening.factor();
        self.max_factor = self.max_factor.max(factor);
        match factor {
            _ if factor == before => {}
            1 => tracing::info!("the images are bright enough again"),
            _ if self.brightens => tracing::warn!(
                "the images are dim; their grey levels are multiplied by {factor}. Add light or expose longer"
            ),
            // Where it is off only the first step is worth a line.
            _ if before == 1 => tracing::warn!(
                "the images are dim, and capture.brighten is off: poses may be wrong. Add light or expose longer"
            ),
            _ => {}
        }
    }
}

impl<S> FrameSource for Corrected<S>
where
    S: DerefMut + Send,
    S::Target: FrameSource,
{
    fn intrinsics(&self) -> Intrinsics {
        self.source.intrinsics()
    }

    fn camera(&self) -> CameraModel {
        self.source.camera()
    }

    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        self.source.rectified(raw)
    }

    fn marks_hidden(&self) -> bool {
        true
    }

    fn num_frames(&self) -> Option<usize> {
        self.source.num_frames()
    }

    fn keep_prepared_in(&mut self, file: File) -> std::io::Result<()> {
        self.source.keep_prepared_in(file)
    }

    fn prepare(
        &mut self,
        progress: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), SourceError> {
        self.source.prepare(progress)
    }

    fn await_frame(&mut self, wake: BorrowedFd<'_>, millis: u32) -> Result<Arrival, SourceError> {
        let needs_more = self.needs_more();
        if !needs_more && !self.ahead.is_empty() {
            return Ok(Arrival::Frame);
        }
        let arrival = self.source.await_frame(wake, millis)?;
        if needs_more && arrival == Arrival::Frame {
            // One at a time, so that the caller is never kept waiting for several.
            self.read_ahead();
            return Ok(if self.needs_more() { Arrival::Nothing } else { Arrival::Frame });
        }
        Ok(arrival)
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        while self.needs_more() {
            self.read_ahead();
        }
        let stamp = match self.ahead.pop_front() {
            Some(frame) => {
                pixels.copy_from_slice(&frame.pixels);
                frame.stamp?
            }
            None => self.read_into(pixels)?,
        };
        if let Some(stamp) = &stamp {
            self.brighten(pixels);
            // Afterwards, so that black is not brightened.
            if !self.source.marks_hidden() {
                mark_hidden(self.mask.as_ref(), pixels);
            }
            // Last, as it leaves margins without data.
            self.undo_rolling_shutter(stamp.capture_nanos, pixels);
        }
        Ok(stamp)
    }

    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        self.ahead.clear();
        self.rolling_shutter.iter_mut().for_each(RollingShutter::restart);
        self.source.skip_to(sequence)
    }

    fn losses(&self) -> Option<FrameLosses> {
        self.source.losses()
    }

    fn take_notice(&mut self) -> Option<Notice> {
        self.source.take_notice()
    }

    fn ground_truth(&self) -> &[StampedPose] {
        self.source.ground_truth()
    }

    fn depth_at(&mut self, capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        self.source.depth_at(capture_nanos)
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsFd;

    use super::*;
    use crate::capture::looped::Looped;
    use crate::capture::tum;
    use crate::slam::image::NO_DATA;
    use crate::slam::test_scene::CAMERA;

    /// Frames of one grey level each; `None` is a frame that cannot be read.
    struct Greys {
        greys: Vec<Option<u8>>,
        num_read: usize,
    }

    impl FrameSource for Greys {
        fn intrinsics(&self) -> Intrinsics {
            CAMERA
        }

        fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
            let Some(grey) = self.greys.get(self.num_read) else { return Ok(None) };
            let sequence = self.num_read as u64;
            self.num_read += 1;
            pixels.fill(grey.unwrap_or_default());
            match grey {
                Some(_) => Ok(Some(FrameStamp { sequence, ..FrameStamp::default() })),
                None => Err(SourceError::Buffer { found: 0, width: 0, height: 0 }),
            }
        }
    }

    fn brightened(greys: impl IntoIterator<Item = Option<u8>>) -> Corrected<Box<Greys>> {
        Corrected::new(
            Box::new(Greys { greys: greys.into_iter().collect(), num_read: 0 }),
            &Corrections::default(),
            None,
        )
    }

    /// Number and grey level of the next frame.
    fn next(source: &mut Corrected<Box<Greys>>) -> Option<(u64, u8)> {
        let mut pixels = vec![0; CAMERA.width * CAMERA.height];
        source.next_into(&mut pixels).unwrap().map(|stamp| (stamp.sequence, pixels[0]))
    }

    #[test]
    fn all_frames_of_a_dim_recording_are_brightened_and_none_is_lost() {
        for num_frames in [1, 3, SETTLING_FRAMES, 10] {
            let mut source = brightened(vec![Some(30); num_frames]);
            for sequence in 0..num_frames as u64 {
                assert_eq!(next(&mut source), Some((sequence, 120)), "{num_frames}");
            }
            assert_eq!((next(&mut source), next(&mut source)), (None, None));
            assert_eq!(source.max_factor(), Some(4));
        }
    }

    #[test]
    fn brightening_that_is_off_changes_nothing_and_reads_nothing_ahead() {
        let mut source = brightened(vec![Some(30); 3]);
        source.brightens = false;
        assert_eq!(next(&mut source), Some((0, 30)));
        assert_eq!((source.source.num_read, source.max_factor()), (1, None));
    }

    #[test]
    fn frames_of_ordinary_light_are_not_read_ahead() {
        let mut source = brightened(vec![Some(100); 10]);
        for sequence in 0..3 {
            assert_eq!(next(&mut source), Some((sequence, 100)));
            assert_eq!(source.source.num_read as u64, sequence + 1);
        }
    }

    #[test]
    fn a_camera_whose_exposure_settles_is_not_brightened() {
        // In steps of three frames from a tenth of the light.
        let light = [15, 15, 15, 22, 22, 22, 33, 33, 33, 50, 50, 50, 75, 75, 75, 110, 150];
        let mut source = brightened(light.map(Some));
        for (sequence, grey) in (0..).zip(light) {
            assert_eq!(next(&mut source), Some((sequence, grey)));
        }
        // One that settles in the dark is, from there on.
        let light = [10, 10, 10, 15, 15, 15, 30, 30, 30, 30, 30, 30, 30, 30];
        let mut source = brightened(light.map(Some));
        for (sequence, grey) in (0..).zip(light) {
            let seen = if sequence < 6 { grey } else { 4 * grey };
            assert_eq!(next(&mut source), Some((sequence, seen)));
        }
    }

    #[test]
    fn a_damaged_frame_ends_the_reading_ahead_and_is_reported_in_its_place() {
        let mut source = brightened([Some(30), Some(30), None, Some(30), Some(30)]);
        assert_eq!(next(&mut source), Some((0, 120)));
        assert_eq!(source.source.num_read, 3);
        assert_eq!(next(&mut source), Some((1, 120)));
        let mut pixels = vec![0; CAMERA.width * CAMERA.height];
        assert!(matches!(source.next_into(&mut pixels), Err(SourceError::Buffer { .. })));
        assert_eq!(next(&mut source), Some((3, 120)));
    }

    #[test]
    fn waiting_for_a_dim_camera_reads_one_frame_at_a_time() {
        let mut source = brightened(vec![Some(30); 10]);
        let never = File::open("/dev/null").unwrap();
        for num_read in 1..=SETTLING_FRAMES {
            let arrival = source.await_frame(never.as_fd(), 0).unwrap();
            assert_eq!(source.source.num_read, num_read);
            assert_eq!(arrival == Arrival::Frame, num_read == SETTLING_FRAMES);
        }
        for sequence in 0..10 {
            assert_eq!(source.await_frame(never.as_fd(), 0).unwrap(), Arrival::Frame);
            assert_eq!(next(&mut source), Some((sequence, 120)));
        }
    }

    #[test]
    fn what_a_mask_hides_stays_hidden_in_a_brightened_image_and_black_stays_black() {
        let count = CAMERA.width * CAMERA.height;
        let mut source = brightened(vec![Some(30); 10]);
        source.mask = Some(Mask::hiding(0..count / 3, count));
        let mut pixels = vec![0; count];
        source.next_into(&mut pixels).unwrap();
        assert!(pixels[..count / 3].iter().all(|&grey| grey == NO_DATA));
        assert!(pixels[count / 3..].iter().all(|&grey| grey == 120));
        let mut source = brightened(vec![Some(30), Some(0), Some(30)]);
        assert_eq!(next(&mut source), Some((0, 120)));
        assert_eq!(next(&mut source), Some((1, NO_DATA + 1)));
    }

    #[test]
    fn a_rolling_shutter_reads_the_second_frame_before_the_first_is_returned() {
        let rolling = |greys: Vec<Option<u8>>| {
            let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
            Corrected::new(Box::new(Greys { greys, num_read: 0 }), &corrections, None)
        };
        let mut source = rolling(vec![Some(100); 4]);
        assert_eq!(next(&mut source), Some((0, 100)));
        assert_eq!(source.source.num_read, 2);
        for sequence in 1..4 {
            assert_eq!(next(&mut source), Some((sequence, 100)));
            assert_eq!(source.source.num_read as u64, sequence.max(1) + 1);
        }
        assert_eq!(next(&mut source), None);
        // The only frame, and one before a damaged frame, are not waited with.
        assert_eq!(next(&mut rolling(vec![Some(100)])), Some((0, 100)));
        let mut source = rolling(vec![Some(100), None, Some(100)]);
        assert_eq!(next(&mut source), Some((0, 100)));
        assert!(source.next_into(&mut vec![0; CAMERA.width * CAMERA.height]).is_err());
        assert_eq!(next(&mut source), Some((2, 100)));
    }

    #[test]
    fn a_jump_forgets_the_motion() {
        let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
        let greys = Box::new(Greys { greys: vec![Some(100); 9], num_read: 0 });
        let mut source = Corrected::new(greys, &corrections, None);
        assert_eq!(next(&mut source), Some((0, 100)));
        source.skip_to(4).unwrap();
        assert!(source.rolling_shutter.as_ref().is_some_and(|shutter| !shutter.has_begun()));
        assert_eq!(next(&mut source), Some((5, 100)));
    }

    #[test]
    fn the_rig_s_read_out_time_reaches_the_frames() {
        let folder = tempfile::tempdir().unwrap();
        let rig = folder.path().join("rig.toml");
        std::fs::write(folder.path().join("rgb.txt"), "1.0 rgb/1.png\n").unwrap();
        let lens = "model = \"pinhole\"\nwidth = 160\nheight = 120\nfx = 130\nfy = 130\ncx = 80\ncy = 60\n";
        for (key, is_undone) in [("readout_ms = 20", true), ("", false)] {
            std::fs::write(&rig, format!("{lens}{key}\n")).unwrap();
            let source = Box::new(tum::open(folder.path(), Some(&rig)).unwrap());
            assert_eq!(source.readout_s(), Some(if is_undone { 0.02 } else { 0.0 }));
            let corrected = Corrected::new(source, &Corrections::default(), None);
            assert_eq!(corrected.rolling_shutter.is_some(), is_undone);
        }
    }

    #[test]
    fn frames_that_have_been_corrected_are_not_corrected_again() {
        let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
        let looped = |num_frames| {
            let inner = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
            Looped::new("loop:4:30:sim".parse().unwrap(), inner, num_frames, 30.0)
        };
        let source = Corrected::new(Box::new(looped(4)), &corrections, None);
        assert!(source.rolling_shutter.is_none());
        let plain = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
        assert!(Corrected::new(plain, &corrections, None).rolling_shutter.is_some());
        let plain = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
        assert!(Corrected::new(plain, &Corrections::default(), None).rolling_shutter.is_none());
    }
}
