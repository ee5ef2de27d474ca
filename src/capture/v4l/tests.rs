//! A fake camera as a source of frames.

use std::os::fd::AsFd;

use super::fake::{Event, Fake, frame};
use super::kernel::FLAG_TIMESTAMP_MONOTONIC;
use super::*;
use crate::capture::test_images::flat_block_jpeg;
use crate::slam::geometry::rectification::Rectification;

const WIDTH: usize = 32;
const HEIGHT: usize = 24;

fn rig(lens: &str) -> Rig {
    let text = format!(
        "{lens}\nwidth = 32\nheight = 24\nfx = 30\nfy = 31\ncx = 15.5\ncy = 11.5\nrate_hz = 30\n"
    );
    Rig::from_toml(Path::new("rig.toml"), &text).unwrap()
}

fn source(fake: &Fake, lens: &str) -> CameraSource<Fake> {
    let (rig, params) = (rig(lens), CameraParams::default());
    CameraSource::new(fake.clone(), "0", &rig, Path::new("rig.toml"), &params).unwrap()
}

fn offering(format: PixelFormat) -> Fake {
    Fake::with_formats(&[(format, &[(WIDTH as u32, HEIGHT as u32)], 30)])
}

/// A picture whose neighbouring pixels differ.
fn picture() -> Vec<u8> {
    (0..WIDTH * HEIGHT).map(|i| (i * 7 % 251) as u8).collect()
}

fn next(fake: &Fake, source: &mut CameraSource<Fake>, event: Event) -> (Vec<u8>, FrameStamp) {
    fake.pass(33_000_000);
    fake.give(event);
    let mut pixels = vec![0; WIDTH * HEIGHT];
    let stamp = source.next_into(&mut pixels).unwrap().unwrap();
    (pixels, stamp)
}

const PINHOLE: &str = "model = \"pinhole\"";
const RADTAN: &str = "model = \"radtan\"\ncoefficients = [-0.2, 0.05, 0.0, 0.0]";

#[test]
fn every_format_gives_the_same_picture() {
    let gray = picture();
    let double = |f: fn(u8) -> [u8; 2]| gray.iter().flat_map(|&g| f(g)).collect::<Vec<u8>>();
    let planar = [&gray[..], &[128; WIDTH * HEIGHT / 2]].concat();
    for (format, bytes) in [
        (PixelFormat::Grey, gray.clone()),
        (PixelFormat::Nv12, planar),
        (PixelFormat::Yuyv, double(|g| [g, 128])),
        (PixelFormat::Uyvy, double(|g| [128, g])),
        (PixelFormat::Y10, double(|g| (u16::from(g) << 2 | 3).to_le_bytes())),
        (PixelFormat::Y12, double(|g| (u16::from(g) << 4 | 9).to_le_bytes())),
        (PixelFormat::Y16, double(|g| (u16::from(g) << 8 | 77).to_le_bytes())),
    ] {
        let fake = offering(format);
        let (pixels, stamp) = next(&fake, &mut source(&fake, PINHOLE), frame(0, bytes.clone()));
        assert!(pixels == gray, "{format:?}");
        assert_eq!(stamp.capture_nanos, fake.now_nanos() - 5_000_000, "{format:?}");
        // With a lens, the same picture rectified.
        let (rectified, _) = next(&fake, &mut source(&fake, RADTAN), frame(0, bytes));
        let mut expected = vec![0; WIDTH * HEIGHT];
        Rectification::new(&rig(RADTAN).camera).unwrap().rectify_into(&gray, &mut expected);
        assert!(rectified == expected && rectified != gray, "{format:?}");
    }
}

#[test]
fn padded_rows_are_read_as_granted() {
    let fake = offering(PixelFormat::Grey);
    fake.pad_rows(8);
    let gray = picture();
    let padded: Vec<u8> =
        gray.chunks(WIDTH).flat_map(|row| row.iter().copied().chain([255; 8])).collect();
    for lens in [PINHOLE, RADTAN] {
        let (pixels, _) = next(&fake, &mut source(&fake, lens), frame(0, padded.clone()));
        let mut expected = vec![0; WIDTH * HEIGHT];
        Rectification::new(&rig(lens).camera).unwrap().rectify_into(&gray, &mut expected);
        assert!(pixels == expected, "{lens}");
    }
}

#[test]
fn a_torn_picture_is_one_error_and_the_next_frame_follows() {
    let fake = offering(PixelFormat::Mjpeg);
    let mut source = source(&fake, PINHOLE);
    let jpeg = flat_block_jpeg(WIDTH, HEIGHT, 3, false, |_, _, _| 90);
    assert_eq!(next(&fake, &mut source, frame(0, jpeg.clone())).0[5], 90);
    for torn in [&jpeg[..jpeg.len() / 2], &[]] {
        fake.pass(33_000_000);
        fake.give(frame(1, torn.to_vec()));
        let error = source.next_into(&mut vec![0; WIDTH * HEIGHT]).unwrap_err();
        assert!(error.is_transient() && error.to_string().starts_with("v4l:0: "), "{error}");
    }
    assert_eq!(next(&fake, &mut source, frame(3, jpeg)).1.sequence, 4);
    assert_eq!(source.losses().unwrap().broken, 2);
}

#[test]
fn short_buffers_are_damaged_frames() {
    for format in [PixelFormat::Grey, PixelFormat::Yuyv, PixelFormat::Nv12, PixelFormat::Y16] {
        for lens in [PINHOLE, RADTAN] {
            let fake = offering(format);
            let mut source = source(&fake, lens);
            for (sequence, used) in [(0, 0), (1, 100), (2, usize::MAX)] {
                fake.pass(33_000_000);
                let (bytes, flags) = (vec![0; 700], FLAG_TIMESTAMP_MONOTONIC);
                fake.give(Event::Frame { bytes, used: Some(used), sequence, flags, age_nanos: 0 });
                let error = source.next_into(&mut vec![0; WIDTH * HEIGHT]).unwrap_err();
                assert!(error.is_transient(), "{format:?} {used}: {error}");
            }
            assert_eq!(source.losses().unwrap().broken, 3);
        }
    }
}

#[test]
fn an_absent_camera_is_awaited_and_not_an_error() {
    let fake = offering(PixelFormat::Grey);
    fake.refuse_opening(Some(super::video_device::OpenFailure::Missing));
    let mut source = source(&fake, PINHOLE);
    let wake = std::os::unix::net::UnixStream::pair().unwrap().0;
    let Ok(Arrival::Absent(reason)) = source.await_frame(wake.as_fd(), 10) else {
        panic!("it is not there")
    };
    assert!(reason.contains("there is no camera 0"), "{reason}");
    fake.refuse_opening(None);
    for _ in 0..20 {
        source.await_frame(wake.as_fd(), 10).unwrap();
    }
    fake.give(frame(0, picture()));
    assert_eq!(source.await_frame(wake.as_fd(), 10).unwrap(), Arrival::Frame);
    assert_eq!(source.await_frame(wake.as_fd(), 10).unwrap(), Arrival::Frame, "until it is read");
    assert!(source.next_into(&mut vec![0; WIDTH * HEIGHT]).unwrap().is_some());
    assert_eq!(source.await_frame(wake.as_fd(), 10).unwrap(), Arrival::Nothing);
}

#[test]
fn a_camera_needs_a_rig() {
    let error = open("0", None, &CameraParams::default()).err().unwrap().to_string();
    assert!(error.starts_with("v4l:0: ") && error.contains("--rig FILE"), "{error}");
}
