//! A tracker whose frames come faster than it can track them: there is never a pause between two frames, and
//! yet it reports how it is (its watchdog lives on that) and ends when it is asked to.

#[path = "support/waves.rs"]
mod waves;

use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use semidense::service::config::Config;
use semidense::service::mode::Mode;
use semidense::service::shutdown::Shutdown;
use semidense::service::tracker;
use semidense::wire::conversion::{keyframe_header, keyframe_image_header};
use semidense::wire::message::{FrameHeader, HealthMessage};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Subscriber};
use semidense::wire::topic::{FRAME, KEYFRAME, KEYFRAME_IMAGE, TRACKER_HEALTH};

use waves::{CAMERA, header, image, keyframe};

/// Reports without any change of state that are waited for: one a second.
const REPORTS: usize = 3;
/// Far above anything that is expected: it ends a test that hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// Sends frames without a pause until somebody says that it is enough.
fn flood(place: &Place, enough: &Receiver<()>) {
    let hub = Hub::join(place, "others", Access::Member).unwrap();
    let keyframe = keyframe(0);
    let depths = hub.publisher(&KEYFRAME, keyframe.points.len()).unwrap();
    let images = hub.publisher(&KEYFRAME_IMAGE, keyframe.image.len()).unwrap();
    images.send(keyframe_image_header(&keyframe), &keyframe.image).unwrap();
    depths.send(keyframe_header(&keyframe), &keyframe.points).unwrap();
    let frames = hub.publisher(&FRAME, CAMERA.width * CAMERA.height).unwrap();
    let shifted: [Vec<u8>; 4] = std::array::from_fn(|i| image(0.3 * i as f64));
    for sequence in 1.. {
        depths.serve_late_joiners();
        images.serve_late_joiners();
        frames.send(header(sequence), &shifted[sequence as usize % shifted.len()]).unwrap();
        if enough.try_recv().is_ok() {
            return;
        }
    }
}

/// Frames that the tracker had counted at each of its reports, until it has tracked and told so a few times.
fn hear(health: &Subscriber<HealthMessage, ()>) -> Vec<u64> {
    let (mut told, start) = (Vec::new(), Instant::now());
    while told.len() < REPORTS && start.elapsed() < PATIENCE {
        while let Some(message) = health.receive().unwrap() {
            let report = message.payload()[0];
            // 1 is "tracking": before it there is hardly any work in a frame.
            told.extend((report.detail == 1).then_some(report.frames));
        }
        std::thread::sleep(Duration::from_millis(10));
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
    assert!(told.len() >= REPORTS, "it told {told:?} while it tracked");
    assert!(told.windows(2).all(|pair| pair[1] > pair[0]), "it counts no frames: {told:?}");
    assert!(has_ended, "the signal to end was not heard as long as frames came");
}
