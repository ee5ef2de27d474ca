//! Sources of uniform frames and of the simulator.

use std::os::fd::AsFd;

use super::*;
use crate::capture::looped::Looped;
use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::{MotionParams, SensorParams, SimulatorParams};
use crate::capture::tum;
use crate::slam::image::NO_DATA;
use crate::slam::test_scene::CAMERA;

/// Frames of one grey level each; `None` is a frame that cannot be read.
struct Greys {
    greys: Vec<Option<u8>>,
    num_read: usize,
}

impl FrameSource for Greys {
    fn intrinsics(&self) -> Intrinsics {
        CAMERA
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        let Some(grey) = self.greys.get(self.num_read) else { return Ok(None) };
        let sequence = self.num_read as u64;
        self.num_read += 1;
        pixels.fill(grey.unwrap_or_default());
        match grey {
            Some(_) => Ok(Some(FrameStamp { sequence, ..FrameStamp::default() })),
            None => Err(SourceError::Buffer { found: 0, width: 0, height: 0 }),
        }
    }
}

fn brightened(greys: impl IntoIterator<Item = Option<u8>>) -> Corrected<Box<Greys>> {
    Corrected::new(
        Box::new(Greys { greys: greys.into_iter().collect(), num_read: 0 }),
        &Corrections::default(),
        None,
    )
}

/// Number and grey level of the next frame.
fn next(source: &mut Corrected<Box<Greys>>) -> Option<(u64, u8)> {
    let mut pixels = vec![0; CAMERA.width * CAMERA.height];
    source.next_into(&mut pixels).unwrap().map(|stamp| (stamp.sequence, pixels[0]))
}

#[test]
fn all_frames_of_a_dim_recording_are_brightened_and_none_is_lost() {
    for num_frames in [1, 3, SETTLING_FRAMES, 10] {
        let mut source = brightened(vec![Some(30); num_frames]);
        for sequence in 0..num_frames as u64 {
            assert_eq!(next(&mut source), Some((sequence, 120)), "{num_frames}");
        }
        assert_eq!((next(&mut source), next(&mut source)), (None, None));
        assert_eq!(source.max_factor(), Some(4));
    }
}

#[test]
fn brightening_that_is_off_changes_nothing_and_reads_nothing_ahead() {
    let mut source = brightened(vec![Some(30); 3]);
    source.brightens = false;
    assert_eq!(next(&mut source), Some((0, 30)));
    assert_eq!((source.source.num_read, source.max_factor()), (1, None));
}

#[test]
fn frames_of_ordinary_light_are_not_read_ahead() {
    let mut source = brightened(vec![Some(100); 10]);
    for sequence in 0..3 {
        assert_eq!(next(&mut source), Some((sequence, 100)));
        assert_eq!(source.source.num_read as u64, sequence + 1);
    }
}

#[test]
fn a_camera_whose_exposure_settles_is_not_brightened() {
    // In steps of three frames from a tenth of the light.
    let light = [15, 15, 15, 22, 22, 22, 33, 33, 33, 50, 50, 50, 75, 75, 75, 110, 150];
    let mut source = brightened(light.map(Some));
    for (sequence, grey) in (0..).zip(light) {
        assert_eq!(next(&mut source), Some((sequence, grey)));
    }
    // One that settles in the dark is, from there on.
    let light = [10, 10, 10, 15, 15, 15, 30, 30, 30, 30, 30, 30, 30, 30];
    let mut source = brightened(light.map(Some));
    for (sequence, grey) in (0..).zip(light) {
        let seen = if sequence < 6 { grey } else { 4 * grey };
        assert_eq!(next(&mut source), Some((sequence, seen)));
    }
}

#[test]
fn a_damaged_frame_ends_the_reading_ahead_and_is_reported_in_its_place() {
    let mut source = brightened([Some(30), Some(30), None, Some(30), Some(30)]);
    assert_eq!(next(&mut source), Some((0, 120)));
    assert_eq!(source.source.num_read, 3);
    assert_eq!(next(&mut source), Some((1, 120)));
    let mut pixels = vec![0; CAMERA.width * CAMERA.height];
    assert!(matches!(source.next_into(&mut pixels), Err(SourceError::Buffer { .. })));
    assert_eq!(next(&mut source), Some((3, 120)));
}

#[test]
fn waiting_for_a_dim_camera_reads_one_frame_at_a_time() {
    let mut source = brightened(vec![Some(30); 10]);
    let never = File::open("/dev/null").unwrap();
    for num_read in 1..=SETTLING_FRAMES {
        let arrival = source.await_frame(never.as_fd(), 0).unwrap();
        assert_eq!(source.source.num_read, num_read);
        assert_eq!(arrival == Arrival::Frame, num_read == SETTLING_FRAMES);
    }
    for sequence in 0..10 {
        assert_eq!(source.await_frame(never.as_fd(), 0).unwrap(), Arrival::Frame);
        assert_eq!(next(&mut source), Some((sequence, 120)));
    }
}

#[test]
fn what_a_mask_hides_stays_hidden_in_a_brightened_image_and_black_stays_black() {
    let count = CAMERA.width * CAMERA.height;
    let mut source = brightened(vec![Some(30); 10]);
    source.mask = Some(Mask::hiding(0..count / 3, count));
    let mut pixels = vec![0; count];
    source.next_into(&mut pixels).unwrap();
    assert!(pixels[..count / 3].iter().all(|&grey| grey == NO_DATA));
    assert!(pixels[count / 3..].iter().all(|&grey| grey == 120));
    let mut source = brightened(vec![Some(30), Some(0), Some(30)]);
    assert_eq!(next(&mut source), Some((0, 120)));
    assert_eq!(next(&mut source), Some((1, NO_DATA + 1)));
}

