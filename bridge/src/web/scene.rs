//! What pages show: updated from the feed by one thread, read by the thread of each page.
//!
//! A page fetches the newest state when it has room: nothing is queued here.

use std::collections::{BTreeMap, HashSet};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use semidense::service::results::report::scene::place_numbers;
use semidense::slam::keyframe::{Keyframe, KeyframePose};
use semidense::wire::message::HealthMessage;
use serde_json::{Value, json};

use crate::session::{Event, Frame, Graph, Pose};
use crate::web::packing::Packed;
use crate::web::path::Path;
use crate::web::seats::{Seat, Seats};

/// Minimum time between two revisions of the active keyframe: each is half a megabyte for every page.
const REVISION_PERIOD: Duration = Duration::from_secs(1);
/// Time without a pose after which images are shown without one.
const LONGEST_WAIT: Duration = Duration::from_millis(500);
/// Default limit for the points of all keyframes together: 48 MB here and in each page.
pub const USUAL_POINTS: usize = 6_000_000;

/// The scene that pages show.
#[derive(Debug)]
pub struct Scene {
    state: Mutex<State>,
    changed: Condvar,
    pages: Seats,
}

/// A frame that pages have not been sent yet.
#[derive(Debug, Clone)]
pub struct NewestFrame {
    /// The image.
    pub frame: Arc<Frame>,
    /// The pose of this frame; `None` if no poses arrive.
    pub pose: Option<Arc<Pose>>,
    /// Incremented with every frame.
    pub number: u64,
    /// The image as JPEG, once a page has requested it.
    pub jpeg: Arc<OnceLock<Vec<u8>>>,
}

/// The state of the scene.
#[derive(Debug, Default)]
pub struct State {
    max_points: usize,
    /// Incremented with every change.
    pub version: u64,
    /// Incremented with every run that is joined.
    pub run: u64,
    /// Whether an instance is running.
    pub is_joined: bool,
    /// Keyframes with depth, by id.
    pub keyframes: BTreeMap<u64, Arc<Packed>>,
    /// Poses of the keyframes, by id; of all that the map contains or contained.
    places: BTreeMap<u64, (u32, KeyframePose)>,
    /// Incremented with every change of these poses.
    pub placed: u64,
    /// The newest version of the active keyframe, while not packed.
    active: Option<Arc<Keyframe>>,
    /// The keyframe that poses currently refer to.
    pub active_id: Option<u64>,
    packed: Option<Instant>,
    /// The camera's path.
    pub path: Path,
    /// The newest pose, and the number of poses so far.
    pub pose: Option<(u64, Arc<Pose>)>,
    /// The newest frame with a known pose.
    pub frame: Option<NewestFrame>,
    /// A frame whose pose has not arrived; it follows some milliseconds later.
    waiting: Option<Arc<Frame>>,
    /// When the newest pose arrived, or else the run began.
    posed: Option<Instant>,
    /// The newest health report of each process.
    pub health: BTreeMap<&'static str, HealthMessage>,
    /// Incremented with every report.
    pub reports: u64,
    /// Number of poses by tracking state, for `/metrics`.
    pub poses_by_state: [u64; 4],
    /// Why earlier keyframes are not available; empty if they are, or are not wanted.
    pub history_note: String,
    refused: HashSet<(u64, u64)>,
}

impl State {
    fn new(max_points: usize, run: u64, version: u64) -> Self {
        Self { max_points, run, version, posed: Some(Instant::now()), ..Self::default() }
    }

    fn take(&mut self, event: Event, has_pages: bool) {
        match event {
            Event::Joined => {
                *self = Self::new(self.max_points, self.run + 1, self.version);
                self.is_joined = true;
            }
            Event::Left => {
                // Keep showing what was seen until another run begins.
                self.pack_active();
                (self.is_joined, self.frame, self.waiting) = (false, None, None);
            }
            Event::Frame(frame) => {
                // Frames that the tracker skipped are skipped here too, unless nothing is tracked at all.
                let before = self.waiting.replace(frame);
                if self.posed.is_some_and(|at| at.elapsed() > LONGEST_WAIT) {
                    before.into_iter().for_each(|frame| self.show(frame, None));
                }
            }
            Event::Pose(pose) => self.take_pose(*pose),
            Event::Keyframe(keyframe) => self.take_keyframe(keyframe, has_pages),
            Event::Graph(graph) => self.take_graph(&graph),
            Event::Health(process, health) => {
                self.health.insert(process, *health);
                self.reports += 1;
            }
            Event::Adjustment(_) => {}
        }
        self.version += 1;
    }

    fn take_pose(&mut self, pose: Pose) {
        self.path.push(&pose);
        if let Some(count) = self.poses_by_state.get_mut(pose.message.state as usize) {
            *count += 1;
        }
        let number = self.pose.as_ref().map_or(1, |(number, _)| number + 1);
        let pose = Arc::new(pose);
        let is_own = |frame: &mut Arc<Frame>| frame.header.sequence == pose.message.sequence;
        if let Some(frame) = self.waiting.take_if(is_own) {
            self.show(frame, Some(Arc::clone(&pose)));
        }
        (self.pose, self.posed) = (Some((number, pose)), Some(Instant::now()));
    }

