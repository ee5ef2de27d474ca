//! Publishes the active keyframe, the graph, steps, and earlier keyframes on request.

use crate::service::adjustments::AdjustmentRecord;
use crate::service::adjustments::message::adjustment_message;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{DepthPoint, Keyframe, KeyframePose, MAX_KEYFRAME_POINTS};
use crate::slam::map::Map;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::{NO_KEYFRAME, PoseEstimate};
use crate::wire::conversion::{
    code_from_start_frame, keyframe_header, keyframe_image_header, keyframe_pose_message,
    rigid_message,
};
use crate::wire::message::{
    AdjustmentMessage, GraphHeader, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage,
    StepMessage,
};
use crate::wire::port::{Hub, OpenError, Publisher, SendError};
use crate::wire::topic::{
    ADJUSTMENT, EARLIER_KEYFRAME, EARLIER_KEYFRAME_IMAGE, GRAPH, KEYFRAME, KEYFRAME_IMAGE,
    MAX_GRAPH_KEYFRAMES, STEP,
};

/// Everything that the mapper publishes.
pub(super) struct Output {
    steps: Publisher<StepMessage, ()>,
    adjustments: Publisher<AdjustmentMessage, ()>,
    depths: Publisher<DepthPoint, KeyframeHeader>,
    graphs: Publisher<KeyframePoseMessage, GraphHeader>,
    earlier_depths: Publisher<DepthPoint, KeyframeHeader>,
    /// Opened with the first frame: they need the size of the images.
    images: Option<[Publisher<u8, KeyframeImageHeader>; 2]>,
}

impl Output {
    pub(super) fn open(hub: &Hub) -> Result<Self, OpenError> {
        Ok(Self {
            steps: hub.publisher(&STEP, 1)?,
            adjustments: hub.publisher(&ADJUSTMENT, 1)?,
            depths: hub.publisher(&KEYFRAME, MAX_KEYFRAME_POINTS)?,
            graphs: hub.publisher(&GRAPH, MAX_GRAPH_KEYFRAMES)?,
            earlier_depths: hub.publisher(&EARLIER_KEYFRAME, MAX_KEYFRAME_POINTS)?,
            images: None,
        })
    }

    pub(super) fn open_images(
        &mut self,
        hub: &Hub,
        intrinsics: &Intrinsics,
    ) -> Result<(), OpenError> {
        let pixels = intrinsics.width * intrinsics.height;
        let active = hub.publisher(&KEYFRAME_IMAGE, pixels)?;
        self.images = Some([active, hub.publisher(&EARLIER_KEYFRAME_IMAGE, pixels)?]);
        hub.reserve()
    }

    pub(super) fn serve_late_joiners(&self) {
        self.steps.serve_late_joiners();
        self.adjustments.serve_late_joiners();
        self.depths.serve_late_joiners();
        self.graphs.serve_late_joiners();
        self.earlier_depths.serve_late_joiners();
        self.images.iter().flatten().for_each(Publisher::serve_late_joiners);
    }

    /// Publishes the image before the depth: a subscriber that has the depth has the image.
    pub(super) fn publish(&self, mapper: &Mapper, outcome: &StepOutcome) -> Result<(), SendError> {
        let Some(keyframe) = mapper.keyframe() else { return Ok(()) };
        if outcome.needs_image() {
            self.publish_image(keyframe)?;
        }
        if outcome.needs_publishing() {
            self.depths.send(keyframe_header(keyframe), &keyframe.points)?;
        }
        if outcome.graph_changed {
            self.publish_graph(mapper.map(), keyframe)?;
        }
        Ok(())
    }

    /// Sends a requested keyframe, or returns why it cannot be sent.
    pub(super) fn publish_earlier(
        &self,
        map: Option<&Map>,
        keyframe_id: u64,
    ) -> Result<(), String> {
        let Some(keyframe) = map.and_then(|map| map.get(keyframe_id)) else {
            return Err(format!("there is no keyframe {keyframe_id} in the map"));
        };
        let (true, Some([_, images])) = (keyframe.has_depth(), &self.images) else {
            return Err(format!(
                "keyframe {keyframe_id} has only its pose; its depth was dropped to save memory"
            ));
        };
        let sent = images
            .send(keyframe_image_header(keyframe), &keyframe.image)
            .and_then(|()| self.earlier_depths.send(keyframe_header(keyframe), &keyframe.points));
        sent.map_err(|error| error.to_string())
    }

    pub(super) fn publish_adjustment(&self, record: &AdjustmentRecord) -> Result<(), SendError> {
        self.adjustments.send((), &[adjustment_message(record)])
    }

    /// After everything else of the frame: a subscriber that has the step has everything.
    pub(super) fn publish_step(
        &self,
        mapper: &Mapper,
        sequence: u64,
        [step_nanos, change_nanos]: [u64; 2],
        pose: Option<&PoseEstimate>,
    ) -> Result<(), SendError> {
        let keyframe = mapper.keyframe();
        let epoch = keyframe.map_or(0, |k| k.epoch);
        let pose = pose.filter(|pose| pose.epoch == epoch);
        let step = StepMessage {
            sequence,
            keyframe_id: keyframe.map_or(NO_KEYFRAME, |k| k.keyframe_id),
            revision: keyframe.map_or(0, |k| k.revision),
            step_nanos,
            change_nanos,
            keyframes: mapper.map().num_with_depth() as u64,
            points: keyframe.map_or(0, |k| k.points.len() as u64),
            pose_nanos: pose.map_or(0, |pose| pose.capture_nanos),
            world_from_camera: pose
                .map_or_else(Default::default, |pose| rigid_message(&pose.world_from_camera)),
            has_pose: u32::from(pose.is_some()),
            epoch,
            start_frame: code_from_start_frame(mapper.start_frame()),
            reserved: 0,
        };
        self.steps.send((), &[step])
    }

    fn publish_image(&self, keyframe: &Keyframe) -> Result<(), SendError> {
        match &self.images {
            Some([images, _]) => images.send(keyframe_image_header(keyframe), &keyframe.image),
            None => Ok(()),
        }
    }

    /// Publishes the keyframes of the epoch; the newest where a message cannot hold all.
    fn publish_graph(&self, map: &Map, newest: &Keyframe) -> Result<(), SendError> {
        let is_of_epoch = |keyframe: &&Keyframe| keyframe.epoch == newest.epoch;
        let count = map.keyframes.iter().filter(is_of_epoch).count();
        let poses: Vec<KeyframePoseMessage> = map
            .keyframes
            .iter()
            .filter(is_of_epoch)
            .skip(count.saturating_sub(MAX_GRAPH_KEYFRAMES))
            .map(|keyframe| keyframe_pose_message(&KeyframePose::of(keyframe)))
            .collect();
        let header = GraphHeader {
            revision: newest.revision,
            map_revision: map.revision,
            epoch: newest.epoch,
            reserved: 0,
        };
        self.graphs.send(header, &poses)
    }
}
