//! A fake camera that appears, disappears, stalls, fails and gives wrong answers.

use super::*;
use crate::capture::v4l::fake::{Event, Fake, frame};
use crate::capture::v4l::kernel::{FLAG_ERROR, FLAG_TIMESTAMP_MONOTONIC};
use crate::capture::v4l::params::Setting;

const FRAME_NANOS: i64 = 33_000_000;

fn camera_with(fake: &Fake, params: CameraParams) -> Camera<Fake> {
    let wish = StreamRequest { width: 640, height: 480, format: None, rate_hz: Some(30.0) };
    Camera::new(fake.clone(), "0".to_owned(), params, wish)
}

fn camera(fake: &Fake) -> Camera<Fake> {
    camera_with(fake, CameraParams::default())
}

/// Waits until there is a frame or the camera is absent; returns the frame's number, or the reason.
fn look(camera: &mut Camera<Fake>) -> Result<u64, String> {
    for _ in 0..100 {
        match camera.await_frame(None, 10).unwrap() {
            Arrival::Frame => return Ok(camera.held().unwrap().0.stamp.sequence),
            Arrival::Absent(reason) => return Err(reason),
            Arrival::Nothing => {}
        }
    }
    panic!("neither a frame nor a reason")
}

/// Delivers one more frame, takes it and releases it.
fn take(fake: &Fake, camera: &mut Camera<Fake>, sequence: u32) -> u64 {
    fake.pass(FRAME_NANOS);
    fake.give(frame(sequence, vec![7; 640 * 480]));
    let number = look(camera).unwrap();
    camera.release(false);
    number
}

/// Waits until the absent camera is opened again.
fn come_back(camera: &mut Camera<Fake>) {
    while matches!(camera.await_frame(None, 50).unwrap(), Arrival::Absent(_)) {}
}

#[test]
fn frames_arrive_with_their_numbers_and_gaps_are_counted() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    let numbers: Vec<u64> = [0, 1, 4, 5].map(|s| take(&fake, &mut camera, s)).to_vec();
    assert_eq!(numbers, [0, 1, 4, 5]);
    assert_eq!(camera.losses(), FrameLosses { missing: 2, late: 0, broken: 0 });
    assert!(camera.take_notice().unwrap().text.contains("640x480 GREY, 30.0 Hz, 4 buffers"));
    assert_eq!(camera.take_notice(), None);
}

#[test]
fn after_a_pause_the_newest_frame_is_taken() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    for (sequence, age_nanos) in [(1, 60_000_000), (2, 30_000_000), (3, 1_000_000)] {
        let (bytes, flags) = (vec![9; 640 * 480], FLAG_TIMESTAMP_MONOTONIC);
        fake.give(Event::Frame { bytes, used: None, sequence, flags, age_nanos });
    }
    fake.pass(3 * FRAME_NANOS);
    assert_eq!(look(&mut camera), Ok(3));
    assert_eq!(camera.losses(), FrameLosses { missing: 0, late: 2, broken: 0 });
}

#[test]
fn a_frame_whose_stamp_does_not_increase_is_skipped() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    fake.give(frame(1, vec![7; 640 * 480]));
    assert_eq!(camera.await_frame(None, 10), Ok(Arrival::Nothing), "the stamp of the first");
    assert_eq!(take(&fake, &mut camera, 2), 2);
    assert_eq!(camera.losses(), FrameLosses { missing: 0, late: 0, broken: 1 });
}

#[test]
fn damaged_frames_are_counted_and_skipped() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    fake.pass(FRAME_NANOS);
    let flags = FLAG_TIMESTAMP_MONOTONIC | FLAG_ERROR;
    fake.give(Event::Frame { bytes: vec![], used: None, sequence: 1, flags, age_nanos: 0 });
    assert_eq!(camera.await_frame(None, 10), Ok(Arrival::Nothing));
    assert_eq!(take(&fake, &mut camera, 2), 2);
    assert_eq!(camera.losses(), FrameLosses { missing: 0, late: 0, broken: 1 });
    assert_eq!(fake.opened(), 1, "it streams on");
}

#[test]
fn a_missing_camera_is_retried_at_growing_intervals() {
    let fake = Fake::default();
    fake.refuse_opening(Some(OpenFailure::Missing));
    let mut camera = camera(&fake);
    let mut tries = Vec::new();
    let mut last = fake.now_nanos();
    for _ in 0..400 {
        let before = fake.now_nanos();
        let Ok(Arrival::Absent(reason)) = camera.await_frame(None, 100) else { panic!("absent") };
        assert!(reason.starts_with("there is no camera 0; plug it in"), "{reason}");
        // A check that takes no time was an attempt.
        if fake.now_nanos() == before {
            tries.push((before - last) / 100_000_000);
            last = before;
        }
    }
    assert_eq!(tries[..7], [0, 1, 2, 4, 8, 16, 20]);
    assert!(tries[7..].iter().all(|&pause| pause == 20), "never longer than retry_s: {tries:?}");
    fake.refuse_opening(None);
    come_back(&mut camera);
    assert_eq!(take(&fake, &mut camera, 0), 0);
}