    fn show(&mut self, frame: Arc<Frame>, pose: Option<Arc<Pose>>) {
        let number = self.frame.as_ref().map_or(1, |frame| frame.number + 1);
        self.frame = Some(NewestFrame { frame, pose, number, jpeg: Arc::default() });
    }

    fn take_keyframe(&mut self, keyframe: Arc<Keyframe>, has_pages: bool) {
        if self.active_id.is_some_and(|id| id != keyframe.keyframe_id) {
            // The last revision of the previous one.
            self.pack_active();
            self.packed = None;
        }
        self.active_id = Some(keyframe.keyframe_id);
        let place = KeyframePose::of(&keyframe);
        self.place(keyframe.epoch, place);
        self.active = Some(keyframe);
        let is_due = self.packed.is_none_or(|at| at.elapsed() >= REVISION_PERIOD);
        if is_due && has_pages {
            self.pack_active();
        }
    }

    fn pack_active(&mut self) {
        let Some(keyframe) = self.active.take() else { return };
        self.packed = Some(Instant::now());
        self.keep(&keyframe);
    }

    /// Packs a keyframe, and thins all of them if they exceed the limit together.
    pub(super) fn keep(&mut self, keyframe: &Keyframe) {
        let packed = Packed::of(keyframe);
        self.keyframes.insert(packed.keyframe_id, Arc::new(packed));
        self.version += 1;
        let total: usize = self.keyframes.values().map(|packed| packed.num_points()).sum();
        if total > self.max_points {
            // Leaves an eighth of room, so that this is not repeated for every keyframe.
            let most = (self.max_points / self.keyframes.len()) * 7 / 8;
            for packed in self.keyframes.values_mut().filter(|packed| packed.num_points() > most) {
                *packed = Arc::new(packed.thinned(most));
            }
        }
    }

    fn take_graph(&mut self, graph: &Graph) {
        for pose in &graph.poses {
            self.place(graph.header.epoch, *pose);
        }
        // Keyframes of this epoch that the graph does not name have left the map.
        let named: HashSet<u64> = graph.poses.iter().map(|pose| pose.keyframe_id).collect();
        let epoch = graph.header.epoch;
        let active = self.active_id;
        self.places.retain(|id, (of, _)| *of != epoch || named.contains(id) || Some(*id) == active);
        self.keyframes.retain(|id, _| self.places.contains_key(id));
    }

    fn place(&mut self, epoch: u32, pose: KeyframePose) {
        self.places.insert(pose.keyframe_id, (epoch, pose));
        self.placed += 1;
    }

    /// The poses of the keyframes, 40 bytes each: id, epoch, and translation, quaternion and unit as f32.
    pub fn places_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(self.places.len() * 40);
        for (epoch, pose) in self.places.values() {
            bytes.extend_from_slice(&(pose.keyframe_id as u32).to_le_bytes());
            bytes.extend_from_slice(&epoch.to_le_bytes());
            for number in place_numbers(&pose.map_from_keyframe) {
                bytes.extend_from_slice(&(number as f32).to_le_bytes());
            }
        }
        bytes
    }

    /// Keyframes whose depth is newer in the map than on pages: first those never received, starting with the
    /// newest, which the camera sees; then those furthest behind.
    pub fn missing(&self) -> Vec<u64> {
        let mut missing: Vec<(u64, u64)> = self
            .places
            .values()
            .map(|(_, pose)| pose)
            .filter(|pose| Some(pose.keyframe_id) != self.active_id)
            .filter(|pose| !self.refused.contains(&(pose.keyframe_id, pose.revision)))
            .filter_map(|pose| match self.keyframes.get(&pose.keyframe_id) {
                None => Some((0, pose.keyframe_id)),
                Some(packed) => (packed.revision < pose.revision)
                    .then_some((packed.revision.max(1), pose.keyframe_id)),
            })
            .collect();
        missing.sort_by_key(|&(revision, id)| (revision, std::cmp::Reverse(id)));
        missing.into_iter().map(|(_, id)| id).collect()
    }

    /// The mapper does not have the depth of this keyframe: it is not requested again until it changes.
    pub(super) fn give_up(&mut self, keyframe_id: u64) {
        if let Some((_, pose)) = self.places.get(&keyframe_id) {
            self.refused.insert((keyframe_id, pose.revision));
        }
    }

    /// State that changes rarely: whether a run is joined, and the number of keyframes.
    pub fn run_json(&self) -> Value {
        json!({
            "kind": "run",
            "run": self.run,
            "joined": self.is_joined,
            "keyframes": self.places.len(),
            "with_depth": self.keyframes.len(),
            "active": self.active_id,
            "note": self.history_note,
        })
    }
}

