//! Images of a ROS 2 topic, written as a stream of frames for capture.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::BorrowedFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::pin::pin;
use std::thread;
use std::time::{Duration, Instant};

use futures::{FutureExt, StreamExt, executor::block_on};
use ros2_client::MessageInfo;
use ros2_client::dds::Subscription;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::stdio::stdout;
use semidense::capture::ros_topic::{camera_topic, is_rectified};
use semidense::capture::stream::format::StreamHeader;
use semidense::service::shutdown::Shutdown;
use serde::de::DeserializeOwned;

use crate::ros::encoder::realtime_nanos;
use crate::ros::message::{CameraInfo, CompressedImage, Image, RosMessage, Time};
use crate::ros::topic::{self, RosTopic};
use crate::ros2::camera_rig::{CameraRigError, rig_text};
use crate::ros2::image_source::{GrayFrame, ImageError};
use crate::ros2::node::{NodeError, RosNode};

/// Pause before retrying a missing socket or polling for a message again.
const RETRY_PERIOD: Duration = Duration::from_millis(100);

/// Why images cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The network cannot be joined.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// A system call failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// No publisher describes the camera.
    #[error(
        "no CameraInfo arrived on {topic} within {seconds} s; name the camera's calibration with --rig FILE, or its topic with --camera-info"
    )]
    NoInfo {
        /// The topic on which it was expected.
        topic: String,
        /// How long it was waited for.
        seconds: u64,
    },
    /// The camera's calibration cannot be used.
    #[error("{topic}: {source}")]
    Rig {
        /// The topic it came from.
        topic: String,
        /// What is wrong.
        source: CameraRigError,
    },
    /// A signal arrived first.
    #[error("interrupted")]
    Interrupted,
}

/// Quality of service of the subscription: that for sensors, compatible with any publisher.
const SENSOR: &RosTopic = &topic::IMAGE;

/// Waits for the CameraInfo of a topic's images and returns the text of its rig file.
pub fn await_rig(
    mut node: RosNode,
    images: &str,
    camera_info: Option<&str>,
    longest: Duration,
    shutdown: &Shutdown,
) -> Result<String, CameraError> {
    let topic = camera_info.map_or_else(|| camera_topic(images), str::to_owned);
    let infos = node.subscription::<CameraInfo>(SENSOR, &topic)?;
    let begin = Instant::now();
    loop {
        if let Ok(Some((info, _))) = infos.take() {
            let text = rig_text(&info, &topic, is_rectified(images));
            return text.map_err(|source| CameraError::Rig { topic, source });
        }
        if shutdown.is_requested() {
            return Err(CameraError::Interrupted);
        }
        if begin.elapsed() > longest {
            return Err(CameraError::NoInfo { topic, seconds: longest.as_secs() });
        }
        thread::sleep(RETRY_PERIOD);
    }
}

/// Writes the images of a topic as frames until a signal arrives or standard output is closed; a topic that
/// ends in `/compressed` has messages of type `CompressedImage`. With a `socket`, that of `semidense capture
/// stream:PATH`, frames are written there; a lost connection is re-established.
pub fn run(
    mut node: RosNode,
    topic: String,
    socket: Option<PathBuf>,
    shutdown: &Shutdown,
) -> Result<(), CameraError> {
    let is_stdout = socket.is_none();
    let sink = match socket {
        Some(path) => Sink::Socket(path, None),
        None => Sink::Stdout(File::from(stdout().try_clone_to_owned()?)),
    };
    let named = thread::Builder::new().name("images".to_owned());
    let reading = if topic.ends_with("/compressed") {
        let images = node.subscription::<CompressedImage>(SENSOR, &topic)?;
        named.spawn(move || forward(&images, &topic, GrayFrame::decode, sink))?
    } else {
        let images = node.subscription::<Image>(SENSOR, &topic)?;
        named.spawn(move || forward(&images, &topic, GrayFrame::unpack, sink))?
    };
    // The thread may wait for an image, or for capture, indefinitely; it ends with the process.
    while !reading.is_finished() && !shutdown.is_requested() {
        if is_closed(is_stdout, shutdown.descriptor()) {
            break;
        }
    }
    Ok(())
}

/// Waits briefly for a signal; returns whether standard output, if written to, is closed.
fn is_closed(is_stdout: bool, interrupt: BorrowedFd<'_>) -> bool {
    let timeout = rustix::event::Timespec { tv_sec: 0, tv_nsec: 200_000_000 };
    let mut polled = vec![PollFd::from_borrowed_fd(interrupt, PollFlags::IN)];
    if is_stdout {
        // A closed end is reported even without requested events.
        polled.push(PollFd::from_borrowed_fd(stdout(), PollFlags::empty()));
    }
    let _ = poll(&mut polled, Some(&timeout));
    let gone = PollFlags::HUP | PollFlags::ERR;
    polled.get(1).is_some_and(|output| output.revents().intersects(gone))
}

/// Repeatedly takes the newest image and writes it.
fn forward<M: RosMessage + DeserializeOwned + 'static>(
    images: &Subscription<M>,
    topic: &str,
    unpack: impl Fn(&mut GrayFrame, &M) -> Result<Time, ImageError>,
    mut sink: Sink,
) {
    let mut stream = pin!(images.async_stream());
    let mut frame = GrayFrame::default();
    let mut last_refusal = String::new();
    while let Some(first) = block_on(stream.next()) {
        let mut newest: Option<(M, MessageInfo)> = first.ok();
        while let Some(Some(next)) = stream.next().now_or_never() {
            newest = next.ok().or(newest);
        }
        let Some((image, info)) = newest else { continue };
        let stamp = match unpack(&mut frame, &image) {
            Ok(stamp) => stamp,
            Err(error) => {
                let refusal = error.to_string();
                // A camera with an unsupported format would be reported thirty times a second.
                if refusal != last_refusal {
                    tracing::warn!("{topic}: {refusal}");
                    last_refusal = refusal;
                }
                continue;
            }
        };
        // The publisher's number: a gap is an image that was lost, or skipped here for a newer one.
        let sequence = u64::try_from(info.sequence_number()).unwrap_or(0);
        let header = frame.header(stamp, sequence, realtime_nanos());
        if sink.write(&header, &frame.pixels).is_err() {
            return;
        }
    }
}

/// Destination of the frames.
#[derive(Debug)]
enum Sink {
    Stdout(File),
    Socket(PathBuf, Option<UnixStream>),
}

fn write_frame(to: &mut impl Write, header: &StreamHeader, pixels: &[u8]) -> io::Result<()> {
    to.write_all(&header.to_bytes())?;
    to.write_all(pixels)
}

impl Sink {
    /// Writes a frame. Without a connection, or if it breaks, the frame is lost: the next one is as good.
    fn write(&mut self, header: &StreamHeader, pixels: &[u8]) -> io::Result<()> {
        match self {
            Self::Stdout(file) => write_frame(file, header, pixels),
            Self::Socket(path, stream) => {
                if stream.is_none() {
                    *stream = UnixStream::connect(&*path)
                        .inspect_err(|error| tracing::debug!("{}: {error}", path.display()))
                        .ok();
                }
                let Some(open) = stream else {
                    thread::sleep(RETRY_PERIOD);
                    return Ok(());
                };
                if let Err(error) = write_frame(open, header, pixels) {
                    tracing::warn!("{}: {error}; reconnecting", path.display());
                    *stream = None;
                }
                Ok(())
            }
        }
    }
}
