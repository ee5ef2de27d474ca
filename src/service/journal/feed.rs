//! The keyframes that the mapper publishes, for the journal: the newest revision of each.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use crate::service::journal::Journal;
use crate::service::journal::log::Record;
use crate::slam::keyframe::{DepthPoint, KeyframePose};
use crate::wire::conversion::{keyframe_from_messages, keyframe_pose_from_message};
use crate::wire::message::{GraphHeader, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage};
use crate::wire::port::{Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::{GRAPH, KEYFRAME, KEYFRAME_IMAGE};

/// Time between two writes of the same keyframe to the journal: up to 2 MB each.
const PERIOD: Duration = Duration::from_millis(1500);

/// Follows the mapper's keyframes. Data that waits for the journal is copied: the last depth of a keyframe is only
/// recognised when that of the next arrives, and a subscriber holds one message at a time.
#[derive(Debug)]
pub struct KeyframeFeed {
    depths: Subscriber<DepthPoint, KeyframeHeader>,
    images: Subscriber<u8, KeyframeImageHeader>,
    graphs: Subscriber<KeyframePoseMessage, GraphHeader>,
    depth: Option<(KeyframeHeader, Vec<DepthPoint>)>,
    image: Option<(KeyframeImageHeader, Vec<u8>)>,
    /// Revision in the journal, and since when.
    kept: Option<(u64, Instant)>,
    /// Epochs and poses in the journal, by keyframe.
    poses: HashMap<u64, (u32, KeyframePose)>,
}

impl KeyframeFeed {
    /// Subscribes from now on.
    pub fn open(hub: &Hub) -> Result<Self, OpenError> {
        Ok(Self {
            depths: hub.subscriber(&KEYFRAME)?,
            images: hub.subscriber(&KEYFRAME_IMAGE)?,
            graphs: hub.subscriber(&GRAPH)?,
            depth: None,
            image: None,
            kept: None,
            poses: HashMap::new(),
        })
    }

    /// Takes in what has arrived and gives the journal what is due; at the end everything is.
    pub fn collect(&mut self, journal: &mut Journal, is_end: bool) -> Result<(), ReceiveError> {
        while let Some(depth) = self.depths.receive()? {
            let before = self.depth.as_ref().map(|(before, _)| before.keyframe_id);
            if before.is_some_and(|before| before != depth.header().keyframe_id) {
                // The last depth of a keyframe, while its image is still held.
                self.keep(journal);
                self.kept = None;
            }
            put(&mut self.depth, depth.header(), depth.payload());
        }
        while let Some(image) = self.images.receive()? {
            put(&mut self.image, image.header(), image.payload());
        }
        let is_due = self.kept.is_none_or(|(_, at)| at.elapsed() >= PERIOD);
        if is_due || is_end {
            self.keep(journal);
        }
        self.collect_graph(journal)
    }

    /// Gives the journal the newest state of the keyframe, where the journal's is older.
    fn keep(&mut self, journal: &mut Journal) {
        let (Some((header, points)), Some((image_header, pixels))) = (&self.depth, &self.image)
        else {
            return;
        };
        let is_known = self.kept.is_some_and(|(revision, _)| revision == header.revision);
        let same =
            (header.epoch, header.keyframe_id) == (image_header.epoch, image_header.keyframe_id);
        if is_known || !same {
            return;
        }
        match keyframe_from_messages(header, points, image_header, pixels) {
            Err(error) => tracing::warn!("mapper/keyframe: {error}"),
            Ok(keyframe) => {
                let (epoch, pose) = (keyframe.epoch, KeyframePose::of(&keyframe));
                if journal.put_keyframe(keyframe).is_none() {
                    self.kept = Some((pose.revision, Instant::now()));
                    self.poses.insert(pose.keyframe_id, (epoch, pose));
                }
            }
        }
    }

    /// Gives the journal the poses that have changed.
    fn collect_graph(&mut self, journal: &mut Journal) -> Result<(), ReceiveError> {
        let Some(graph) = self.graphs.newest()? else { return Ok(()) };
        let epoch = graph.header().epoch;
        for message in graph.payload() {
            let Ok(pose) = keyframe_pose_from_message(message) else { continue };
            let known = self.poses.get_mut(&pose.keyframe_id);
            let is_moved = |(of, known): &&mut (u32, KeyframePose)| {
                (*of, known.map_from_keyframe) != (epoch, pose.map_from_keyframe)
            };
            if let Some(known) = known.filter(is_moved) {
                *known = (epoch, pose);
                journal.append(&Record::KeyframePose(epoch, pose));
            }
        }
        Ok(())
    }
}

/// Copies a message into the memory of the previous one.
fn put<H: Copy, T: Copy>(held: &mut Option<(H, Vec<T>)>, header: &H, payload: &[T]) {
    let mut memory = held.take().map_or_else(Vec::new, |(_, memory)| memory);
    memory.clear();
    memory.extend_from_slice(payload);
    *held = Some((*header, memory));
}
