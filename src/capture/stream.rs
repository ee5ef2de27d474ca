//! Frames that another program sends: `stream:PATH`, a socket that any program may write frames to, and `ros2:TOPIC`,
//! for which `semidense-bridge` is started.
//!
//! A late, silent or missing sender is a state, like an unplugged camera. The newest frame wins; everything that a
//! sender sends is checked before it is used.

mod feed;
pub mod format;
mod reader;

use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use rustix::time::{ClockId, clock_gettime};

use self::feed::{Feed, Listener, Program, await_readable};
use self::format::{StreamClock, StreamHeader};
use self::reader::{FrameReader, Progress, StreamFault};
use crate::capture::rectifier::Rectifier;
use crate::capture::rig::Rig;
use crate::capture::source::{Arrival, FrameClocks, FrameLosses, FrameSource, FrameStamp, Notice};
use crate::capture::source_error::SourceError;
use crate::capture::v4l::READ_MILLIS;
use crate::capture::v4l::stamps::{FrameNumbers, StampOrder};
use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;

/// The program that reads ROS 2 topics.
const BRIDGE: &str = "semidense-bridge";
/// What to do if it is missing.
pub const INSTALL_BRIDGE: &str = "install the package semidense-bridge (`apt install ./semidense-bridge_*.deb`), or build it from \
     the source tree with `cargo install --path bridge`";
/// Its command that writes the images of a topic to its standard output.
const BRIDGE_COMMAND: &str = "ros2-camera";
/// Maximum number of frames taken at a time: a sender that never pauses must not keep capture from its other work.
const MAX_FRAMES_PER_POLL: usize = 8;

/// Frames of another program, rectified: an endless source of the newest frame.
pub struct StreamSource {
    name: String,
    /// Before `feed`, so dropped first: a program ends when its stream is closed.
    stream: Option<UnixStream>,
    feed: Feed,
    reader: FrameReader,
    rectifier: Rectifier,
    held: Option<(StreamHeader, FrameStamp)>,
    /// The picture of the held frame.
    picture: Vec<u8>,
    numbers: FrameNumbers,
    losses: FrameLosses,
    notice: Option<Notice>,
    /// Why the last sender was disconnected.
    fault: Option<String>,
    stall_s: f64,
    /// When the last frame arrived, or its sender connected.
    newest_nanos: i64,
    order: StampOrder,
    has_streamed: bool,
}

/// Receives frames that a program sends to the socket at `path`; `stall_s`: silence that counts as absence, seconds.
pub fn open_socket(
    path: &Path,
    rig: Option<&Path>,
    stall_s: f64,
) -> Result<StreamSource, SourceError> {
    let name = format!("stream:{}", path.display());
    StreamSource::new(name, Feed::Socket(Listener::new(path.to_owned())), rig, stall_s)
}

/// Receives the images of a ROS 2 topic through `semidense-bridge`.
pub fn open_ros2(
    topic: &str,
    rig: Option<&Path>,
    stall_s: f64,
) -> Result<StreamSource, SourceError> {
    let name = format!("ros2:{topic}");
    let arguments = vec![BRIDGE_COMMAND.to_owned(), topic.to_owned()];
    StreamSource::new(name, Feed::Program(Program::new(bridge(), arguments)), rig, stall_s)
}

/// The program next to this one, else the one on `PATH`.
fn bridge() -> PathBuf {
    let beside = std::env::current_exe().ok().map(|own| own.with_file_name(BRIDGE));
    beside.filter(|path| path.is_file()).unwrap_or_else(|| PathBuf::from(BRIDGE))
}

fn nanos_of(clock: ClockId) -> i64 {
    let now = clock_gettime(clock);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
}

impl StreamSource {
    fn new(
        name: String,
        feed: Feed,
        rig: Option<&Path>,
        stall_s: f64,
    ) -> Result<Self, SourceError> {
        let path = rig.ok_or_else(|| SourceError::Camera {
            name: name.clone(),
            reason: "needs a rig file with the camera's calibration: name it with --rig FILE"
                .to_owned(),
        })?;
        let rectifier = Rectifier::new(&Rig::read(path)?, path)?;
        let Intrinsics { width, height, .. } = rectifier.intrinsics();
        Ok(Self {
            name,
            stream: None,
            feed,
            reader: FrameReader::new((width as u32, height as u32)),
            rectifier,
            held: None,
            picture: Vec::new(),
            numbers: FrameNumbers::default(),
            losses: FrameLosses::default(),
            notice: None,
            fault: None,
            stall_s,
            newest_nanos: i64::MIN,
            order: StampOrder::default(),
            has_streamed: false,
        })
    }

