//! Streams that are complete, late, damaged, or gone.

use std::fs;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};

use super::*;
use crate::capture::v4l::PixelFormat;

const SIZE: (u32, u32) = (32, 24);
const PIXELS: usize = 32 * 24;
const RIG: &str =
    "model = \"pinhole\"\nwidth = 32\nheight = 24\nfx = 30\nfy = 30\ncx = 15.5\ncy = 11.5\n";
/// Silence that counts as absence.
const STALL_S: f64 = 0.15;

struct Scene {
    folder: tempfile::TempDir,
    source: StreamSource,
    wake: UnixStream,
    _other_end: UnixStream,
}

fn scene_of(open: impl FnOnce(&Path, &Path) -> StreamSource) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    fs::write(&rig, RIG).unwrap();
    let source = open(folder.path(), &rig);
    let (wake, other_end) = UnixStream::pair().unwrap();
    Scene { folder, source, wake, _other_end: other_end }
}

fn scene() -> Scene {
    let mut scene =
        scene_of(|folder, rig| open_socket(&folder.join("frames"), Some(rig), STALL_S).unwrap());
    assert!(matches!(scene.wait(0), Ok(Arrival::Absent(_))));
    scene
}

impl Scene {
    fn path(&self) -> PathBuf {
        self.folder.path().join("frames")
    }

    fn sender(&mut self) -> UnixStream {
        UnixStream::connect(self.path()).unwrap()
    }

    fn wait(&mut self, millis: u32) -> Result<Arrival, SourceError> {
        self.source.await_frame(self.wake.as_fd(), millis)
    }

    /// Waits for a frame and reads it: its stamp and first pixel.
    fn frame(&mut self) -> (FrameStamp, u8) {
        assert_eq!(self.wait(2000).unwrap(), Arrival::Frame);
        let mut pixels = vec![0; PIXELS];
        let stamp = self.source.next_into(&mut pixels).unwrap().unwrap();
        assert!(pixels.iter().all(|&pixel| pixel == pixels[0]));
        (stamp, pixels[0])
    }

    fn absence(&mut self) -> String {
        for _ in 0..40 {
            if let Arrival::Absent(reason) = self.wait(50).unwrap() {
                return reason;
            }
        }
        panic!("never absent");
    }
}

fn send(sender: &mut UnixStream, clock: StreamClock, stamp: i64, sequence: u64, level: u8) {
    let header = StreamHeader::gray(SIZE, clock, stamp, sequence);
    sender.write_all(&header.to_bytes()).unwrap();
    sender.write_all(&[level; PIXELS]).unwrap();
}

#[test]
fn the_newest_frame_wins_and_losses_are_counted() {
    let mut scene = scene();
    assert_eq!(fs::metadata(scene.path()).unwrap().permissions().mode() & 0o777, 0o600);
    let mut sender = scene.sender();
    send(&mut sender, StreamClock::Other, 100, 7, 10);
    let (stamp, level) = scene.frame();
    assert_eq!((stamp.sequence, stamp.capture_nanos, level), (0, 100, 10));
    for (stamp, sequence, level) in [(200, 8, 20), (300, 11, 30)] {
        send(&mut sender, StreamClock::Other, stamp, sequence, level);
    }
    let (stamp, level) = scene.frame();
    assert_eq!((stamp.sequence, stamp.capture_nanos, level), (4, 300, 30));
    assert_eq!(scene.source.losses(), Some(FrameLosses { missing: 2, late: 1, broken: 0 }));
}

#[test]
fn stamps_of_each_clock_become_instants_of_this_machine() {
    let arrival = 5_000_000_000;
    let realtime = 1_700_000_000_000_000_000;
    let of = |clock, stamp| stamp_of(&StreamHeader::gray(SIZE, clock, stamp, 0), arrival, realtime);
    let clocks = |clock_nanos, realtime_nanos| FrameClocks { clock_nanos, realtime_nanos };
    let late = 20_000_000;
    assert_eq!(
        of(StreamClock::Monotonic, arrival - late),
        (arrival - late, clocks(arrival - late, realtime - late))
    );
    assert_eq!(
        of(StreamClock::Realtime, realtime - late),
        (arrival - late, clocks(arrival - late, realtime - late))
    );
    // A clock that is a little ahead: no latency is negative, and the stamp stays unchanged.
    assert_eq!(
        of(StreamClock::Realtime, realtime + late),
        (arrival + late, clocks(arrival, realtime + late))
    );
    assert_eq!(of(StreamClock::Other, 33), (33, clocks(arrival, 33)));
}

