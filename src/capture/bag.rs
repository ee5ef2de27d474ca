//! ROS 2 bags and our own recordings, in MCAP files: one topic of images as a frame source.
//!
//! Read once from the start, message by message, so that a file without an end (from a killed recorder) is played up to
//! its last complete chunk. Sizes in the file are never trusted.

pub mod bag_error;
mod camera;
mod chunk;
mod contents;
mod message;
mod records;
mod topics;

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use crate::capture::bag::bag_error::{BagError, BagImageError};
use crate::capture::bag::contents::Contents;
use crate::capture::bag::message::{CompressedImage, FrameRecord, Image, Stamped};
use crate::capture::bag::records::{Place, Records};
use crate::capture::bag::topics::Kind;
use crate::capture::decode_error::DecodeError;
use crate::capture::image_file::decode_gray_into;
use crate::capture::rectifier::Rectifier;
use crate::capture::rig::Rig;
use crate::capture::source::{FrameSource, FrameStamp, Notice};
use crate::capture::source_error::SourceError;
use crate::capture::v4l::stamps::StampOrder;
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;

/// A topic's images as a frame source.
#[derive(Debug)]
pub struct Bag {
    path: PathBuf,
    contents: Contents,
    records: Records,
    rectifier: Rectifier,
    /// Whether images without our own recording's record have the stamps of their headers, not the log times.
    has_header_stamps: bool,
    /// Our own recording's record of the next image.
    record: Option<FrameRecord>,
    /// The source's number of the first frame.
    first_sequence: Option<u64>,
    /// Sequence of the next frame unless its record has one.
    next: u64,
    order: StampOrder,
    notice: Option<Notice>,
}

/// Opens the images on `topic`, or on the only topic with images. Without `rig`, the `CameraInfo` next to them is used.
pub fn open(path: &Path, topic: Option<&str>, rig: Option<&Path>) -> Result<Bag, SourceError> {
    let bag = |problem| SourceError::Bag { path: path.to_owned(), problem };
    let contents = Contents::read(path, topic).map_err(bag)?;
    let (rig, rig_path) = match rig {
        Some(rig) => (Rig::read(rig)?, rig.to_owned()),
        None => (contents.rig(path).map_err(bag)?, path.to_owned()),
    };
    let rectifier = Rectifier::new(&rig, &rig_path)?;
    let notice = contents.is_unfinished.then(|| Notice {
        text: format!(
            "{}: is truncated; it is played up to its last complete chunk",
            path.display()
        ),
        is_warning: true,
    });
    Ok(Bag {
        path: path.to_owned(),
        records: Records::open(path).map_err(bag)?,
        has_header_stamps: contents.has_header_stamps(path).map_err(bag)?,
        contents,
        rectifier,
        record: None,
        first_sequence: None,
        next: 0,
        order: StampOrder::default(),
        notice,
    })
}

impl Bag {
    /// Advances to the next image and returns its stamp; `None` after the last.
    fn advance(&mut self) -> Result<Option<FrameStamp>, SourceError> {
        loop {
            let place = match self.records.advance() {
                Ok(Some(place)) => place,
                Ok(None) => return Ok(None),
                Err(BagError::Damaged { at, reason }) => {
                    return Err(self.lost(BagImageError::Chunk { at, reason }));
                }
                Err(problem) => {
                    return Err(SourceError::Bag { path: self.path.clone(), problem });
                }
            };
            let Place::Message { channel, log_nanos } = place else { continue };
            let data = self.records.message();
            if self.contents.is_frame_record(channel) {
                self.record = message::decode(data).ok();
            } else if self.contents.image_kind(channel).is_some() {
                let header = message::decode(data).map(|h: Stamped| h.stamp_nanos());
                return self.stamp(header, log_nanos).map(Some).map_err(|e| self.lost(e));
            }
        }
    }

    /// Returns the stamp of an image whose header has `stamp`: that of our own recording, if it has one, else that of
    /// the header, or the time of recording if the bag's headers have none.
    fn stamp(
        &mut self,
        stamp: Result<i64, message::CdrError>,
        log_nanos: i64,
    ) -> Result<FrameStamp, BagImageError> {
        let sequence = self.next;
        self.next = self.next.saturating_add(1);
        let stamp = stamp?;
        let own = self.record.take().filter(|record| record.header.stamp_nanos() == stamp);
        let frame = match own {
            Some(own) => {
                let first = *self.first_sequence.get_or_insert(own.sequence);
                FrameStamp {
                    // A damaged number must not go backwards.
                    sequence: own.sequence.saturating_sub(first).max(sequence),
                    capture_nanos: own.capture_nanos,
                    exposure_nanos: own.exposure_nanos,
                    gain: if own.gain.is_finite() { own.gain } else { 0.0 },
                    clocks: None,
                }
            }
            None => FrameStamp {
                sequence,
                capture_nanos: if self.has_header_stamps { stamp } else { log_nanos },
                ..FrameStamp::default()
            },
        };
        let nanos = frame.capture_nanos;
        if !self.order.accepts(nanos) {
            return Err(BagImageError::Disordered { nanos });
        }
        self.next = frame.sequence.saturating_add(1);
        Ok(frame)
    }

    fn lost(&self, problem: BagImageError) -> SourceError {
        let (path, topic) = (self.path.clone(), self.contents.topic.clone());
        SourceError::BagImage { path, topic, problem }
    }

    /// Decodes the current image into `pixels`.
    fn decode_into(&mut self, pixels: &mut [u8]) -> Result<(), BagImageError> {
        let Intrinsics { width, height, .. } = self.rectifier.intrinsics();
        let data = self.records.message();
        let kind = self.contents.image_kind(self.records.channel);
        self.rectifier.read_into(pixels, |gray, samples| {
            if kind == Some(Kind::CompressedImage) {
                let image: CompressedImage<'_> = message::decode(data)?;
                return Ok(decode_gray_into(image.data, width, height, samples, gray)?);
            }
            let image: Image<'_> = message::decode(data)?;
            let found = (image.width as usize, image.height as usize);
            if found != (width, height) {
                return Err(DecodeError::Size { found, expected: (width, height) }.into());
            }
            Ok(image.as_ros().unpack_gray(gray)?)
        })
    }
}

impl FrameSource for Bag {
    fn intrinsics(&self) -> Intrinsics {
        self.rectifier.intrinsics()
    }

    fn camera(&self) -> CameraModel {
        *self.rectifier.camera()
    }

    fn readout_s(&self) -> Option<f64> {
        (!self.marks_hidden()).then(|| self.rectifier.readout_s())
    }

    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        self.rectifier.rectified(raw)
    }

    fn marks_hidden(&self) -> bool {
        self.contents.is_own()
    }

    fn num_frames(&self) -> Option<usize> {
        usize::try_from(self.contents.num_images).ok()
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        let Some(stamp) = self.advance()? else { return Ok(None) };
        self.decode_into(pixels).map_err(|problem| self.lost(problem))?;
        Ok(Some(stamp))
    }

    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        loop {
            match self.advance() {
                Ok(Some(stamp)) if stamp.sequence < sequence => {}
                Err(error) if error.is_transient() => {}
                Err(error) => return Err(error),
                Ok(_) => return Ok(()),
            }
        }
    }

    fn take_notice(&mut self) -> Option<Notice> {
        self.notice.take()
    }
}