#[test]
fn a_rolling_shutter_reads_the_second_frame_before_the_first_is_returned() {
    let rolling = |greys: Vec<Option<u8>>| {
        let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
        Corrected::new(Box::new(Greys { greys, num_read: 0 }), &corrections, None)
    };
    let mut source = rolling(vec![Some(100); 4]);
    assert_eq!(next(&mut source), Some((0, 100)));
    assert_eq!(source.source.num_read, 2);
    for sequence in 1..4 {
        assert_eq!(next(&mut source), Some((sequence, 100)));
        assert_eq!(source.source.num_read as u64, sequence.max(1) + 1);
    }
    assert_eq!(next(&mut source), None);
    // The only frame, and one before a damaged frame, are not waited with.
    assert_eq!(next(&mut rolling(vec![Some(100)])), Some((0, 100)));
    let mut source = rolling(vec![Some(100), None, Some(100)]);
    assert_eq!(next(&mut source), Some((0, 100)));
    assert!(source.next_into(&mut vec![0; CAMERA.width * CAMERA.height]).is_err());
    assert_eq!(next(&mut source), Some((2, 100)));
}

#[test]
fn a_jump_forgets_the_motion() {
    let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
    let greys = Box::new(Greys { greys: vec![Some(100); 9], num_read: 0 });
    let mut source = Corrected::new(greys, &corrections, None);
    assert_eq!(next(&mut source), Some((0, 100)));
    source.skip_to(4).unwrap();
    assert!(source.rolling_shutter.as_ref().is_some_and(|shutter| !shutter.has_begun()));
    assert_eq!(next(&mut source), Some((5, 100)));
}

#[test]
fn the_rig_s_read_out_time_reaches_the_frames() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    std::fs::write(folder.path().join("rgb.txt"), "1.0 rgb/1.png\n").unwrap();
    let lens =
        "model = \"pinhole\"\nwidth = 160\nheight = 120\nfx = 130\nfy = 130\ncx = 80\ncy = 60\n";
    for (key, is_undone) in [("readout_ms = 20", true), ("", false)] {
        std::fs::write(&rig, format!("{lens}{key}\n")).unwrap();
        let source = Box::new(tum::open(folder.path(), Some(&rig)).unwrap());
        assert_eq!(source.readout_s(), Some(if is_undone { 0.02 } else { 0.0 }));
        let corrected = Corrected::new(source, &Corrections::default(), None);
        assert_eq!(corrected.rolling_shutter.is_some(), is_undone);
    }
}

#[test]
fn frames_that_have_been_corrected_are_not_corrected_again() {
    let corrections = Corrections { readout_s: Some(0.02), ..Corrections::default() };
    let looped = |num_frames| {
        let inner = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
        Looped::new("loop:4:30:sim".parse().unwrap(), inner, num_frames, 30.0)
    };
    let source = Corrected::new(Box::new(looped(4)), &corrections, None);
    assert!(source.rolling_shutter.is_none() && source.vignette.is_none());
    let plain = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
    assert!(Corrected::new(plain, &corrections, None).rolling_shutter.is_some());
    let plain = Box::new(Greys { greys: vec![Some(100); 3], num_read: 0 });
    let source = Corrected::new(plain, &Corrections::default(), None);
    assert!(source.rolling_shutter.is_none() && source.vignette.is_some());
}

#[test]
fn the_vignette_of_a_moving_camera_is_undone() {
    let frames = |vignette, undo_vignette| {
        let params = SimulatorParams {
            frames: 40,
            sensor: SensorParams { vignette, ..SensorParams::default() },
            motion: MotionParams { mean_turn_deg_s: 50.0, ..MotionParams::default() },
            ..SimulatorParams::half_size()
        };
        let mut simulator = Simulator::new(params).unwrap();
        simulator.prepare(&mut |_, _| true).unwrap();
        let size = simulator.intrinsics().width * simulator.intrinsics().height;
        let corrections = Corrections { undo_vignette, ..Corrections::default() };
        let mut source = Corrected::new(Box::new(simulator), &corrections, None);
        let frames: Vec<Vec<u8>> = std::iter::from_fn(|| {
            let mut pixels = vec![0; size];
            source.next_into(&mut pixels).unwrap().map(|_| pixels)
        })
        .collect();
        (frames, source.vignette.and_then(|vignette| vignette.light_in_corners()))
    };
    let (even, of_even) = frames(0.0, true);
    let (raw, off) = frames(0.4, false);
    let (undone, light) = frames(0.4, true);
    assert!(of_even.is_none() && off.is_none());
    assert!((light.unwrap() - 0.6).abs() < 0.08, "{light:?}");
    assert!(undone[0] == raw[0], "nothing is known at first");
    let error = |frames: &[Vec<u8>]| {
        let pairs = frames[39].iter().zip(&even[39]);
        let sum: f64 = pairs.map(|(one, other)| f64::from(one.abs_diff(*other))).sum();
        sum / even[39].len() as f64
    };
    let (before, now) = (error(&raw), error(&undone));
    assert!(now < 0.4 * before, "{before} {now} grey levels");
}
