//! A camera that appears and disappears: opened, streaming, lost, opened again.
//!
//! Nothing here waits longer than requested, and nothing that happens to the camera is an error, with one exception: a
//! camera that has never delivered a frame and never can is a matter for the user.

use std::collections::VecDeque;
use std::os::fd::BorrowedFd;
use std::path::PathBuf;

use rustix::io::Errno;

use super::controls::{self, Exposure};
use super::kernel::FLAG_ERROR;
use super::negotiation::{Grant, NegotiationError, StreamRequest, negotiate, rate_differs};
use super::params::CameraParams;
use super::stamps::{FrameNumbers, MAX_REFUSED_IN_A_ROW, taken};
use super::video_device::{Filled, OpenFailure, VideoDevice, VideoSystem};
use crate::capture::source::{Absence, Arrival, FrameLosses, FrameStamp, Notice};

/// Pause before the first attempt to reopen a camera.
const FIRST_PAUSE_NANOS: i64 = 100_000_000;
/// A camera that streamed this long did not fail at its start: the pauses start anew.
const HEALTHY_NANOS: i64 = 2_000_000_000;
/// Interval at which a value that the camera changes is read: a request to a USB camera takes a millisecond.
const EXPOSURE_PERIOD_NANOS: i64 = 200_000_000;
/// Pause after a wake-up without a frame.
const IDLE_PAUSE_MILLIS: u32 = 1;
/// Maximum number of notices kept: a camera that complains forever is heard often enough.
const MAX_NOTICES: usize = 16;

/// A frame held for its reader.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldFrame {
    /// Its buffer.
    pub filled: Filled,
    /// Its stamp.
    pub stamp: FrameStamp,
}

struct Stream<D> {
    path: PathBuf,
    device: D,
    grant: Grant,
    num_buffers: usize,
    /// Buffers to be returned to the driver.
    idle: Vec<usize>,
    since_nanos: i64,
    /// When the newest frame that is a picture was released, or one arrived that was refused for its stamp alone.
    newest_nanos: i64,
    /// Whether a damaged frame, or one that is no picture, has arrived since.
    is_damaged: bool,
    /// Whether the frame released last was no picture.
    is_unreadable: bool,
    exposure: Exposure,
    exposure_nanos: i64,
    lock_is_due: bool,
    held: Option<HeldFrame>,
}

enum State<D> {
    Absent { retry_nanos: i64, reason: String },
    Streaming(Box<Stream<D>>),
}

/// A camera by its name.
pub struct Camera<S: VideoSystem> {
    system: S,
    name: String,
    params: CameraParams,
    requested: StreamRequest,
    state: State<S::Device>,
    pause_nanos: i64,
    numbers: FrameNumbers,
    losses: FrameLosses,
    notices: VecDeque<Notice>,
    has_streamed: bool,
    is_stamped: bool,
    last_nanos: Option<i64>,
    /// Frames refused since the last valid one.
    refused_in_a_row: u32,
}

impl<S: VideoSystem> Camera<S> {
    /// Creates a camera that is not open yet.
    pub fn new(system: S, name: String, params: CameraParams, requested: StreamRequest) -> Self {
        Self {
            system,
            name,
            params,
            requested,
            state: State::Absent { retry_nanos: i64::MIN, reason: "not opened yet".to_owned() },
            pause_nanos: FIRST_PAUSE_NANOS,
            numbers: FrameNumbers::default(),
            losses: FrameLosses::default(),
            notices: VecDeque::new(),
            has_streamed: false,
            is_stamped: true,
            last_nanos: None,
            refused_in_a_row: 0,
        }
    }

    /// Returns the losses so far.
    pub fn losses(&self) -> FrameLosses {
        self.losses
    }

    /// Takes the oldest remark.
    pub fn take_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    /// Waits up to `millis` for a frame, or until `wake` can be read. An error, with the reason, if the camera can
    /// never be used.
    pub fn await_frame(
        &mut self,
        wake: Option<BorrowedFd<'_>>,
        millis: u32,
    ) -> Result<Arrival, String> {
        let outcome = match &mut self.state {
            State::Absent { retry_nanos, reason } => {
                let left = retry_nanos.saturating_sub(self.system.now_nanos());
                if left > 0 {
                    let left_millis = u32::try_from(left / 1_000_000 + 1).unwrap_or(u32::MAX);
                    let reason = reason.clone();
                    self.system.pause(wake, millis.min(left_millis));
                    return Ok(Arrival::Absent(reason));
                }
                self.open().map(|()| Arrival::Nothing)
            }
            State::Streaming(_) => self.poll(wake, millis),
        };
        match outcome {
            Ok(arrival) => Ok(arrival),
            Err(absence) if absence.passes || self.has_streamed => Ok(self.retire(absence.reason)),
            Err(absence) => Err(absence.reason),
        }
    }

