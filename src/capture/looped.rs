//! A recording played back and forth at a steady rate: endless frames for benchmarks and soak tests.

use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::path::PathBuf;

use crate::capture::frame_store::FrameStore;
use crate::capture::source::{FrameSource, FrameStamp, Notice};
use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::slam::geometry::intrinsics::Intrinsics;

/// Maximum memory for the kept frames, bytes: two thousand VGA images.
const MAX_KEPT_BYTES: usize = 640 << 20;

/// The frames of another source, played from memory alternately forwards and backwards: the camera never jumps.
pub struct Looped {
    name: SourceName,
    inner: Box<dyn FrameSource>,
    kept: FrameStore,
    num_frames: u64,
    period_nanos: f64,
    next: u64,
    /// Images that were left out, for the log.
    notices: VecDeque<String>,
}

impl Looped {
    /// Plays `inner` for `num_frames` frames at `rate_hz`.
    pub fn new(
        name: SourceName,
        inner: Box<dyn FrameSource>,
        num_frames: u64,
        rate_hz: f64,
    ) -> Self {
        let Intrinsics { width, height, .. } = inner.intrinsics();
        let kept = FrameStore::in_memory(width * height);
        let period_nanos = 1e9 / rate_hz;
        Self { name, inner, kept, num_frames, period_nanos, next: 0, notices: VecDeque::new() }
    }

    /// Index of the kept frame that is shown as frame `sequence`.
    fn place(&self, sequence: u64) -> usize {
        let last = self.kept.len() as u64 - 1;
        // Back and forth without showing either end twice.
        let phase = sequence % (2 * last).max(1);
        (if phase <= last { phase } else { 2 * last - phase }) as usize
    }

    /// The error of the store of kept frames.
    fn unkept(&self, source: io::Error) -> SourceError {
        SourceError::Read { path: PathBuf::from(self.name.to_string()), source }
    }
}