#[test]
fn an_unplugged_camera_reconnects_and_its_numbers_continue() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    for sequence in 0..100 {
        take(&fake, &mut camera, sequence);
    }
    fake.give(Event::Fails(Errno::NODEV));
    assert_eq!(look(&mut camera), Err("/dev/video0: unplugged; plug it in again".to_owned()));
    assert!(!fake.is_open(), "the node is free for the next camera");
    fake.refuse_opening(Some(OpenFailure::Refused("/dev/video0".into(), Errno::NOENT)));
    for _ in 0..50 {
        assert!(look(&mut camera).unwrap_err().contains("unplugged"));
    }
    fake.refuse_opening(None);
    come_back(&mut camera);
    assert_eq!(take(&fake, &mut camera, 0), 101, "a gap, as nobody knows how much is missing");
    assert_eq!(take(&fake, &mut camera, 1), 102);
    assert_eq!(camera.losses(), FrameLosses::default());
}

#[test]
fn healthy_streaming_makes_the_next_pause_short_again() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    let mut pause = |frames: u32| {
        for sequence in 0..frames {
            take(&fake, &mut camera, sequence);
        }
        fake.give(Event::Fails(Errno::IO));
        assert!(look(&mut camera).unwrap_err().contains("fault of the device"));
        let start = fake.now_nanos();
        come_back(&mut camera);
        (fake.now_nanos() - start) / 50_000_000
    };
    assert_eq!((pause(1), pause(1), pause(1)), (2, 4, 8));
    assert_eq!(pause(100), 2, "3.3 s of frames");
}

#[test]
fn every_failure_is_a_state_with_its_reason() {
    for (error, reason) in [
        (Errno::BUSY, "in use by another program, which `fuser /dev/video0` names"),
        (Errno::ACCESS, "usermod -aG video"),
        (Errno::NOSPC, "no bandwidth"),
        (Errno::NOMEM, "its driver refused the request ("),
    ] {
        let fake = Fake::default();
        fake.refuse_opening(Some(OpenFailure::Refused("/dev/video0".into(), error)));
        let message = look(&mut camera(&fake)).unwrap_err();
        assert!(message.starts_with("/dev/video0: ") && message.contains(reason), "{message}");
        fake.refuse_opening(None);
        fake.refuse_layout(error);
        let message = look(&mut camera(&fake)).unwrap_err();
        assert!(message.contains(reason), "{message}");
    }
}

#[test]
fn an_unusable_camera_is_an_error_unless_it_has_streamed() {
    let fake =
        Fake::with_formats(&[(super::super::pixel_format::PixelFormat::Grey, &[(320, 240)], 30)]);
    let error = camera(&fake).await_frame(None, 10).unwrap_err();
    assert!(error.contains("/dev/video0: delivers 320x240 GREY instead of 640x480"), "{error}");
    assert!(error.contains("--rig"), "{error}");
    fake.refuse_opening(Some(OpenFailure::Ambiguous(vec!["a".into(), "b".into()])));
    let error = camera(&fake).await_frame(None, 10).unwrap_err();
    assert_eq!(error, "0 is ambiguous: it may be a or b; name one of them");
    // After reconnection it may be a different device for a moment.
    let fake = Fake::default();
    let mut served = camera(&fake);
    take(&fake, &mut served, 0);
    fake.give(Event::Fails(Errno::NODEV));
    look(&mut served).unwrap_err();
    fake.set_capability_flags(0);
    for _ in 0..20 {
        let reason = look(&mut served).unwrap_err();
        assert!(reason.contains("no images") || reason.contains("unplugged"), "{reason}");
    }
}

#[test]
fn a_camera_that_falls_silent_is_reopened() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    let mut reason = None;
    for _ in 0..1000 {
        if let Arrival::Absent(text) = camera.await_frame(None, 10).unwrap() {
            reason = Some(text);
            break;
        }
    }
    assert_eq!(reason.as_deref(), Some("/dev/video0: has delivered no frame for 2 s"));
    come_back(&mut camera);
    assert_eq!((take(&fake, &mut camera, 0), fake.opened()), (2, 2));
}

#[test]
fn a_camera_whose_frames_are_all_damaged_is_reopened() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    let damaged = |sequence| {
        let (bytes, flags) = (vec![7; 640 * 480], FLAG_TIMESTAMP_MONOTONIC | FLAG_ERROR);
        Event::Frame { bytes, used: None, sequence, flags, age_nanos: 0 }
    };
    let mut reason = None;
    for sequence in 1..200 {
        fake.pass(FRAME_NANOS);
        fake.give(damaged(sequence));
        if let Arrival::Absent(text) = camera.await_frame(None, 10).unwrap() {
            reason = Some(text);
            break;
        }
    }
    assert_eq!(reason.as_deref(), Some("/dev/video0: has delivered only damaged frames for 2 s"));
    come_back(&mut camera);
    assert_eq!(fake.opened(), 2);
    let mut reason = None;
    while reason.is_none() {
        if let Arrival::Absent(text) = camera.await_frame(None, 10).unwrap() {
            reason = Some(text);
        }
    }
    assert_eq!(reason.as_deref(), Some("/dev/video0: has delivered no frame for 2 s"));
}

