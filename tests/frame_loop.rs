//! The tracker's frame loop as in its process: once warm, it allocates nothing, touches no new page, and yields its
//! CPU only to wait for the next frame. Allocations by iceoryx2 itself are counted separately, from the same calls to
//! shared memory without a tracker.

#[allow(dead_code, reason = "every test uses its part of what they share")]
#[path = "support/counting_allocator.rs"]
mod counting_allocator;
#[path = "support/waves.rs"]
mod waves;

use std::fs;
use std::io::Write;
use std::time::{Duration, Instant};

use semidense::service::config::Config;
use semidense::service::mode::Mode;
use semidense::service::schedule::active_scheduling;
use semidense::service::shutdown::Shutdown;
use semidense::service::tracker;
use semidense::slam::frame::FrameView;
use semidense::slam::keyframe::DepthPoint;
use semidense::slam::pose::PoseEstimate;
use semidense::wire::conversion::{
    keyframe_header, keyframe_image_header, pose_from_message, pose_message,
};
use semidense::wire::message::{
    FrameHeader, HealthMessage, KeyframeHeader, KeyframeImageHeader, PoseMessage,
};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Publisher, Subscriber, wait};
use semidense::wire::topic::{FRAME, KEYFRAME, KEYFRAME_IMAGE, POSE, TRACKER_HEALTH};

use counting_allocator::{allocations, count_here};
use waves::{CAMERA, header, image, keyframe};

/// Frames until all memory has been touched.
const WARM_UP: u64 = 150;
/// Frames that are counted.
const COUNTED: u64 = 300;
/// Period of the frames: the loop must wait for each, and may wake before it.
const PERIOD: Duration = Duration::from_millis(4);
/// Page faults allowed if the system refuses to lock memory.
const UNLOCKED_PAGE_FAULTS: u64 = 20;
/// Far above any expected duration: it ends a test that hangs.
const WATCH_DOG: Duration = Duration::from_secs(120);

/// Substitute for capture and mapper.
struct Others {
    frames: Publisher<u8, FrameHeader>,
    poses: Subscriber<PoseMessage, ()>,
    health: Subscriber<HealthMessage, ()>,
    reports: u64,
    images: [Vec<u8>; 4],
    sequence: u64,
    tracked: u64,
    _hub: Hub,
    _keyframe: (Publisher<DepthPoint, KeyframeHeader>, Publisher<u8, KeyframeImageHeader>),
}

impl Others {
    fn new(place: &Place) -> Self {
        let hub = Hub::join(place, "others", Access::Member).unwrap();
        let keyframe = keyframe(0);
        let depths = hub.publisher(&KEYFRAME, keyframe.points.len()).unwrap();
        let images = hub.publisher(&KEYFRAME_IMAGE, keyframe.image.len()).unwrap();
        images.send(keyframe_image_header(&keyframe), &keyframe.image).unwrap();
        depths.send(keyframe_header(&keyframe), &keyframe.points).unwrap();
        Self {
            frames: hub.publisher(&FRAME, CAMERA.width * CAMERA.height).unwrap(),
            poses: hub.subscriber(&POSE).unwrap(),
            health: hub.subscriber(&TRACKER_HEALTH).unwrap(),
            reports: 0,
            images: std::array::from_fn(|i| image(0.3 * i as f64)),
            sequence: 0,
            tracked: 0,
            _hub: hub,
            _keyframe: (depths, images),
        }
    }

    /// Sends frames at an even rate until `count` of them have a pose.
    fn send(&mut self, count: u64) {
        let (mut answered, start) = (0, Instant::now());
        let mut due = start;
        while answered < count {
            assert!(start.elapsed() < WATCH_DOG, "no poses come");
            self._keyframe.0.serve_late_joiners();
            self._keyframe.1.serve_late_joiners();
            self.sequence += 1;
            let image = &self.images[self.sequence as usize % self.images.len()];
            self.frames.send(header(self.sequence), image).unwrap();
            wait(&[self.poses.events()], None, Duration::from_millis(50)).unwrap();
            while let Some(message) = self.poses.receive().unwrap() {
                let pose = pose_from_message(&message.payload()[0]).unwrap();
                self.tracked += u64::from(pose.state.is_tracked());
                answered += 1;
            }
            while self.health.receive().unwrap().is_some() {
                self.reports += 1;
            }
            due = (due + PERIOD).max(Instant::now());
            std::thread::sleep(due.duration_since(Instant::now()));
        }
    }
}

