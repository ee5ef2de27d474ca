//! `semidense-bridge record`: writes an instance's topics to an MCAP file.

use std::io::Write;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Args;
use semidense::service::shutdown::Shutdown;

use crate::command::{CommandResult, CommonArguments, note, number_within};
use crate::record::queue::{QueueSender, queue};
use crate::record::recorder::{RecordParams, RecordSummary, Recorder};
use crate::ros::encoder::Moment;
use crate::ros::images::ImageFormat;
use crate::session::{Event, Session, Wants};

/// Bytes that may be queued for the disk: two seconds of a 640x480 camera at 100 Hz.
const QUEUE_BYTES: u64 = 64 << 20;
/// Upper limit for a wait for messages, hence the resolution of `--duration`.
const WAIT: Duration = Duration::from_millis(100);
/// How long to wait for an instance before printing a notice.
const PATIENCE: Duration = Duration::from_secs(1);

/// Record what a running instance publishes to an MCAP file
#[derive(Debug, Args)]
#[command(
    after_help = "Records images, poses with covariance, odometry, tf, keyframes as point clouds, the map's graph and \
                  health, as ROS 2 messages: Foxglove, rerun and `ros2 bag play` open the file, and `semidense replay \
                  mcap:FILE` computes it again.\n\n\
                  Waits for an instance, and ends with it, by Ctrl-C or after --duration. Killed, it leaves all but \
                  the last second.\n\n\
                  Examples:\n  semidense record --output run.mcap\n  \
                  semidense record --output run.mcap --images jpeg --duration 60\n  \
                  semidense record --output recordings/ --max-bytes 2000000000"
)]
pub struct RecordArguments {
    /// File to write, which must not exist; for a folder, a file in it named after the instance and the time
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    /// Format of the images
    #[arg(long, value_enum, default_value_t = ImageFormat::Png)]
    images: ImageFormat,
    /// Stop after this many seconds of recording
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    duration: Option<Duration>,
    /// Start a new file (run_1.mcap, run_2.mcap, …) when one has reached this many bytes
    #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u64).range(1_000_000..))]
    max_bytes: Option<u64>,
    /// Start a new file when one has reached this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    max_duration: Option<Duration>,
}

/// Parses a positive number of seconds.
fn parse_seconds(text: &str) -> Result<Duration, String> {
    /// A year: anything longer is a mistake.
    const MAX_SECS: f64 = 366.0 * 86_400.0;
    let wanted = "needs a number of seconds above 0";
    number_within(text, f64::MIN_POSITIVE..=MAX_SECS, wanted).map(Duration::from_secs_f64)
}

/// Records until the instance ends, a signal arrives or the time is over.
pub fn run(common: &CommonArguments, arguments: &RecordArguments) -> CommandResult {
    let place = common.place()?;
    let instance = place.instance.clone();
    let params = RecordParams {
        output: output_file(&arguments.output, &instance)?,
        instance,
        images: arguments.images,
        max_bytes: arguments.max_bytes,
        max_duration: arguments.max_duration,
    };
    let shutdown = Shutdown::install()?;
    let wants = Wants {
        frames: params.images != ImageFormat::None,
        keyframes: true,
        graph: true,
        ..Wants::default()
    };
    let mut session = Session::new(place, "record", wants);
    let output = params.output.clone();
    let recorder = Recorder::create(params)?;
    let (sender, receiver) = queue(QUEUE_BYTES);
    let thread = std::thread::Builder::new().name("recorder".to_owned());
    let writing = thread.spawn(move || recorder.run(&receiver))?;
    let began = read(&mut session, &sender, arguments.duration, &shutdown);
    let counts = sender.counts.clone();
    drop(sender);
    let summary = writing.join().map_err(|_| "the recorder's thread failed")?;
    let began = began?;
    if let (None, Ok(_)) = (began, &summary) {
        // Nothing was recorded: do not leave an empty file behind.
        std::fs::remove_file(&output)?;
        let why =
            session.obstacle().unwrap_or("no instance was running; start one with `semidense run`");
        return Err(format!("nothing was recorded: {why}").into());
    }
    print(&summary?, began, counts.dropped());
    Ok(ExitCode::SUCCESS)
}

/// Reads until the end and returns when recording started; `None` if no instance appeared.
fn read(
    session: &mut Session,
    sender: &QueueSender,
    duration: Option<Duration>,
    shutdown: &Shutdown,
) -> Result<Option<Instant>, crate::session::SessionError> {
    let started = Instant::now();
    let (mut began, mut has_ended, mut has_said) = (None, false, false);
    while !shutdown.is_requested() && !has_ended {
        session.read(Some(shutdown.descriptor()), WAIT, |event| {
            let moment = Moment::now();
            has_ended |= matches!(event, Event::Left);
            began.get_or_insert(moment.instant);
            has_ended |= !sender.put(moment, event);
        })?;
        if began.is_none() && !has_said && started.elapsed() > PATIENCE {
            has_said = true;
            // Another reason has been logged.
            if session.obstacle().is_none() {
                note("waiting for an instance: start one with `semidense run`");
            }
        }
        has_ended |= duration.zip(began).is_some_and(|(most, began)| began.elapsed() >= most);
    }
    Ok(began)
}

/// Path of the recording; in a folder, named after the instance and the time.
fn output_file(output: &Path, instance: &str) -> Result<PathBuf, String> {
    if output.is_dir() {
        let nanos = Moment::now().realtime_nanos;
        return Ok(output.join(format!("{instance}-{}.mcap", nanos / 1_000_000_000)));
    }
    let is_folder = output.as_os_str().as_bytes().ends_with(b"/");
    let folder = if is_folder { Some(output) } else { output.parent() };
    match folder.filter(|folder| !folder.as_os_str().is_empty() && !folder.exists()) {
        Some(folder) => Err(format!(
            "--output {}: there is no folder {}; create it, or name another one",
            output.display(),
            folder.display()
        )),
        None => Ok(output.to_owned()),
    }
}

fn print(summary: &RecordSummary, began: Option<Instant>, dropped: u64) {
    let count = |names: &[&str]| -> u64 {
        names.iter().filter_map(|name| summary.messages.get(name)).sum()
    };
    let files: Vec<String> = summary.files.iter().map(|file| file.display().to_string()).collect();
    let seconds = began.map_or(0.0, |began| began.elapsed().as_secs_f64());
    // Standard output may be closed by now.
    let _ = writeln!(
        std::io::stdout(),
        "{}: {seconds:.1} s, {:.1} MB: {} images, {} poses, {} clouds, {dropped} dropped",
        files.join(", "),
        summary.bytes as f64 / 1e6,
        count(&["image_rect", "image_rect/compressed"]),
        count(&["details/pose"]),
        count(&["points"]),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_folder_for_the_recording_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| output_file(&folder.path().join(name), "front");
        assert_eq!(at("run.mcap"), Ok(folder.path().join("run.mcap")));
        assert!(at("").unwrap().to_string_lossy().contains("/front-"));
        for (name, missing) in [("new/", "new/"), ("new/run.mcap", "new")] {
            let missing = format!("there is no folder {}/{missing};", folder.path().display());
            let error = at(name).unwrap_err();
            assert!(error.contains(&missing), "{error}");
        }
        assert_eq!(output_file(Path::new("run.mcap"), "front"), Ok("run.mcap".into()));
    }
}