    /// Closes the camera, to be reopened after a pause.
    fn retire(&mut self, reason: String) -> Arrival {
        let now = self.system.now_nanos();
        if let State::Streaming(stream) = &self.state {
            self.numbers.restart();
            if now.saturating_sub(stream.since_nanos) >= HEALTHY_NANOS {
                self.pause_nanos = FIRST_PAUSE_NANOS;
            }
        }
        let retry_nanos = now.saturating_add(self.pause_nanos);
        let longest = (self.params.retry_s * 1e9) as i64;
        self.pause_nanos = self.pause_nanos.saturating_mul(2).min(longest);
        self.state = State::Absent { retry_nanos, reason: reason.clone() };
        Arrival::Absent(reason)
    }

    fn warn(&mut self, text: String) {
        note(&mut self.notices, text, true);
    }

    /// Opens the camera and starts streaming.
    fn open(&mut self) -> Result<(), Absence> {
        let (path, mut device) =
            self.system.open(&self.name).map_err(|failure| open_failure(&self.name, failure))?;
        let at = |reason: String| format!("{}: {reason}", path.display());
        let refused = |error: Errno| Absence::transient(at(refusal(error, &path.display())));
        let grant = negotiate(&mut device, &self.requested).map_err(|error| match error {
            NegotiationError::Device(error) => refused(error),
            error @ NegotiationError::Size { .. } => Absence {
                reason: at(format!("{error}; name a rig of a size that it offers with --rig")),
                passes: false,
            },
            error => Absence { reason: at(error.to_string()), passes: false },
        })?;
        if rate_differs(self.requested.rate_hz, grant.rate_hz) {
            let (wanted, granted) =
                (self.requested.rate_hz.unwrap_or(0.0), grant.rate_hz.unwrap_or(0.0));
            let text =
                format!("{wanted:.1} frames per second were requested, {granted:.1} are granted");
            self.warn(at(text));
        }
        for refusal in controls::apply(&mut device, &self.params) {
            self.warn(at(refusal));
        }
        let num_buffers = device.make_buffers(self.params.buffers).map_err(refused)?;
        if num_buffers < 2 {
            return Err(Absence::transient(at(format!(
                "its driver allocates {num_buffers} buffers, two are needed"
            ))));
        }
        for index in 0..num_buffers {
            device.enqueue(index).map_err(refused)?;
        }
        device.start().map_err(refused)?;
        let now = self.system.now_nanos();
        let rate = grant.rate_hz.map_or("unknown rate".to_owned(), |rate| format!("{rate:.1} Hz"));
        let text = format!(
            "{}x{} {}, {rate}, {num_buffers} buffers",
            self.requested.width,
            self.requested.height,
            grant.format.code()
        );
        note(&mut self.notices, at(text), false);
        let exposure = controls::exposure(&device);
        self.state = State::Streaming(Box::new(Stream {
            path,
            device,
            grant,
            num_buffers,
            idle: Vec::with_capacity(num_buffers),
            since_nanos: now,
            newest_nanos: now,
            is_damaged: false,
            is_unreadable: false,
            exposure,
            exposure_nanos: now,
            lock_is_due: controls::has_locks(&self.params),
            held: None,
        }));
        Ok(())
    }