impl FrameSource for Looped {
    fn intrinsics(&self) -> Intrinsics {
        self.inner.intrinsics()
    }

    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        self.inner.rectified(raw)
    }

    /// Frames that are played backwards or at another rate cannot be corrected.
    fn readout_s(&self) -> Option<f64> {
        None
    }

    fn marks_hidden(&self) -> bool {
        self.inner.marks_hidden()
    }

    fn num_frames(&self) -> Option<usize> {
        usize::try_from(self.num_frames).ok()
    }

    fn prepare(
        &mut self,
        progress: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), SourceError> {
        if self.kept.is_complete() {
            return Ok(());
        }
        self.inner.prepare(progress)?;
        let bytes = self.kept.frame_bytes;
        let most = (MAX_KEPT_BYTES / bytes).max(1);
        let total = self.inner.num_frames().map_or(most, |frames| frames.min(most));
        let mut pixels = vec![0; bytes];
        // Frames that an earlier process has kept need not be kept again; images that it left out do not count.
        let mut num_known = self.kept.len();
        while self.kept.len() < most {
            match self.inner.next_into(&mut pixels) {
                Ok(Some(_)) if num_known > 0 => num_known -= 1,
                Ok(Some(_)) => {
                    self.kept.push(pixels.clone()).map_err(|source| self.unkept(source))?;
                }
                Ok(None) => break,
                // A gap would recur with every repetition: the image is left out.
                Err(error) if error.is_transient() => {
                    self.notices.push_back(format!("left out: {error}"))
                }
                Err(error) => return Err(error),
            }
            // Even without a new frame: this is the sign of life of the preparing process.
            if !progress(self.kept.len().min(total), total) {
                return Ok(());
            }
        }
        self.kept.complete().map_err(|source| self.unkept(source))
    }

    fn keep_prepared_in(&mut self, file: File) -> io::Result<()> {
        self.kept = FrameStore::in_file(file, self.kept.frame_bytes)?;
        Ok(())
    }

    fn take_notice(&mut self) -> Option<Notice> {
        Some(Notice { text: self.notices.pop_front()?, is_warning: true })
    }

    fn skip_to(&mut self, sequence: u64) -> Result<(), SourceError> {
        self.next = sequence.saturating_add(1);
        Ok(())
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        if self.kept.is_empty() {
            let (name, problem) = (self.name.to_string(), "it has no frames to repeat".to_owned());
            return Err(SourceError::Name { name, problem });
        }
        self.check_buffer(pixels)?;
        if self.next >= self.num_frames {
            return Ok(None);
        }
        let kept = self.kept.get(self.place(self.next));
        let kept = kept.ok_or_else(|| self.unkept(io::ErrorKind::UnexpectedEof.into()))?;
        pixels.copy_from_slice(&kept);
        let sequence = self.next;
        self.next += 1;
        Ok(Some(FrameStamp {
            sequence,
            // Starts at one period: a stamp of zero is what a camera without a clock gives.
            capture_nanos: ((sequence + 1) as f64 * self.period_nanos) as i64,
            ..FrameStamp::default()
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::opening::{SourceParams, open};
    use crate::capture::simulator::params::SimulatorParams;

    #[test]
    fn frames_go_back_and_forth_at_the_rate() {
        let simulator = SimulatorParams {
            frames: 4,
            width: 64,
            height: 48,
            focal_px: 50.0,
            ..SimulatorParams::default()
        };
        let params = SourceParams { simulator, ..SourceParams::default() };
        let mut once = open(&"sim".parse().unwrap(), None, &params).unwrap();
        once.prepare(&mut |_, _| true).unwrap();
        let mut frames = Vec::new();
        let mut pixels = vec![0; 64 * 48];
        while once.next_into(&mut pixels).unwrap().is_some() {
            frames.push(pixels.clone());
        }
        assert_eq!(frames.len(), 4);
        let mut looped = open(&"loop:9:50:sim".parse().unwrap(), None, &params).unwrap();
        looped.prepare(&mut |_, _| true).unwrap();
        for (sequence, place) in [0, 1, 2, 3, 2, 1, 0, 1, 2].into_iter().enumerate() {
            let stamp = looped.next_into(&mut pixels).unwrap().unwrap();
            assert_eq!(stamp.sequence, sequence as u64);
            assert_eq!(stamp.capture_nanos, 20_000_000 * (sequence as i64 + 1));
            assert!(pixels == frames[place], "frame {sequence}");
        }
        assert!(looped.next_into(&mut pixels).unwrap().is_none());
    }

    /// A source with its next frame and its number of frames, of which every second is damaged.
    struct Damaged(u64, u64);

    impl FrameSource for Damaged {
        fn intrinsics(&self) -> Intrinsics {
            Intrinsics { fx: 50.0, fy: 50.0, cx: 16.0, cy: 12.0, width: 32, height: 24 }
        }

        fn num_frames(&self) -> Option<usize> {
            Some(self.1 as usize)
        }

        fn next_into(&mut self, _pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
            let sequence = self.0;
            self.0 += 1;
            if sequence >= self.1 {
                return Ok(None);
            }
            if sequence % 2 == 1 {
                let (name, reason) = ("test".to_owned(), "it is odd".to_owned());
                return Err(SourceError::BrokenFrame { name, reason });
            }
            let capture_nanos = sequence as i64;
            Ok(Some(FrameStamp {
                sequence,
                capture_nanos,
                exposure_nanos: 0,
                gain: 0.0,
                clocks: None,
            }))
        }
    }

    #[test]
    fn every_frame_that_is_read_reports_progress() {
        let file = tempfile::tempfile().unwrap();
        let name: SourceName = "loop:100:30:sim".parse().unwrap();
        let prepare = |most: usize| {
            let inner = Box::new(Damaged(0, 20));
            let mut looped = Looped::new(name.clone(), inner, 100, 30.0);
            looped.keep_prepared_in(file.try_clone().unwrap()).unwrap();
            let mut signs = 0;
            looped
                .prepare(&mut |_, _| {
                    signs += 1;
                    signs < most
                })
                .unwrap();
            signs
        };
        // Killed during its preparation; the next one skips the frames already kept.
        assert_eq!(prepare(11), 11);
        assert_eq!(prepare(usize::MAX), 20);
    }

    #[test]
    fn a_loop_of_one_frame_repeats_it() {
        let simulator =
            SimulatorParams { frames: 1, width: 64, height: 48, ..SimulatorParams::default() };
        let params = SourceParams { simulator, ..SourceParams::default() };
        let mut looped = open(&"loop:3:10:sim".parse().unwrap(), None, &params).unwrap();
        looped.prepare(&mut |_, _| true).unwrap();
        let mut pixels = vec![0; 64 * 48];
        let count = std::iter::from_fn(|| looped.next_into(&mut pixels).unwrap()).count();
        assert_eq!(count, 3);
    }

    #[test]
    fn loops_need_a_length_and_a_rate() {
        for wrong in ["loop:", "loop:0:30:sim", "loop:5:0:sim", "loop:5:inf:sim", "loop:5:30"] {
            assert!(wrong.parse::<SourceName>().is_err(), "{wrong}");
        }
        let name: SourceName = "loop:5:30:tum:/x:y".parse().unwrap();
        assert_eq!(name.to_string(), "loop:5:30:tum:/x:y");
    }
}