#[test]
fn colour_padding_and_jpeg_become_grey() {
    let mut scene = scene();
    let mut sender = scene.sender();
    let stride = 3 * SIZE.0 + 5;
    let bytes = stride * SIZE.1;
    let header = StreamHeader {
        format: PixelFormat::Bgr3,
        stride,
        bytes,
        ..StreamHeader::gray(SIZE, StreamClock::Other, 1, 1)
    };
    let row = [&[255, 0, 0].repeat(SIZE.0 as usize)[..], &[9; 5]].concat();
    sender.write_all(&header.to_bytes()).unwrap();
    sender.write_all(&row.repeat(SIZE.1 as usize)).unwrap();
    assert_eq!(scene.frame().1, 29, "blue");
    let jpeg = crate::capture::test_images::flat_block_jpeg(32, 24, 3, false, |_, _, _| 90);
    let header = StreamHeader {
        format: PixelFormat::Mjpeg,
        stride: 0,
        bytes: jpeg.len() as u32,
        stamp_nanos: 2,
        ..header
    };
    sender.write_all(&header.to_bytes()).unwrap();
    sender.write_all(&jpeg).unwrap();
    assert_eq!(scene.frame().1, 90);
    // A torn one is skipped, and the next one arrives.
    sender.write_all(&StreamHeader { stamp_nanos: 3, ..header }.to_bytes()).unwrap();
    sender.write_all(&vec![0; jpeg.len()]).unwrap();
    assert_eq!(scene.wait(2000).unwrap(), Arrival::Frame);
    let error = scene.source.next_into(&mut [0; PIXELS]).unwrap_err();
    assert!(error.is_transient() && error.to_string().contains("stream:"), "{error}");
    send(&mut sender, StreamClock::Other, 4, 4, 44);
    assert_eq!(scene.frame().1, 44);
}

#[test]
fn a_sender_that_leaves_or_falls_silent_is_a_state_and_another_may_connect() {
    let mut scene = scene();
    assert!(scene.absence().contains("no program sends frames to"));
    let mut first = scene.sender();
    send(&mut first, StreamClock::Other, 1, 1, 1);
    scene.frame();
    // While the first sends, another is refused.
    let mut second = scene.sender();
    send(&mut second, StreamClock::Other, 50, 1, 50);
    send(&mut first, StreamClock::Other, 2, 2, 2);
    assert_eq!(scene.frame().1, 2);
    assert!(scene.source.take_notice().unwrap().text.contains("refused"));
    assert!(scene.absence().contains("no frame for"), "silence");
    // The first hangs: the next sender takes its place.
    let mut third = scene.sender();
    send(&mut third, StreamClock::Other, 3, 900, 3);
    assert_eq!(scene.frame().1, 3);
    drop(third);
    assert!(scene.absence().contains("no program sends frames to"));
    let mut fourth = scene.sender();
    send(&mut fourth, StreamClock::Other, 4, 0, 4);
    let (stamp, level) = scene.frame();
    assert_eq!(level, 4);
    assert!(stamp.sequence > 3, "numbers never go back: {}", stamp.sequence);
}

#[test]
fn stamps_that_do_not_advance_are_refused_until_the_clock_has_stepped_for_good() {
    let mut scene = scene();
    let mut sender = scene.sender();
    send(&mut sender, StreamClock::Other, 1000, 1, 1);
    scene.frame();
    for sequence in 2..=11 {
        send(&mut sender, StreamClock::Other, 1000 - sequence as i64, sequence, 2);
        assert_eq!(scene.wait(20).unwrap(), Arrival::Nothing, "{sequence}");
    }
    assert_eq!(scene.source.losses().unwrap().broken, 10);
    send(&mut sender, StreamClock::Other, 500, 12, 3);
    let (stamp, level) = scene.frame();
    assert_eq!((stamp.capture_nanos, level), (500, 3));
}