impl Scene {
    /// An empty scene that keeps at most `max_points`.
    pub fn new(max_points: usize) -> Self {
        let state = Mutex::new(State::new(max_points, 0, 0));
        Self { state, changed: Condvar::new(), pages: Seats::default() }
    }

    /// Locks the state.
    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Applies an event.
    pub fn take(&self, event: Event) {
        self.lock().take(event, self.pages() > 0);
        self.changed.notify_all();
    }

    /// Wakes waiting pages after a change from outside.
    pub fn wake_waiting(&self) {
        self.lock().version += 1;
        self.changed.notify_all();
    }

    /// Waits until the version differs from `version`, at most for `timeout`.
    pub fn wait(&self, version: u64, timeout: Duration) -> MutexGuard<'_, State> {
        let state = self.lock();
        let waited =
            self.changed.wait_timeout_while(state, timeout, |state| state.version == version);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Number of open pages.
    pub fn pages(&self) -> usize {
        self.pages.num_taken()
    }

    /// Counts a page while it is open and gives it the active keyframe at once. `None` if `most` are open.
    pub fn open_page(&self, most: usize) -> Option<Seat> {
        let page = self.pages.take(most)?;
        self.lock().pack_active();
        Some(page)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::slam::geometry::intrinsics::Intrinsics;
    use semidense::slam::geometry::sim3::Sim3;
    use semidense::slam::keyframe::DepthPoint;
    use semidense::wire::message::GraphHeader;

    fn keyframe(keyframe_id: u64, revision: u64, points: usize) -> Arc<Keyframe> {
        let point = DepthPoint { inverse_depth: 1.0, variance: 1e-4, ..DepthPoint::default() };
        let k = Intrinsics::pinhole(64, 48, 50.0);
        let at = Keyframe::at(Sim3::identity(), k, vec![point; points], vec![0; 64 * 48]);
        Arc::new(Keyframe { keyframe_id, revision, ..at })
    }

    fn graph(entries: &[(u64, u64)]) -> Event {
        let pose = |&(keyframe_id, revision)| KeyframePose {
            keyframe_id,
            revision,
            map_from_keyframe: Sim3::identity(),
        };
        let poses = entries.iter().map(pose).collect();
        Event::Graph(Arc::new(Graph { header: GraphHeader::default(), poses }))
    }

    #[test]
    fn without_a_page_a_keyframe_is_packed_once_it_is_no_longer_active() {
        let scene = Scene::new(1000);
        scene.take(Event::Joined);
        scene.take(Event::Keyframe(keyframe(1, 1, 10)));
        assert!(scene.lock().keyframes.is_empty());
        scene.take(Event::Keyframe(keyframe(2, 2, 10)));
        assert_eq!(scene.lock().keyframes.keys().collect::<Vec<_>>(), [&1]);
        let page = scene.open_page(1);
        assert!(scene.lock().keyframes.contains_key(&2), "a page that comes sees the active one");
        assert!(scene.open_page(1).is_none());
        drop(page);
        assert_eq!(scene.pages(), 0);
    }

    #[test]
    fn all_keyframes_together_stay_within_the_limit_of_points() {
        let scene = Scene::new(1000);
        let _page = scene.open_page(1);
        (0..20).for_each(|id| scene.take(Event::Keyframe(keyframe(id, id, 400))));
        let state = scene.lock();
        let total: usize = state.keyframes.values().map(|packed| packed.num_points()).sum();
        assert!(total <= 1000 && state.keyframes.len() >= 19, "{total}");
        assert!(state.keyframes.values().all(|packed| packed.num_points() > 0));
    }

    #[test]
    fn newer_revisions_of_the_map_are_missing_until_the_mapper_refuses() {
        let scene = Scene::new(1000);
        scene.take(Event::Keyframe(keyframe(1, 1, 5)));
        scene.take(Event::Keyframe(keyframe(4, 4, 5)));
        scene.take(graph(&[(1, 3), (2, 2), (3, 3), (4, 9)]));
        assert_eq!(scene.lock().missing(), [3, 2, 1]);
        scene.lock().give_up(2);
        scene.lock().keep(&keyframe(1, 3, 5));
        assert_eq!(scene.lock().missing(), [3]);
        scene.take(graph(&[(2, 3), (4, 9)]));
        assert_eq!(scene.lock().missing(), [2], "3 is not in the map any more, 2 has changed");
        assert_eq!(scene.lock().keyframes.keys().collect::<Vec<_>>(), [&4][..0]);
    }

    #[test]
    fn a_new_run_replaces_the_previous_one() {
        let scene = Scene::new(1000);
        scene.take(Event::Joined);
        scene.take(Event::Keyframe(keyframe(1, 1, 5)));
        scene.take(Event::Left);
        assert!(scene.lock().keyframes.contains_key(&1), "the map stays in view");
        scene.take(Event::Joined);
        let state = scene.lock();
        assert!(state.keyframes.is_empty() && state.run == 2 && state.is_joined);
    }
}
