//! Ground truth for a camera that replays a recording: vivid's output, looped to its capture node.
//!
//! ```sh
//! camera_loop feed tum:DIR HZ | v4l2-ctl -d /dev/video1 --stream-out-mmap --stream-from=-    # GREY, 640x480
//! camera_loop watch tum:DIR TRUTH       # while `semidense run --source v4l:…` reads the capture node
//! ```
//!
//! The recording has a quarter of the size; vivid's scaler copies pairs of pixels, so each pixel is repeated four
//! times. The node keeps the last picture it was given, so any pace will do: `feed` gives the next one once the mapper
//! has seen the last, however slow the machine is, and at most at the given rate. `watch` reads every frame that capture
//! sends, finds which picture it is, pixel for pixel, and writes that picture's true pose with the camera's stamp.

use std::collections::HashMap;
use std::error::Error;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source::FrameSource;
use semidense::service::shutdown::Shutdown;
use semidense::service::trajectory_file::write_trajectory;
use semidense::slam::trajectory::StampedPose;
use semidense::wire::message::{FrameHeader, StepMessage};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Subscriber, wait};
use semidense::wire::topic::{FRAME, STEP};

/// Factor by which the output's pictures are larger, along each side.
const SCALE: usize = 4;
/// Pixels that the scaler copies at a time.
const PAIR: usize = 2;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let outcome = match words.as_slice() {
        ["feed", source, rate] => feed(source, rate),
        ["watch", source, truth] => watch(source, truth),
        _ => Err("usage: camera_loop feed SOURCE HZ | watch SOURCE TRUTH".into()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("camera_loop: {error}");
            ExitCode::FAILURE
        }
    }
}

/// A picture of the recording: its stamp in nanoseconds, and its pixels.
type Picture = (i64, Vec<u8>);

/// All pictures of a recording.
fn pictures(source: &mut dyn FrameSource) -> Result<Vec<Picture>, Box<dyn Error>> {
    let k = source.intrinsics();
    let mut found = Vec::new();
    let mut pixels = vec![0; k.width * k.height];
    while let Some(stamp) = source.next_into(&mut pixels)? {
        found.push((stamp.capture_nanos, pixels.clone()));
    }
    Ok(found)
}

/// A picture in the size of the output node.
fn enlarged(pixels: &[u8], width: usize) -> Vec<u8> {
    let mut large = Vec::with_capacity(SCALE * SCALE * pixels.len());
    for row in pixels.chunks(width) {
        let row: Vec<u8> = row.chunks(PAIR).flat_map(|pair| pair.repeat(SCALE)).collect();
        (0..SCALE).for_each(|_| large.extend_from_slice(&row));
    }
    large
}

fn join() -> Result<Hub, Box<dyn Error>> {
    let instance = std::env::var("SEMIDENSE_INSTANCE").unwrap_or_else(|_| "semidense".to_owned());
    Ok(Hub::join(&Place::new(&instance, "")?, "camera_loop", Access::Observer)?)
}

/// The mapper's steps, once there are processes that it can be asked of.
#[derive(Default)]
struct Steps(Option<(Hub, Subscriber<StepMessage, ()>)>);

impl Steps {
    /// Waits until the mapper has seen a picture that was given just now.
    fn await_picture(&mut self) -> Result<(), Box<dyn Error>> {
        /// The first step may be that of a frame before it.
        const NUM_STEPS: usize = 2;
        /// Longest wait: there may be no mapper, or it starts again.
        const MAX_WAIT: Duration = Duration::from_secs(10);
        if self.0.is_none() {
            let joined = join().and_then(|hub| {
                let steps = hub.subscriber(&STEP)?;
                Ok((hub, steps))
            });
            self.0 = joined.ok();
        }
        let Some((_, steps)) = &self.0 else { return Ok(()) };
        while steps.receive()?.is_some() {}
        let (begin, mut num_steps) = (Instant::now(), 0);
        while num_steps < NUM_STEPS && begin.elapsed() < MAX_WAIT {
            wait(&[steps.events()], None, MAX_WAIT.saturating_sub(begin.elapsed()))?;
            while steps.receive()?.is_some() {
                num_steps += 1;
            }
        }
        Ok(())
    }
}

/// Back and forth, indefinitely: the camera never jumps.
fn feed(source: &str, rate_hz: &str) -> Result<(), Box<dyn Error>> {
    let mut source = open(&source.parse()?, None, &SourceParams::default())?;
    let width = source.intrinsics().width;
    let period = Duration::from_secs_f64(1.0 / rate_hz.parse::<f64>()?);
    let pictures = pictures(source.as_mut())?;
    let mut output = std::io::stdout().lock();
    let back = (1..pictures.len().saturating_sub(1)).rev();
    let order: Vec<usize> = (0..pictures.len()).chain(back).collect();
    /// Pictures that v4l2-ctl collects before it streams; until then the camera shows another picture.
    const NUM_COLLECTED: usize = 4;
    let mut steps = Steps::default();
    let mut num_given = 0;
    loop {
        for &index in &order {
            let due = Instant::now() + period;
            output.write_all(&enlarged(&pictures[index].1, width))?;
            output.flush()?;
            num_given += 1;
            if num_given > NUM_COLLECTED {
                steps.await_picture()?;
            }
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
        }
    }
}

fn watch(source: &str, truth: &str) -> Result<(), Box<dyn Error>> {
    let mut source = open(&source.parse()?, None, &SourceParams::default())?;
    let pictures = pictures(source.as_mut())?;
    let poses: HashMap<i64, StampedPose> =
        source.ground_truth().iter().map(|pose| (pose.nanos, *pose)).collect();
    let index_of: HashMap<&[u8], usize> =
        pictures.iter().enumerate().map(|(index, (_, pixels))| (&pixels[..], index)).collect();
    let hub = join()?;
    let subscriber: Subscriber<u8, FrameHeader> = hub.subscriber(&FRAME)?;
    let shutdown = Shutdown::install()?;
    let (mut exact, mut unknown, mut repeated, mut last) = (0, 0, 0, None);
    let mut trajectory = Vec::new();
    while !shutdown.is_requested() {
        wait(&[subscriber.events()], Some(shutdown.descriptor()), Duration::from_secs(1))?;
        while let Some(frame) = subscriber.receive()? {
            let Some(&index) = index_of.get(frame.payload()) else {
                unknown += 1;
                continue;
            };
            exact += 1;
            repeated += usize::from(last.replace(index) == Some(index));
            if let Some(pose) = poses.get(&pictures[index].0) {
                trajectory.push(StampedPose { nanos: frame.header().capture_nanos, ..*pose });
            }
        }
    }
    write_trajectory(Path::new(truth), "true poses at the stamps of the camera", &trajectory)?;
    println!(
        "{{\"exact\": {exact}, \"unknown\": {unknown}, \"repeated\": {repeated}, \"poses\": {}}}",
        trajectory.len()
    );
    Ok(())
}