/// The shared-memory calls of a frame loop that tracks nothing.
fn echo(place: &Place, shutdown: &Shutdown) {
    let hub = Hub::join(place, "tracker", Access::Member).unwrap();
    let frames: Subscriber<u8, FrameHeader> = hub.subscriber(&FRAME).unwrap();
    let poses: Publisher<PoseMessage, ()> = hub.publisher(&POSE, 1).unwrap();
    let view = FrameView {
        sequence: 0,
        capture_nanos: 0,
        exposure_nanos: 0,
        width: 1,
        height: 1,
        pixels: &[0],
    };
    let lost = PoseEstimate::unknown(&view);
    let message = pose_message(&lost, &Default::default());
    while !shutdown.is_requested() {
        wait(&[frames.events()], Some(shutdown.descriptor()), Duration::from_millis(100)).unwrap();
        poses.serve_late_joiners();
        while let Some(_frame) = frames.newest().unwrap() {
            poses.send((), &[message]).unwrap();
        }
    }
}

/// Resources used by a thread.
#[derive(Debug, Clone, Copy)]
struct Cost {
    allocations: u64,
    page_faults: u64,
    waits: u64,
}

impl Cost {
    /// Use so far by the thread `tid`, according to the kernel.
    fn of(tid: i32) -> Self {
        let read = |file| fs::read_to_string(format!("/proc/self/task/{tid}/{file}")).unwrap();
        let stat = read("stat");
        // After the name, which may contain anything: state is field 3, minor and major faults are 10 and 12.
        let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
        let field = |number: usize| fields[number - 3].parse::<u64>().unwrap();
        let status = read("status");
        let waits =
            status.lines().find_map(|l| l.strip_prefix("voluntary_ctxt_switches:")).unwrap();
        Self {
            allocations: allocations(),
            page_faults: field(10) + field(12),
            waits: waits.trim().parse().unwrap(),
        }
    }

    fn since(self, before: Self) -> Self {
        Self {
            allocations: self.allocations - before.allocations,
            page_faults: self.page_faults - before.page_faults,
            waits: self.waits - before.waits,
        }
    }
}

/// Cost of `COUNTED` warm frames for a loop that runs in a separate thread, and how many of them were tracked.
fn cost_of(run: impl FnOnce(&Place, &Shutdown) + Send + 'static) -> (Cost, u64) {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("loop", folder.path().to_str().unwrap()).unwrap();
    let theirs = place.clone();
    let shutdown = Shutdown::install().unwrap();
    let mut others = Others::new(&place);
    let (tell, told) = std::sync::mpsc::channel();
    let thread = std::thread::spawn(move || {
        tell.send(rustix::thread::gettid().as_raw_nonzero().get()).unwrap();
        count_here(true);
        run(&theirs, &shutdown);
        count_here(false);
    });
    others.send(WARM_UP);
    let tid = told.recv().unwrap();
    let (before, tracked, reports) = (Cost::of(tid), others.tracked, others.reports);
    others.send(COUNTED);
    let mut cost = Cost::of(tid).since(before);
    // A health report costs the transport as much as a pose.
    cost.allocations = cost.allocations.saturating_sub(others.reports - reports);
    let tracked = others.tracked - tracked;
    signal_hook::low_level::raise(signal_hook::consts::SIGTERM).unwrap();
    thread.join().unwrap();
    (cost, tracked)
}

#[test]
fn the_loop_allocates_no_more_than_its_transport() {
    let (of_transport, _) = cost_of(echo);
    let (of_loop, tracked) = cost_of(|place, shutdown| {
        let mut config = Config {
            instance: place.instance.clone(),
            root: place.root.display().to_string(),
            ..Config::default()
        };
        // Half a period of these frames is too short a deadline on a busy machine.
        config.tracker.deadline_ms = 1000.0;
        config.tracker.scheduling.lock_memory = true;
        config.tracker.early_wake_us = 300.0;
        tracker::run(&config, Mode::Live, shutdown).unwrap();
    });
    let line = format!(
        "{COUNTED} frames: {of_loop:?} in the loop, {of_transport:?} in its transport alone"
    );
    // A closed standard error must not fail a test.
    let _ = writeln!(std::io::stderr(), "{line}");
    assert!(tracked > COUNTED / 2, "only {tracked} frames were tracked: this measures nothing");
    assert!(of_loop.allocations <= of_transport.allocations, "{line}");
    let allowed = if active_scheduling().memory_locked { 0 } else { UNLOCKED_PAGE_FAULTS };
    assert!(of_loop.page_faults <= allowed, "{line}");
    // One wait per frame, a second one for each that is late after an early wake-up, and some that a stale wake-up
    // ended early.
    assert!(of_loop.waits <= COUNTED + COUNTED / 5 + 20, "{line}");
}
