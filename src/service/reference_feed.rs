//! The tracker's source of references: prepared on the spot in lockstep, so that the result is the same in every run;
//! on a second thread live, so that the frame loop only swaps a pointer.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;

use crate::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch};
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::Keyframe;
use crate::wire::conversion::rigid_from_message;
use crate::wire::keyframe_inbox::{InboxError, KeyframeInbox};
use crate::wire::message::StepMessage;
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, OpenError, Subscriber, wait};
use crate::wire::topic::STEP;

/// Longest sleep of the second thread between two checks for its end.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Used references whose memory is kept for the next: one in use, one prepared, one in preparation.
const MAX_USED: usize = 3;

/// The last claimed pose, according to the mapper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LastPose {
    /// Epoch of the map.
    pub epoch: u32,
    /// Stamp of its frame, nanoseconds.
    pub nanos: i64,
    /// The pose.
    pub world_from_camera: SE3,
}

impl LastPose {
    /// The pose in a step; `None` where it has none, or an invalid one.
    fn of(step: &StepMessage) -> Option<Self> {
        let world_from_camera = rigid_from_message(&step.world_from_camera, "world_from_camera");
        let (epoch, nanos) = (step.epoch, step.pose_nanos);
        let world_from_camera = world_from_camera.ok().filter(|_| step.has_pose == 1)?;
        Some(Self { epoch, nanos, world_from_camera })
    }
}

/// Provides the newest keyframe, prepared.
#[derive(Debug)]
pub enum ReferenceFeed {
    /// Prepares on request.
    Synchronous(Box<Synchronous>),
    /// Prepares alongside the frame loop.
    Threaded(Preparer),
}

impl ReferenceFeed {
    /// Prepares on request.
    pub fn synchronous(hub: &Hub, params: &ReferenceParams) -> Result<Self, OpenError> {
        let (inbox, params) = (KeyframeInbox::open(hub)?, params.clone());
        let scratch = ReferenceScratch::default();
        Ok(Self::Synchronous(Box::new(Synchronous { inbox, params, used: None, scratch })))
    }

    /// Prepares on a separate thread, which joins the instance separately.
    pub fn threaded(place: &Place, params: &ReferenceParams) -> io::Result<Self> {
        Ok(Self::Threaded(Preparer::start(place, params)?))
    }

    /// Live: the last camera pose in the mapper's steps, with the first reference of a restarted tracker. Returned
    /// once.
    pub fn last_pose(&self) -> Option<LastPose> {
        match self {
            Self::Threaded(preparer) => preparer.shared.last_pose.pop(),
            Self::Synchronous(_) => None,
        }
    }

    /// The newest reference that was not taken yet.
    pub fn newest(&mut self) -> Result<Option<Box<Reference>>, InboxError> {
        match self {
            Self::Threaded(preparer) => Ok(preparer.shared.prepared.pop()),
            Self::Synchronous(synchronous) => match synchronous.inbox.newest() {
                Ok(keyframe) => Ok(keyframe.map(|keyframe| {
                    let Synchronous { params, used, scratch, .. } = &mut **synchronous;
                    prepare(&keyframe, used.take(), params, scratch)
                })),
                Err(InboxError::Message(error)) => {
                    tracing::warn!("mapper/keyframe: {error}");
                    Ok(None)
                }
                Err(error) => Err(error),
            },
        }
    }

    /// Takes back a used reference: its memory serves the next one.
    pub fn give_back(&mut self, used: Box<Reference>) {
        match self {
            Self::Synchronous(synchronous) => synchronous.used = Some(used),
            Self::Threaded(preparer) => {
                // A full queue returns it, and it is freed here.
                let _ = preparer.shared.used.push(used);
            }
        }
    }
}

/// A reference of `keyframe`, in the memory of a used one if there is one.
fn prepare(
    keyframe: &Keyframe,
    used: Option<Box<Reference>>,
    params: &ReferenceParams,
    scratch: &mut ReferenceScratch,
) -> Box<Reference> {
    let mut reference = used.unwrap_or_else(|| Box::new(Reference::new(params.clone())));
    reference.prepare_into(keyframe, scratch);
    reference
}

/// Prepares on the tracker's own thread.
#[derive(Debug)]
pub struct Synchronous {
    inbox: KeyframeInbox,
    params: ReferenceParams,
    used: Option<Box<Reference>>,
    scratch: ReferenceScratch,
}

