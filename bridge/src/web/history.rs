//! Keyframes that pages lack, about ten a second, or have in an outdated revision, one a second: requested
//! from the mapper while a page is open.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::wire::command::{Command, CommandClient, CommandError};
use semidense::wire::conversion::keyframe_from_messages;
use semidense::wire::message::{KeyframeHeader, KeyframeImageHeader};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, OpenError, Subscriber};
use semidense::wire::topic::{EARLIER_KEYFRAME, EARLIER_KEYFRAME_IMAGE};

use crate::web::scene::Scene;

/// Pause between two keyframes: each costs the mapper a copy of up to 2 MB, about a millisecond.
const REQUEST_PAUSE: Duration = Duration::from_millis(60);
/// Pause after a new revision: a correction of the map revises all of its keyframes.
const REVISION_PAUSE: Duration = Duration::from_secs(1);
/// Pause while nothing is missing or no page is open.
const IDLE_PAUSE: Duration = Duration::from_millis(300);
/// Pause after a failure: another reader holds the ports, or the run has just ended.
const FAILURE_PAUSE: Duration = Duration::from_secs(2);
/// Upper limit for the mapper's answer, which it sends between two frames.
const LONGEST_ANSWER: Duration = Duration::from_secs(2);

/// Requests missing keyframes until `is_over`.
pub fn follow(place: &Place, scene: &Arc<Scene>, is_over: &AtomicBool) {
    let mut asking: Option<(u64, KeyframeRequester)> = None;
    while !is_over.load(Ordering::Relaxed) {
        let (run, is_joined, wanted, is_known) = {
            let state = scene.lock();
            let wanted = state.missing().first().copied();
            let is_known = wanted.is_some_and(|id| state.keyframes.contains_key(&id));
            (state.run, state.is_joined, wanted, is_known)
        };
        if !is_joined || asking.as_ref().is_some_and(|(of, _)| *of != run) {
            asking = None;
        }
        let Some(keyframe_id) = wanted.filter(|_| is_joined && scene.pages() > 0) else {
            // The ports admit one reader: release them while nothing is wanted.
            asking = None;
            std::thread::sleep(IDLE_PAUSE);
            continue;
        };
        if asking.is_none() {
            match KeyframeRequester::open(place) {
                Ok(opened) => {
                    asking = Some((run, opened));
                    note(scene, "");
                }
                Err(error) => {
                    tracing::debug!("{error}");
                    note(
                        scene,
                        "keyframes from before this page was started are missing: another reader is requesting them",
                    );
                    std::thread::sleep(FAILURE_PAUSE);
                    continue;
                }
            }
        }
        let Some((_, ports)) = &asking else { continue };
        match ports.ask(keyframe_id) {
            Ok(Some(keyframe)) if scene.lock().run == run => {
                scene.lock().keep(&keyframe);
                scene.wake_waiting();
            }
            Ok(_) => {}
            Err(CommandError::Refused(_)) => scene.lock().give_up(keyframe_id),
            Err(error) => {
                tracing::debug!("{error}");
                asking = None;
                std::thread::sleep(FAILURE_PAUSE);
            }
        }
        std::thread::sleep(if is_known { REVISION_PAUSE } else { REQUEST_PAUSE });
    }
}

fn note(scene: &Scene, text: &str) {
    let mut state = scene.lock();
    if state.history_note != text {
        text.clone_into(&mut state.history_note);
        state.version += 1;
    }
}

/// The ports of a request; the hub is dropped last.
struct KeyframeRequester {
    depths: Subscriber<DepthPoint, KeyframeHeader>,
    images: Subscriber<u8, KeyframeImageHeader>,
    commands: CommandClient,
    _hub: Hub,
}

impl KeyframeRequester {
    fn open(place: &Place) -> Result<Self, OpenError> {
        let hub = Hub::join(place, "view-history", Access::Observer)?;
        Ok(Self {
            depths: hub.subscriber(&EARLIER_KEYFRAME)?,
            images: hub.subscriber(&EARLIER_KEYFRAME_IMAGE)?,
            commands: CommandClient::open(&hub)?,
            _hub: hub,
        })
    }

    /// Requests a keyframe; `None` if it does not arrive although the mapper has sent it.
    fn ask(&self, keyframe_id: u64) -> Result<Option<Keyframe>, CommandError> {
        let begin = Instant::now();
        let failed =
            |error: semidense::wire::port::ReceiveError| CommandError::Transport(error.to_string());
        self.commands.ask(&Command::SendKeyframe(keyframe_id), LONGEST_ANSWER, || {
            begin.elapsed() < LONGEST_ANSWER
        })?;
        let (depth, image) =
            (self.depths.newest().map_err(failed)?, self.images.newest().map_err(failed)?);
        let (Some(depth), Some(image)) = (depth, image) else { return Ok(None) };
        let (header, image_header) = (depth.header(), image.header());
        let keyframe =
            keyframe_from_messages(header, depth.payload(), image_header, image.payload());
        Ok(keyframe.ok().filter(|keyframe| keyframe.keyframe_id == keyframe_id))
    }
}