    fn failed(&self, reason: String) -> SourceError {
        SourceError::Camera { name: self.name.clone(), reason }
    }

    /// Takes a sender that has connected, and everything that it has sent; returns the outcome.
    fn poll(&mut self, now: i64) -> Result<Arrival, SourceError> {
        match self.feed.connect(now) {
            Ok(Some(stream)) => self.take_sender(stream, now),
            Ok(None) => {}
            Err(absence) if absence.passes || self.has_streamed => {
                if self.stream.is_none() {
                    return Ok(Arrival::Absent(self.fault.clone().unwrap_or(absence.reason)));
                }
            }
            Err(absence) => return Err(self.failed(absence.reason)),
        }
        self.drain()?;
        if self.held.is_some() {
            self.has_streamed = true;
            return Ok(Arrival::Frame);
        }
        if self.stream.is_none() {
            let reason = self.fault.clone().unwrap_or_else(|| self.feed.absence());
            return Ok(Arrival::Absent(reason));
        }
        if self.is_silent(now) {
            let seconds = self.stall_s;
            return Ok(Arrival::Absent(format!("its sender has sent no frame for {seconds} s")));
        }
        Ok(Arrival::Nothing)
    }

    fn is_silent(&self, now: i64) -> bool {
        now.saturating_sub(self.newest_nanos) as f64 > self.stall_s * 1e9
    }

    /// One sender at a time: another only replaces one that has gone silent.
    fn take_sender(&mut self, stream: UnixStream, now: i64) {
        if self.stream.is_some() && !self.is_silent(now) {
            self.remark("another program tried to send frames and was refused".to_owned());
            return;
        }
        self.reader.restart();
        self.numbers.restart();
        self.stream = Some(stream);
        self.newest_nanos = now;
    }

    fn remark(&mut self, text: String) {
        self.notice = Some(Notice { text: format!("{}: {text}", self.name), is_warning: true });
    }

    /// Reads every complete frame and holds the newest valid one.
    fn drain(&mut self) -> Result<(), SourceError> {
        for _ in 0..MAX_FRAMES_PER_POLL {
            let Some(stream) = &mut self.stream else { return Ok(()) };
            match self.reader.read(stream) {
                Ok(Progress::Frame(header)) => self.hold_frame(header),
                Ok(Progress::Nothing) => return Ok(()),
                Ok(Progress::Closed) => self.disconnect_sender(None),
                Err(fault) => {
                    self.losses.broken += 1;
                    if matches!(fault, StreamFault::Size { .. }) && !self.has_streamed {
                        return Err(
                            self.failed(format!("{fault}; name a rig of that size with --rig"))
                        );
                    }
                    self.disconnect_sender(Some(fault.to_string()));
                }
            }
        }
        Ok(())
    }

    /// Closes the stream. A sender's fault, unless it just disconnected, is reported until another sender connects.
    fn disconnect_sender(&mut self, fault: Option<String>) {
        self.stream = None;
        self.feed.disconnected(nanos_of(ClockId::Monotonic));
        if let Some(fault) = &fault {
            self.remark(format!("{fault}; its sender was disconnected"));
        }
        self.fault = fault;
    }

    /// Holds a complete frame, in place of one that was not read.
    fn hold_frame(&mut self, header: StreamHeader) {
        let arrival_nanos = nanos_of(ClockId::Monotonic);
        self.newest_nanos = arrival_nanos;
        self.fault = None;
        // Losses are differences: the lower half of the number suffices.
        let (sequence, missing) = self.numbers.number(header.sequence as u32);
        self.losses.missing += missing;
        let (capture_nanos, clocks) = stamp_of(&header, arrival_nanos, nanos_of(ClockId::Realtime));
        if !self.order.accepts(capture_nanos) {
            self.losses.broken += 1;
            return;
        }
        let stamp = FrameStamp {
            sequence,
            capture_nanos,
            exposure_nanos: header.exposure_nanos,
            gain: header.gain,
            clocks: Some(clocks),
        };
        self.reader.swap_picture(&mut self.picture);
        if self.held.replace((header, stamp)).is_some() {
            self.losses.late += 1;
        }
    }
}

