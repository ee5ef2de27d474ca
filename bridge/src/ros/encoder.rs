//! Encodes a session's events as ROS messages, one topic at a time, for recordings and Foxglove.

use std::time::Instant;

use semidense::slam::keyframe::Keyframe;
use serde::Serialize;

use crate::keyframe_pace::KeyframePace;
use crate::ros::cdr::encode_into;
use crate::ros::converter::Converter;
use crate::ros::frame_ids::FrameIds;
use crate::ros::images::{CompressError, ImageFormat, jpeg, png};
use crate::ros::message::{CompressedImage, Header, Time};
use crate::ros::own_message::{FrameRecord, GraphRecord, KeyframeRecord, PoseRecord};
use crate::ros::topic::{
    CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTICS, FRAME_RECORDS, GRAPH_RECORDS, IMAGE,
    KEYFRAME_RECORDS, KEYFRAMES, ODOMETRY, POINTS, POSE, POSE_RECORDS, RosTopic, TF,
};
use crate::session::{Event, Frame, Graph, Pose};

/// When an event was read.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    /// For measuring periods.
    pub instant: Instant,
    /// CLOCK_REALTIME, for stamps.
    pub realtime_nanos: i64,
}

impl Moment {
    /// The current time.
    pub fn now() -> Self {
        Self { instant: Instant::now(), realtime_nanos: realtime_nanos() }
    }
}

/// CLOCK_REALTIME, nanoseconds.
pub fn realtime_nanos() -> i64 {
    let since_epoch = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX)
}

/// One encoded message.
#[derive(Debug, Clone, Copy)]
pub struct Encoded<'a> {
    /// Its topic.
    pub topic: &'static RosTopic,
    /// The stamp of its content.
    pub stamp: Time,
    /// CLOCK_REALTIME when the content was read, nanoseconds.
    pub read_nanos: i64,
    /// Its bytes, with the CDR header.
    pub bytes: &'a [u8],
}