    /// Checks a streaming camera once.
    fn poll(&mut self, wake: Option<BorrowedFd<'_>>, millis: u32) -> Result<Arrival, Absence> {
        let State::Streaming(stream) = &mut self.state else { return Ok(Arrival::Nothing) };
        if stream.held.is_some() {
            return Ok(Arrival::Frame);
        }
        // Before the next frame, which may be no picture either.
        if stream.is_unreadable {
            stream.check_stall(self.system.now_nanos(), self.params.stall_s)?;
        }
        stream.return_idle()?;
        self.update_exposure();
        let State::Streaming(stream) = &mut self.state else { return Ok(Arrival::Nothing) };
        let is_ready = stream.device.wait(wake, millis).map_err(|error| stream.absence(error))?;
        if is_ready && self.drain()? == 0 {
            // A driver that wakes for nothing must not turn this into a loop that never sleeps.
            self.system.pause(wake, IDLE_PAUSE_MILLIS);
        }
        let now = self.system.now_nanos();
        let State::Streaming(stream) = &mut self.state else { return Ok(Arrival::Nothing) };
        if let Some(held) = stream.held {
            self.has_streamed = true;
            self.last_nanos = Some(held.stamp.capture_nanos);
            return Ok(Arrival::Frame);
        }
        stream.check_stall(now, self.params.stall_s)?;
        Ok(Arrival::Nothing)
    }

    /// Locks the settings to be locked once the camera has settled, and reads the exposure again if the camera changes
    /// it: also after a frame has been delivered, not only when none arrives.
    fn update_exposure(&mut self) {
        let now = self.system.now_nanos();
        let State::Streaming(stream) = &mut self.state else { return };
        let mut notices = Vec::new();
        if stream.lock_is_due
            && now.saturating_sub(stream.since_nanos) as f64 >= self.params.settle_s * 1e9
        {
            stream.lock_is_due = false;
            notices = controls::lock(&mut stream.device, &self.params);
            stream.exposure = controls::exposure(&stream.device);
        }
        if stream.exposure.changes
            && now.saturating_sub(stream.exposure_nanos) >= EXPOSURE_PERIOD_NANOS
        {
            stream.exposure_nanos = now;
            stream.exposure = controls::exposure(&stream.device);
        }
        notices.into_iter().for_each(|text| self.warn(text));
    }

    /// Takes every filled buffer and holds the newest valid one; returns how many there were.
    fn drain(&mut self) -> Result<usize, Absence> {
        let State::Streaming(stream) = &mut self.state else { return Ok(0) };
        let mut count = 0;
        let arrival_nanos = self.system.now_nanos();
        let offset_nanos = self.params.stamp_offset_us.saturating_mul(1000);
        // A camera may fill buffers as fast as they are taken: no more than all buffers twice.
        for _ in 0..2 * stream.num_buffers {
            let filled = match stream.device.dequeue() {
                Ok(filled) => filled,
                Err(Errno::AGAIN) => break,
                Err(error) => return Err(stream.absence(error)),
            };
            count += 1;
            let is_damaged = filled.flags & FLAG_ERROR != 0;
            stream.is_damaged |= is_damaged;
            let (sequence, missing) = self.numbers.number(filled.sequence);
            self.losses.missing += missing;
            let mut taken = taken(&filled, arrival_nanos, stream.exposure.nanos, offset_nanos);
            let before = stream.held.map(|held| held.stamp.capture_nanos).or(self.last_nanos);
            if !taken.is_stamped || self.refused_in_a_row >= MAX_REFUSED_IN_A_ROW {
                // Frames fetched together have arrived together; and a driver whose stamps have gone back for good must
                // not be refused forever.
                taken.nanos =
                    before.map_or(taken.nanos, |before| taken.nanos.max(before.saturating_add(1)));
            }
            let is_old = before.is_some_and(|before| taken.nanos <= before);
            if is_old && !is_damaged {
                stream.saw_picture(arrival_nanos);
            }
            let is_broken = is_damaged || is_old;
            self.refused_in_a_row = if is_broken { self.refused_in_a_row + 1 } else { 0 };
            if is_broken {
                self.losses.broken += 1;
                stream.idle.push(filled.index);
                stream.return_idle()?;
                continue;
            }
            let stamp = FrameStamp {
                sequence,
                capture_nanos: taken.nanos,
                exposure_nanos: stream.exposure.nanos,
                gain: stream.exposure.gain,
                clocks: None,
            };
            if let Some(older) = stream.held.replace(HeldFrame { filled, stamp }) {
                self.losses.late += 1;
                stream.idle.push(older.filled.index);
                stream.return_idle()?;
            }
            if self.is_stamped && !taken.is_stamped {
                let text = "its driver's stamps are not from CLOCK_MONOTONIC; frames are stamped as they arrive";
                note(&mut self.notices, format!("{}: {text}", stream.path.display()), true);
            }
            self.is_stamped = taken.is_stamped;
        }
        Ok(count)
    }