/// Returns the stamp that capture uses, and the instant by this machine's clocks. A wall-clock stamp is converted to
/// CLOCK_MONOTONIC by the difference between the two when the frame arrives.
fn stamp_of(header: &StreamHeader, arrival_nanos: i64, realtime_nanos: i64) -> (i64, FrameClocks) {
    let stamp = header.stamp_nanos;
    let to_realtime = realtime_nanos.saturating_sub(arrival_nanos);
    match header.clock {
        StreamClock::Monotonic => {
            let realtime_nanos = stamp.saturating_add(to_realtime);
            (stamp, FrameClocks { clock_nanos: stamp.min(arrival_nanos), realtime_nanos })
        }
        StreamClock::Realtime => {
            let clock_nanos = stamp.saturating_sub(to_realtime);
            let clocks =
                FrameClocks { clock_nanos: clock_nanos.min(arrival_nanos), realtime_nanos: stamp };
            (clock_nanos, clocks)
        }
        StreamClock::Other => {
            (stamp, FrameClocks { clock_nanos: arrival_nanos, realtime_nanos: stamp })
        }
    }
}

impl FrameSource for StreamSource {
    fn intrinsics(&self) -> Intrinsics {
        self.rectifier.intrinsics()
    }

    fn camera(&self) -> CameraModel {
        *self.rectifier.camera()
    }

    fn readout_s(&self) -> Option<f64> {
        Some(self.rectifier.readout_s())
    }

    fn rectified(&self, raw: &[u8]) -> Vec<u8> {
        self.rectifier.rectified(raw)
    }

    fn await_frame(&mut self, wake: BorrowedFd<'_>, millis: u32) -> Result<Arrival, SourceError> {
        let now = nanos_of(ClockId::Monotonic);
        if self.poll(now)? == Arrival::Frame {
            return Ok(Arrival::Frame);
        }
        let retry_millis = self.feed.retry_nanos().filter(|_| self.stream.is_none()).map(|retry| {
            u32::try_from(retry.saturating_sub(now).max(0) / 1_000_000 + 1).unwrap_or(u32::MAX)
        });
        let stream = self.stream.as_ref().map(AsFd::as_fd);
        let descriptors = [Some(wake), self.feed.descriptor(), stream];
        let millis = millis.min(retry_millis.unwrap_or(u32::MAX));
        await_readable(descriptors.into_iter().flatten(), millis);
        self.poll(nanos_of(ClockId::Monotonic))
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        self.check_buffer(pixels)?;
        let (header, stamp) = loop {
            if let Some(held) = self.held.take() {
                break held;
            }
            match self.poll(nanos_of(ClockId::Monotonic))? {
                Arrival::Frame => {}
                Arrival::Absent(reason) if self.stream.is_none() && self.has_streamed => {
                    return Err(self.failed(reason));
                }
                _ => {
                    let stream = self.stream.as_ref().map(AsFd::as_fd);
                    let descriptors = [self.feed.descriptor(), stream];
                    await_readable(descriptors.into_iter().flatten(), READ_MILLIS);
                }
            }
        };
        let bytes = self.picture.get(..header.bytes as usize).unwrap_or(&[]);
        let stride = header.stride as usize;
        self.rectifier.unpack_into(header.format, bytes, stride, pixels).map_err(|broken| {
            self.losses.broken += 1;
            SourceError::BrokenFrame { name: self.name.clone(), reason: broken.to_string() }
        })?;
        Ok(Some(stamp))
    }

    fn skip_to(&mut self, _sequence: u64) -> Result<(), SourceError> {
        // A sender's numbers start anew with every receiver.
        Ok(())
    }

    fn losses(&self) -> Option<FrameLosses> {
        Some(self.losses)
    }

    fn take_notice(&mut self) -> Option<Notice> {
        self.notice.take()
    }
}

#[cfg(test)]
mod tests;