#[test]
fn a_camera_whose_frames_are_no_pictures_is_reopened() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    // A few may be.
    for sequence in 1..180 {
        fake.pass(FRAME_NANOS);
        fake.give(frame(sequence, vec![7; 640 * 480]));
        assert_eq!(camera.await_frame(None, 10), Ok(Arrival::Frame), "{sequence}");
        camera.release(sequence % 30 != 0);
    }
    let mut reason = None;
    for sequence in 180..300 {
        fake.pass(FRAME_NANOS);
        fake.give(frame(sequence, vec![7; 640 * 480]));
        match camera.await_frame(None, 10).unwrap() {
            Arrival::Absent(text) => reason = Some(text),
            _ if reason.is_none() => camera.release(true),
            _ => break,
        }
    }
    assert_eq!(reason.as_deref(), Some("/dev/video0: has delivered only damaged frames for 2 s"));
    come_back(&mut camera);
    take(&fake, &mut camera, 0);
    assert_eq!(fake.opened(), 2);
}

#[test]
fn a_buffer_that_is_refused_once_is_enqueued_again() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    fake.refuse_enqueues(&[Errno::INVAL]);
    for sequence in 1..20 {
        take(&fake, &mut camera, sequence);
    }
    assert_eq!(fake.opened(), 1);
    // A driver that accepts no more buffers is closed.
    fake.refuse_enqueues(&[Errno::INVAL; 60]);
    let mut reasons = Vec::new();
    for sequence in 20..40 {
        fake.pass(FRAME_NANOS);
        fake.give(frame(sequence, vec![7; 640 * 480]));
        match look(&mut camera) {
            Ok(_) => camera.release(false),
            Err(reason) => reasons.push(reason),
        }
    }
    assert!(reasons[0].contains("its driver refused the request ("), "{reasons:?}");
}

#[test]
fn exposure_accompanies_the_frames_and_moves_their_stamps() {
    let (auto, absolute) = (0x009a_0901, 0x009a_0902);
    let fake = Fake::default().with_control(auto, "Auto Exposure", (0, 3, 1), 3, 0).with_control(
        absolute,
        "Exposure Time, Absolute",
        (3, 2047, 1),
        250,
        0,
    );
    let params = CameraParams { exposure_us: Setting::Lock, ..CameraParams::default() };
    let mut camera = camera_with(&fake, params);
    let mut stamp_of = |sequence: u32| {
        fake.pass(FRAME_NANOS);
        fake.give(frame(sequence, vec![7; 640 * 480]));
        look(&mut camera).unwrap();
        let stamp = camera.held().unwrap().0.stamp;
        camera.release(false);
        (stamp.exposure_nanos, stamp.capture_nanos - fake.now_nanos())
    };
    assert_eq!(stamp_of(0), (0, -5_000_000), "found by the camera: unknown");
    for sequence in 1..40 {
        stamp_of(sequence);
    }
    assert_eq!(fake.value_of(auto), 1, "locked after a second");
    assert_eq!(stamp_of(40), (25_000_000, -5_000_000 - 12_500_000));
}

#[test]
fn bytes_that_do_not_exist_are_not_shown() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    for (sequence, used, shown) in [(0, 0, 0), (1, 10, 10), (2, 11, 0), (3, usize::MAX, 0)] {
        fake.pass(FRAME_NANOS);
        let (bytes, flags) = (vec![1; 10], FLAG_TIMESTAMP_MONOTONIC);
        fake.give(Event::Frame { bytes, used: Some(used), sequence, flags, age_nanos: 0 });
        look(&mut camera).unwrap();
        assert_eq!(camera.held().unwrap().2.len(), shown, "{used}");
        camera.release(true);
    }
    assert_eq!(camera.losses().broken, 4);
}

#[test]
fn a_driver_that_wakes_for_nothing_does_not_cause_a_busy_loop() {
    let fake = Fake::default();
    let mut camera = camera(&fake);
    take(&fake, &mut camera, 0);
    for _ in 0..50 {
        fake.give(Event::Fails(Errno::AGAIN));
        let before = fake.now_nanos();
        assert_eq!(camera.await_frame(None, 10), Ok(Arrival::Nothing));
        assert!(fake.now_nanos() > before, "it slept");
    }
    assert_eq!((take(&fake, &mut camera, 1), fake.opened()), (1, 1));
}
