//! The thread that writes queued events to one or several files.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::record::file::{RecordError, RecordingFile};
use crate::record::queue::{QueueCounts, QueueReceiver};
use crate::ros::diagnostics::{figure, report};
use crate::ros::encoder::{EventEncoder, Moment};
use crate::ros::images::ImageFormat;
use crate::ros::message::{DiagnosticArray, Time};
use crate::ros::topic::DIAGNOSTICS;
use crate::session::Event;

/// Settings of a recording.
#[derive(Debug, Clone)]
pub struct RecordParams {
    /// The file, or the first of several.
    pub output: PathBuf,
    /// The instance.
    pub instance: String,
    /// Format of the images.
    pub images: ImageFormat,
    /// A new file is started once one has this many bytes.
    pub max_bytes: Option<u64>,
    /// A new file is started once one is this long.
    pub max_duration: Option<Duration>,
}

/// Summary of a finished recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RecordSummary {
    /// The files.
    pub files: Vec<PathBuf>,
    /// Bytes of messages.
    pub bytes: u64,
    /// Number of messages by topic name.
    pub messages: BTreeMap<&'static str, u64>,
}

/// Writes events into files.
pub struct Recorder {
    params: RecordParams,
    encoder: EventEncoder,
    file: RecordingFile,
    /// Number of the last file.
    number: usize,
    began: Instant,
    summary: RecordSummary,
}

/// Path of the file with this number: `run.mcap`, `run_1.mcap`, …
fn numbered(path: &Path, number: usize) -> PathBuf {
    if number == 0 {
        return path.to_owned();
    }
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("_{number}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

impl Recorder {
    /// Creates the file.
    pub fn create(params: RecordParams) -> Result<Self, RecordError> {
        let file = RecordingFile::create(&params.output, &params.instance)?;
        let encoder = EventEncoder::new(&params.instance, params.images);
        let summary = RecordSummary::default();
        Ok(Self { params, encoder, file, number: 0, began: Instant::now(), summary })
    }

    /// Writes events until the queue's sender is gone.
    pub fn run(mut self, queue: &QueueReceiver) -> Result<RecordSummary, RecordError> {
        while let Some((moment, event)) = queue.take() {
            self.write(&event, moment, &queue.counts)?;
            self.split_if_due()?;
        }
        self.encoder.finish(&mut self.file)?;
        self.count();
        self.file.finish()?;
        Ok(self.summary)
    }

    fn write(
        &mut self,
        event: &Event,
        moment: Moment,
        counts: &QueueCounts,
    ) -> Result<(), RecordError> {
        self.encoder.put(event, moment, &mut self.file)?;
        // Once a second, together with the pipeline's health.
        if matches!(event, Event::Health("capture", _)) {
            let stamp = Time::from_nanos(moment.realtime_nanos);
            let status = own_status(&self.params.instance, stamp, counts, self.file.bytes);
            self.encoder.offer(&DIAGNOSTICS, stamp, &mut self.file, |_| status)?;
        }
        Ok(())
    }

    fn split_if_due(&mut self) -> Result<(), RecordError> {
        let is_full = self.params.max_bytes.is_some_and(|most| self.file.bytes >= most);
        let is_long = self.params.max_duration.is_some_and(|most| self.began.elapsed() >= most);
        if !is_full && !is_long {
            return Ok(());
        }
        let next = self.create_next()?;
        self.count();
        std::mem::replace(&mut self.file, next).finish()?;
        self.began = Instant::now();
        Ok(())
    }

    /// Creates the file with the next free number: an earlier recording may have left some.
    fn create_next(&mut self) -> Result<RecordingFile, RecordError> {
        loop {
            self.number += 1;
            let path = numbered(&self.params.output, self.number);
            match RecordingFile::create(&path, &self.params.instance) {
                Err(RecordError::Create { source, .. })
                    if source.kind() == ErrorKind::AlreadyExists => {}
                created => return created,
            }
        }
    }

    /// Adds the file to the summary.
    fn count(&mut self) {
        self.summary.files.push(self.file.path.clone());
        self.summary.bytes += self.file.bytes;
        for (name, count) in self.file.counts() {
            *self.summary.messages.entry(name).or_default() += u64::from(count);
        }
    }
}

/// State of the recording itself.
fn own_status(
    instance: &str,
    stamp: Time,
    counts: &QueueCounts,
    written_bytes: u64,
) -> DiagnosticArray {
    use std::sync::atomic::Ordering::Relaxed;
    let dropped = counts.dropped();
    let message =
        if dropped == 0 { "recording" } else { "messages were dropped: they arrived too fast" };
    let verdict = (u8::from(dropped > 0), message.to_owned());
    let values = vec![
        figure("dropped_images", counts.dropped_images.load(Relaxed)),
        figure("dropped_messages", counts.dropped_messages.load(Relaxed)),
        figure("queued_bytes", counts.bytes.load(Relaxed)),
        figure("written_bytes", written_bytes),
    ];
    report(instance, "record", stamp, verdict, values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_numbers_precede_the_extension() {
        assert_eq!(numbered(Path::new("a/run.mcap"), 0), Path::new("a/run.mcap"));
        assert_eq!(numbered(Path::new("a/run.mcap"), 2), Path::new("a/run_2.mcap"));
        assert_eq!(numbered(Path::new("run"), 1), Path::new("run_1"));
    }
}
