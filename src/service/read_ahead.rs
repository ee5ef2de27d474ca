//! Reads and decodes the frames of a recording on a separate thread, a few ahead of their consumer.

use std::thread::Scope;

use crossbeam::channel::{Receiver, Sender, bounded};

use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::slam::image::buffer::Image;

/// Frames that are read before they are requested. One is enough while decoding is faster than mapping; the others
/// bridge frames that take long.
const MAX_AHEAD: usize = 3;

/// What to read, and until when.
#[derive(Debug, Clone, Copy)]
pub struct ReadingPlan {
    /// Frames after which reading ends.
    pub max_frames: usize,
    /// Whether the depth camera's images are read too.
    pub with_depth: bool,
    /// Whether reading ends with the first unusable image.
    pub is_strict: bool,
}

/// One frame, or why there is none.
#[derive(Debug)]
pub struct ReadFrame {
    /// The frame's stamp, `None` after the last.
    pub stamp: Result<Option<FrameStamp>, SourceError>,
    /// Its `width * height` pixels.
    pub pixels: Vec<u8>,
    /// The depth camera's image, where it was requested and exists.
    pub sensor_depth: Result<Option<Image<f32>>, SourceError>,
}

/// Frames in order, as they were read.
#[derive(Debug)]
pub struct ReadAhead {
    frames: Receiver<ReadFrame>,
    spare: Sender<Vec<u8>>,
}

impl ReadAhead {
    /// Starts reading `source` on a thread of `scope`, which ends when this is dropped.
    pub fn start<'scope>(
        scope: &'scope Scope<'scope, '_>,
        source: &'scope mut dyn FrameSource,
        plan: ReadingPlan,
    ) -> std::io::Result<Self> {
        let camera = source.intrinsics();
        let (to_taker, frames) = bounded(MAX_AHEAD);
        // One more is held by the consumer.
        let (spare, memory) = bounded(MAX_AHEAD + 1);
        for _ in 0..MAX_AHEAD + 1 {
            // Cannot fail: the receiver is held here.
            let _ = spare.send(vec![0; camera.width * camera.height]);
        }
        std::thread::Builder::new()
            .name("semidense-read".to_owned())
            .spawn_scoped(scope, move || read(source, plan, &memory, &to_taker))?;
        Ok(Self { frames, spare })
    }

    /// The next frame; `None` after the last one read.
    pub fn next(&self) -> Option<ReadFrame> {
        self.frames.recv().ok()
    }

    /// Takes back the memory of a frame.
    pub fn give_back(&self, pixels: Vec<u8>) {
        // The thread may have ended and then needs none.
        let _ = self.spare.try_send(pixels);
    }
}

/// Reads until the end, until a permanent error, or until the consumer is gone.
fn read(
    source: &mut dyn FrameSource,
    plan: ReadingPlan,
    memory: &Receiver<Vec<u8>>,
    to_taker: &Sender<ReadFrame>,
) {
    let mut num_read = 0;
    while num_read < plan.max_frames {
        let Ok(mut pixels) = memory.recv() else { return };
        let stamp = source.next_into(&mut pixels);
        let (is_last, sensor_depth) = match &stamp {
            Ok(Some(stamp)) if plan.with_depth => (false, source.depth_at(stamp.capture_nanos)),
            Ok(Some(_)) => (false, Ok(None)),
            Ok(None) => (true, Ok(None)),
            Err(error) => (plan.is_strict || !error.is_transient(), Ok(None)),
        };
        if let Ok(Some(_)) = stamp {
            num_read += 1;
        }
        if to_taker.send(ReadFrame { stamp, pixels, sensor_depth }).is_err() || is_last {
            return;
        }
    }
}
