//! A tracker whose frames arrive faster than it can track them: there is never a pause between two frames, yet it
//! reports its health (on which its watchdog depends) and ends when asked to.

use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use semidense::service::config::Config;
use semidense::service::mode::Mode;
use semidense::service::shutdown::Shutdown;
use semidense::service::tracker;
use semidense::wire::conversion::{keyframe_header, keyframe_image_header};
use semidense::wire::message::HealthMessage;
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Subscriber};
use semidense::wire::topic::{FRAME, KEYFRAME, KEYFRAME_IMAGE, TRACKER_HEALTH};

use crate::waves::{CAMERA, header, keyframe};

/// Number of reports to wait for.
const REPORTS: usize = 40;
/// Upper limit for the frames between two received reports. With every frame of a flood others are dropped, which is
/// reported within 10 ms; a frame for which every view is searched takes some of them.
const MAX_FRAMES_BETWEEN: u64 = 60;
/// Far above any expected duration: it ends a test that hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// Sends frames without a pause until told to stop.
fn flood(place: &Place, enough: &Receiver<()>) {
    let hub = Hub::join(place, "others", Access::Member).unwrap();
    let keyframe = keyframe(0);
    let depths = hub.publisher(&KEYFRAME, keyframe.points.len()).unwrap();
    let images = hub.publisher(&KEYFRAME_IMAGE, keyframe.image.len()).unwrap();
    images.send(keyframe_image_header(&keyframe), &keyframe.image).unwrap();
    depths.send(keyframe_header(&keyframe), &keyframe.points).unwrap();
    let frames = hub.publisher(&FRAME, CAMERA.width * CAMERA.height).unwrap();
    // Unlike the keyframe: for each frame every view is searched, which takes much longer than sending it.
    let stripes: Vec<u8> = (0..CAMERA.width * CAMERA.height)
        .map(|i| if (i % CAMERA.width / 7).is_multiple_of(2) { 20 } else { 230 })
        .collect();
    for sequence in 1.. {
        depths.serve_late_joiners();
        images.serve_late_joiners();
        frames.send(header(sequence), &stripes).unwrap();
        if enough.try_recv().is_ok() {
            return;
        }
    }
}

/// The tracker's frame count in each of its reports once it was lost.
fn hear(health: &Subscriber<HealthMessage, ()>) -> Vec<u64> {
    let (mut told, start) = (Vec::new(), Instant::now());
    while told.len() < REPORTS && start.elapsed() < PATIENCE {
        while let Some(message) = health.receive().unwrap() {
            let report = message.payload()[0];
            // 3 is "lost": before the keyframe arrives, a frame takes hardly any work.
            told.extend((report.detail == 3).then_some(report.frames));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    told
}

#[test]
fn a_tracker_that_is_always_behind_reports_and_ends() {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("behind", folder.path().to_str().unwrap()).unwrap();
    let hub = Hub::join(&place, "listener", Access::Member).unwrap();
    let health = hub.subscriber(&TRACKER_HEALTH).unwrap();
    let shutdown = Shutdown::install().unwrap();
    let (tell_enough, enough) = channel();
    let (tell_end, end) = channel();
    let flooded = place.clone();
    let flooding = std::thread::spawn(move || flood(&flooded, &enough));
    let tracking = std::thread::spawn(move || {
        let mut config = Config::default();
        (config.instance, config.root) = (place.instance.clone(), place.root.display().to_string());
        config.tracker.deadline_ms = 1000.0;
        let outcome = tracker::run(&config, Mode::Live, &shutdown);
        let _ = tell_end.send(());
        outcome.unwrap();
    });
    let told = hear(&health);
    signal_hook::low_level::raise(signal_hook::consts::SIGTERM).unwrap();
    let has_ended = end.recv_timeout(PATIENCE).is_ok();
    tell_enough.send(()).unwrap();
    flooding.join().unwrap();
    tracking.join().unwrap();
    assert!(told.len() >= REPORTS, "it told {told:?} in all");
    let is_prompt = |pair: &[u64]| (pair[0] + 1..=pair[0] + MAX_FRAMES_BETWEEN).contains(&pair[1]);
    assert!(told.windows(2).all(is_prompt), "frames at its reports: {told:?}");
    assert!(has_ended, "the signal to end was not heard as long as frames came");
}
