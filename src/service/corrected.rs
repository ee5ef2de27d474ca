//! A source whose images are corrected as they are read: the vignette and the rolling shutter are undone, dim images are
//! brightened, and a mask hides what is not the scene. That images are dim is logged in any case.

#[cfg(test)]
mod tests;

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
use crate::slam::vignette::Vignette;

/// What is corrected in the images of a source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corrections {
    /// Whether dim images are brightened.
    pub brighten: bool,
    /// Time in which all rows are read out, seconds; 0 is a global shutter, `None` what the rig says.
    pub readout_s: Option<f64>,
    /// Whether the vignette of the lens is estimated and undone.
    pub undo_vignette: bool,
}

impl Default for Corrections {
    fn default() -> Self {
        Self { brighten: true, readout_s: None, undo_vignette: true }
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
    /// `None` where it is not undone.
    vignette: Option<Vignette>,
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
        // Images that were corrected before have none.
        let is_raw = of_source.is_some();
        let vignette =
            (corrections.undo_vignette && is_raw).then(|| Vignette::new(&source.intrinsics()));
        if let Some(mask) = &mask {
            tracing::info!("the mask hides {:.0} % of the image", 100.0 * mask.hidden());
        }
        Self {
            source,
            brightens: corrections.brighten,
            mask,
            brightening: Brightening::default(),
            vignette,
            rolling_shutter,
            max_factor: 1,
            ahead: VecDeque::new(),
        }
    }

    /// Reads the source's next frame, without its vignette; what is hidden is black, so that it does not count as light.
    fn read_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        let stamp = self.source.next_into(pixels)?;
        self.mask.iter().for_each(|mask| mask.hide(pixels));
        if let Some(vignette) = self.vignette.as_mut().filter(|_| stamp.is_some()) {
            if let Some(light) = vignette.follow(pixels) {
                tracing::info!(
                    "the lens leaves {:.0} % of the light in the corners: undone from frame {} on",
                    100.0 * light,
                    stamp.as_ref().map_or(0, |stamp| stamp.sequence)
                );
            }
            vignette.undo(pixels);
        }
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
        self.vignette.iter_mut().for_each(Vignette::restart);
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