/// The second thread; ends when dropped.
#[derive(Debug)]
pub struct Preparer {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    prepared: ArrayQueue<Box<Reference>>,
    used: ArrayQueue<Box<Reference>>,
    last_pose: ArrayQueue<LastPose>,
    stop: AtomicBool,
}

impl Preparer {
    fn start(place: &Place, params: &ReferenceParams) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            prepared: ArrayQueue::new(1),
            used: ArrayQueue::new(MAX_USED),
            last_pose: ArrayQueue::new(1),
            stop: AtomicBool::new(false),
        });
        let (theirs, place, params) = (Arc::clone(&shared), place.clone(), params.clone());
        let thread = std::thread::Builder::new()
            .name("semidense-reference".to_owned())
            .spawn(move || prepare_until_stopped(&place, &params, &theirs))?;
        Ok(Self { shared, thread: Some(thread) })
    }
}

impl Drop for Preparer {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            let _ = thread.join();
        }
    }
}

type Opened = (KeyframeInbox, Subscriber<StepMessage, ()>, Hub);

/// Opens the ports, with retries: a tracker without keyframes is of no use. `None` once stopped.
fn open_until_stopped(place: &Place, shared: &Shared) -> Option<Opened> {
    let open = || -> Result<Opened, OpenError> {
        let hub = Hub::join(place, "tracker-reference", Access::Member)?;
        let ports = (KeyframeInbox::open(&hub)?, hub.subscriber(&STEP)?);
        hub.reserve()?;
        Ok((ports.0, ports.1, hub))
    };
    let mut said = LogOnChange::default();
    while !shared.stop.load(Ordering::Acquire) {
        match open() {
            Ok(opened) => return Some(opened),
            Err(error) => {
                said.changed_text(&error)
                    .inspect(|news| tracing::error!("no keyframes yet: {news}"));
            }
        }
        // A pause; if waiting fails, the next attempt is only sooner.
        drop(wait(&[], None, WAKE_PERIOD));
    }
    None
}

fn prepare_until_stopped(place: &Place, params: &ReferenceParams, shared: &Shared) {
    let Some((mut inbox, steps, _hub)) = open_until_stopped(place, shared) else { return };
    // Until the first keyframe. Here and not in the frame loop, as it maps memory of the mapper.
    let mut steps: Option<Subscriber<StepMessage, ()>> = Some(steps);
    let mut said = LogOnChange::default();
    let mut scratch = ReferenceScratch::default();
    while !shared.stop.load(Ordering::Acquire) {
        if let Err(error) = wait(&[inbox.events()], None, WAKE_PERIOD) {
            tracing::error!("no longer receiving keyframes: {error}");
            return;
        }
        match inbox.newest() {
            Ok(None) => {}
            Ok(Some(keyframe)) => {
                said = LogOnChange::default();
                // A reference that the tracker has not taken yet is older: its memory is reused.
                let reference = prepare(&keyframe, shared.used.pop(), params, &mut scratch);
                if let Some(last) = steps.take().and_then(|steps| last_pose(&steps)) {
                    shared.last_pose.force_push(last);
                }
                if let Some(older) = shared.prepared.force_push(reference) {
                    drop(shared.used.push(older));
                }
            }
            Err(error) => {
                said.changed_text(&error).inspect(|news| tracing::warn!("{news}"));
            }
        }
    }
}

/// Keeps a recurring error from filling the log.
#[derive(Debug, Default)]
struct LogOnChange(String);

impl LogOnChange {
    /// The text of an error that differs from the last.
    fn changed_text(&mut self, error: &dyn std::error::Error) -> Option<String> {
        let text = error.to_string();
        (text != self.0).then(|| self.0.clone_from(&text))?;
        Some(text)
    }
}

fn last_pose(steps: &Subscriber<StepMessage, ()>) -> Option<LastPose> {
    let newest = steps.newest();
    let newest = newest.inspect_err(|error| tracing::warn!("{error}")).ok()??;
    LastPose::of(newest.payload().first()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_reported_once_per_change() {
        let error = |text: &str| io::Error::other(text.to_owned());
        let mut said = LogOnChange::default();
        let news: Vec<_> = ["a", "a", "b", "b", "a"]
            .iter()
            .filter_map(|text| said.changed_text(&error(text)))
            .collect();
        assert_eq!(news, ["a", "b", "a"]);
    }
}