#[test]
fn an_invalid_stream_is_disconnected_and_another_size_is_an_error() {
    let mut scene = scene();
    let mut sender = scene.sender();
    sender.write_all(&[b'x'; 200]).unwrap();
    let reason = scene.absence();
    assert!(reason.contains("SDFRAME1"), "{reason}");
    assert!(scene.source.take_notice().unwrap().text.contains("disconnected"));
    let mut sender = scene.sender();
    let header = StreamHeader::gray((64, 48), StreamClock::Other, 1, 1);
    sender.write_all(&header.to_bytes()).unwrap();
    let error = (0..40).find_map(|_| scene.wait(50).err()).unwrap().to_string();
    assert!(
        error.contains("64x48") && error.contains("32x24") && error.contains("--rig"),
        "{error}"
    );
}

#[test]
fn a_stale_socket_is_taken_over_and_a_file_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    fs::write(&rig, RIG).unwrap();
    let path = folder.path().join("frames");
    drop(UnixListener::bind(&path).unwrap());
    let (wake, _other_end) = UnixStream::pair().unwrap();
    let mut source = open_socket(&path, Some(&rig), STALL_S).unwrap();
    assert!(matches!(source.await_frame(wake.as_fd(), 0), Ok(Arrival::Absent(_))));
    let mut second = open_socket(&path, Some(&rig), STALL_S).unwrap();
    let Ok(Arrival::Absent(reason)) = second.await_frame(wake.as_fd(), 0) else {
        panic!("two listen at one socket")
    };
    assert!(reason.contains("another process"), "{reason}");
    drop(source);
    assert!(!path.exists());
    fs::write(&path, "mine").unwrap();
    let mut third = open_socket(&path, Some(&rig), STALL_S).unwrap();
    let error = third.await_frame(wake.as_fd(), 0).unwrap_err().to_string();
    assert!(error.contains("is a file"), "{error}");
    assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
    let error = open_socket(&path, None, STALL_S).err().unwrap().to_string();
    assert!(error.contains("--rig"), "{error}");
}

/// A source of a program that is `sh -c script`.
fn program_scene(script: impl FnOnce(&Path) -> String) -> Scene {
    scene_of(|folder, rig| {
        let frame = folder.join("frame");
        let header = StreamHeader::gray(SIZE, StreamClock::Other, 5, 0);
        fs::write(&frame, [&header.to_bytes()[..], &[77; PIXELS]].concat()).unwrap();
        let program = Program::new(PathBuf::from("/bin/sh"), vec!["-c".to_owned(), script(&frame)]);
        StreamSource::new("ros2:/x".to_owned(), Feed::Program(program), Some(rig), STALL_S).unwrap()
    })
}

#[test]
fn a_program_is_restarted_when_it_ends_and_ends_with_its_stream() {
    let mut scene =
        program_scene(|frame| format!("cat {0}; echo x >> {0}.starts; exit 3", frame.display()));
    assert_eq!(scene.frame().1, 77);
    let reason = scene.absence();
    assert!(reason.contains("exit status: 3") && reason.contains("restarting"), "{reason}");
    let starts = scene.folder.path().join("frame.starts");
    let is_again = (0..60).any(|_| {
        let _ = scene.wait(50);
        fs::read_to_string(&starts).is_ok_and(|text| text.len() >= 4)
    });
    assert!(is_again, "it was not started again");

    // One that has nothing to send ends when its stream is closed.
    let mut scene = program_scene(|_| "read nothing <&1; exit 0".to_owned());
    assert_eq!(scene.wait(0).unwrap(), Arrival::Nothing);
    drop(scene.source);
}

#[test]
fn a_program_that_is_missing_or_misused_is_an_error() {
    let mut scene = program_scene(|_| "exit 2".to_owned());
    let error = (0..60).find_map(|_| scene.wait(50).err()).unwrap().to_string();
    assert!(error.contains("does not understand"), "{error}");
    let mut scene = scene_of(|folder, rig| {
        let program = Program::new(folder.join("semidense-bridge"), Vec::new());
        StreamSource::new("ros2:/x".to_owned(), Feed::Program(program), Some(rig), STALL_S).unwrap()
    });
    let error = scene.wait(0).unwrap_err().to_string();
    assert!(error.contains("is not installed: install the package semidense-bridge"), "{error}");
}