/// Why a message cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// An image cannot be compressed.
    #[error(transparent)]
    Image(#[from] CompressError),
    /// A message cannot be encoded.
    #[error("a message cannot be encoded: {0}")]
    Message(#[from] cdr_encoding::Error),
}

/// A consumer of messages.
pub trait Sink {
    /// Why it cannot accept a message.
    type Error: From<EncodeError>;

    /// Whether this topic has a subscriber: topics without one are not encoded.
    fn wants(&self, topic: &'static RosTopic) -> bool;

    /// Takes a message.
    fn put(&mut self, message: Encoded<'_>) -> Result<(), Self::Error>;
}

/// Encodes the events of one instance; it must see all of them, in order.
#[derive(Debug)]
pub struct EventEncoder {
    converter: Converter,
    images: ImageFormat,
    pace: KeyframePace,
    /// CLOCK_REALTIME when the current event was read.
    read_nanos: i64,
    bytes: Vec<u8>,
}

impl EventEncoder {
    /// An encoder for an instance.
    pub fn new(instance: &str, images: ImageFormat) -> Self {
        let converter = Converter::new(instance, FrameIds::of_instance(instance));
        let pace = KeyframePace::default();
        Self { converter, images, pace, read_nanos: 0, bytes: Vec::new() }
    }

    /// Puts the messages of an event into `sink`.
    pub fn put<S: Sink>(
        &mut self,
        event: &Event,
        now: Moment,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        self.converter.observe(event);
        self.read_nanos = now.realtime_nanos;
        let read = Time::from_nanos(self.read_nanos);
        match event {
            Event::Frame(frame) => self.put_frame(frame, sink),
            Event::Pose(pose) => self.put_pose(pose, sink),
            Event::Keyframe(keyframe) => {
                let ready = self.pace.take(keyframe.clone(), now.instant);
                ready.iter().try_for_each(|keyframe| self.put_keyframe(keyframe, sink))
            }
            Event::Graph(graph) => self.put_graph(graph, sink),
            Event::Health(owner, health) => self.offer(&DIAGNOSTICS, read, sink, |converter| {
                converter.diagnostics(owner, health, read)
            }),
            Event::Left => self.put_waiting(sink),
            Event::Joined | Event::Adjustment(_) => Ok(()),
        }
    }

    /// Puts pending messages into `sink`, at the end.
    pub fn finish<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        self.read_nanos = realtime_nanos();
        self.put_waiting(sink)
    }

    /// Puts the last rare messages into `sink`, for a late subscriber.
    pub fn put_last<S: Sink>(
        &mut self,
        keyframe: Option<&Keyframe>,
        graph: Option<&Graph>,
        sink: &mut S,
    ) -> Result<(), S::Error> {
        self.read_nanos = realtime_nanos();
        keyframe.map_or(Ok(()), |keyframe| self.put_keyframe(keyframe, sink))?;
        graph.map_or(Ok(()), |graph| self.put_graph(graph, sink))
    }

    fn put_waiting<S: Sink>(&mut self, sink: &mut S) -> Result<(), S::Error> {
        let waiting = self.pace.finish();
        waiting.map_or(Ok(()), |keyframe| self.put_keyframe(&keyframe, sink))
    }

    /// Encodes the message returned by `make` and puts it into `sink` if that wants the topic.
    pub fn offer<S: Sink, M: Serialize>(
        &mut self,
        topic: &'static RosTopic,
        stamp: Time,
        sink: &mut S,
        make: impl FnOnce(&Converter) -> M,
    ) -> Result<(), S::Error> {
        if !sink.wants(topic) {
            return Ok(());
        }
        encode_into(&make(&self.converter), &mut self.bytes).map_err(EncodeError::from)?;
        sink.put(Encoded { topic, stamp, read_nanos: self.read_nanos, bytes: &self.bytes })
    }

    fn put_frame<S: Sink>(&mut self, frame: &Frame, sink: &mut S) -> Result<(), S::Error> {
        if self.images == ImageFormat::None {
            return Ok(());
        }
        let header = self.converter.image_header(frame);
        let stamp = header.stamp;
        self.offer(&FRAME_RECORDS, stamp, sink, |_| {
            FrameRecord::new(header.clone(), &frame.header)
        })?;
        self.offer(&CAMERA_INFO, stamp, sink, |converter| converter.camera_info(frame))?;
        match self.images {
            ImageFormat::Raw => self.offer(&IMAGE, stamp, sink, |converter| converter.image(frame)),
            ImageFormat::Png | ImageFormat::Jpeg if sink.wants(&COMPRESSED_IMAGE) => {
                let image = compressed(self.images, frame, header).map_err(EncodeError::from)?;
                self.offer(&COMPRESSED_IMAGE, stamp, sink, |_| image)
            }
            _ => Ok(()),
        }
    }

    fn put_pose<S: Sink>(&mut self, pose: &Pose, sink: &mut S) -> Result<(), S::Error> {
        let header = self.converter.pose_header(pose);
        let stamp = header.stamp;
        self.offer(&POSE_RECORDS, stamp, sink, |_| PoseRecord::new(header, &pose.message))?;
        if ![&POSE, &ODOMETRY, &TF].into_iter().any(|topic| sink.wants(topic)) {
            return Ok(());
        }
        let Some(messages) = self.converter.pose(pose) else { return Ok(()) };
        self.offer(&TF, stamp, sink, |_| messages.transforms)?;
        self.offer(&POSE, stamp, sink, |_| messages.pose)?;
        self.offer(&ODOMETRY, stamp, sink, |_| messages.odometry)
    }

    fn put_keyframe<S: Sink>(&mut self, keyframe: &Keyframe, sink: &mut S) -> Result<(), S::Error> {
        let stamp = self.converter.stamp(keyframe.capture_nanos);
        self.offer(&POINTS, stamp, sink, |converter| converter.points(keyframe))?;
        self.offer(&KEYFRAME_RECORDS, stamp, sink, |converter| {
            KeyframeRecord::new(converter.map_header(stamp), keyframe)
        })
    }

    fn put_graph<S: Sink>(&mut self, graph: &Graph, sink: &mut S) -> Result<(), S::Error> {
        let read = Time::from_nanos(self.read_nanos);
        self.offer(&KEYFRAMES, read, sink, |converter| converter.keyframes(graph, read))?;
        self.offer(&GRAPH_RECORDS, read, sink, |converter| {
            GraphRecord::new(converter.map_header(read), graph)
        })
    }
}

/// A frame as PNG or JPEG.
fn compressed(
    format: ImageFormat,
    frame: &Frame,
    header: Header,
) -> Result<CompressedImage, CompressError> {
    let (width, height) = (frame.header.width, frame.header.height);
    let (name, data) = match format {
        ImageFormat::Jpeg => ("jpeg", jpeg(width, height, &frame.pixels)?),
        _ => ("png", png(width, height, &frame.pixels)?),
    };
    Ok(CompressedImage { header, format: name.to_owned(), data })
}