    /// The held frame, its layout and its bytes: those that the driver reports as filled, none if it reports more than
    /// there are.
    pub fn held(&self) -> Option<(HeldFrame, Grant, &[u8])> {
        let State::Streaming(stream) = &self.state else { return None };
        let held = stream.held?;
        let memory = stream.device.memory(held.filled.index);
        Some((held, stream.grant, memory.get(..held.filled.used).unwrap_or(&[])))
    }

    /// Returns the held frame's buffer to the driver; `is_broken` if it was not a picture.
    pub fn release(&mut self, is_broken: bool) {
        self.losses.broken += u64::from(is_broken);
        let now = self.system.now_nanos();
        let State::Streaming(stream) = &mut self.state else { return };
        match is_broken {
            true => (stream.is_damaged, stream.is_unreadable) = (true, true),
            false => stream.saw_picture(now),
        }
        if let Some(held) = stream.held.take() {
            stream.idle.push(held.filled.index);
            // A refusal is retried at the next check, which also reports it.
            let _ = stream.return_idle();
        }
    }
}

fn note(notices: &mut VecDeque<Notice>, text: String, is_warning: bool) {
    if notices.len() < MAX_NOTICES {
        notices.push_back(Notice { text, is_warning });
    }
}

impl<D: VideoDevice> Stream<D> {
    fn saw_picture(&mut self, nanos: i64) {
        self.newest_nanos = nanos;
        (self.is_damaged, self.is_unreadable) = (false, false);
    }

    /// An absence where there has been no picture for longer than `stall_s`, seconds.
    fn check_stall(&self, now: i64, stall_s: f64) -> Result<(), Absence> {
        if now.saturating_sub(self.newest_nanos) as f64 <= stall_s * 1e9 {
            return Ok(());
        }
        let path = self.path.display();
        let what = if self.is_damaged { "only damaged frames" } else { "no frame" };
        Err(Absence::transient(format!("{path}: has delivered {what} for {stall_s} s")))
    }

    /// Returns idle buffers to the driver. One that it refuses is kept for the next check; a driver that has none left,
    /// or is gone, is an absence.
    fn return_idle(&mut self) -> Result<(), Absence> {
        let mut refused = None;
        let device = &mut self.device;
        self.idle.retain(|&index| {
            let answer = device.enqueue(index);
            refused = answer.err().or(refused);
            answer.is_err()
        });
        match refused {
            Some(error @ (Errno::NODEV | Errno::NXIO)) => Err(self.absence(error)),
            Some(error) if self.idle.len() >= self.num_buffers => Err(self.absence(error)),
            _ => Ok(()),
        }
    }

    fn absence(&self, error: Errno) -> Absence {
        let path = self.path.display();
        Absence::transient(format!("{path}: {}", refusal(error, &path)))
    }
}

/// Explains an error of the kernel for a camera, and what to do.
fn refusal(error: Errno, path: &dyn std::fmt::Display) -> String {
    match error {
        Errno::BUSY => format!("in use by another program, which `fuser {path}` names; stop it"),
        Errno::NODEV | Errno::NXIO | Errno::NOENT => "unplugged; plug it in again".to_owned(),
        Errno::ACCESS | Errno::PERM => {
            "no permission to open it; run `usermod -aG video USER` and log in again, or set SupplementaryGroups=video in the unit"
                .to_owned()
        }
        Errno::NOSPC => "the USB bus has no bandwidth left; use another port, a lower rate, or mjpeg".to_owned(),
        Errno::IO => "its driver reports a fault of the device or the cable".to_owned(),
        error => format!("its driver refused the request ({error})"),
    }
}

fn open_failure(name: &str, failure: OpenFailure) -> Absence {
    match failure {
        OpenFailure::Missing => Absence::transient(format!(
            "there is no camera {name}; plug it in (`semidense cameras` lists the cameras)"
        )),
        OpenFailure::Refused(path, error) => {
            Absence::transient(format!("{}: {}", path.display(), refusal(error, &path.display())))
        }
        OpenFailure::Ambiguous(paths) => {
            let names: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
            let reason =
                format!("{name} is ambiguous: it may be {}; name one of them", names.join(" or "));
            Absence { reason, passes: false }
        }
    }
}

#[cfg(test)]
mod tests;
