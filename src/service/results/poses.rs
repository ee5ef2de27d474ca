//! The trajectories and keyframe poses of a run.

use std::collections::{BTreeMap, HashMap};
use std::io::{self, Write};
use std::path::Path;

use crate::service::atomic_file::write_atomically;
use crate::service::results::record::{RecordedPose, RunRecord};
use crate::service::trajectory_file::tum_line;
use crate::slam::evaluation::MAX_DIFFERENCE_NANOS;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::evaluation::normalized_error::{
    NormalizedErrors, map_normalized_errors, normalized_errors,
};
use crate::slam::evaluation::velocity_error::velocity_normalized_errors;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::slam::pose::PoseEstimate;
use crate::slam::trajectory::{EpochPose, StampedPose};

/// First line of `trajectory.txt`.
pub const FINAL_COMMENT: &str = "map_from_camera of every tracked frame: final pose of its keyframe x \
    relative pose; without those on rejected keyframes";

/// First line of `trajectory_online.txt`.
pub const ONLINE_COMMENT: &str = "world_from_camera of every tracked frame as it was published";

/// The epoch with the most tracked frames, the earliest of equals; `None` where none is tracked. Each epoch has a
/// separate coordinate frame and scale, so that only one can be compared with ground truth.
pub fn longest_epoch(record: &RunRecord) -> Option<u32> {
    most_frequent(tracked(record).map(|estimate| final_epoch(record, estimate)))
}

/// Whether the final trajectory leaves a frame out: its keyframe was rejected afterwards, while others of its epoch
/// stand, and it was not aligned to their points. Given poses do not depend on the map.
fn is_withdrawn(record: &RunRecord, estimate: &PoseEstimate) -> bool {
    let map = &record.map;
    let is_established = |of: &Keyframe| of.map_state == MapState::Established;
    let is_on_rejected = |keyframe: &Keyframe| {
        let of_epoch = |of: &&Keyframe| of.epoch == keyframe.epoch;
        !is_established(keyframe) && map.keyframes.iter().filter(of_epoch).any(is_established)
    };
    estimate.state.is_tracked()
        && record.depth_scale != DepthScale::Given
        && map.frame(estimate.sequence).is_none()
        && map.get(estimate.keyframe_id).is_some_and(is_on_rejected)
}

/// The epoch that occurs most often, the earliest of equals.
fn most_frequent(epochs: impl Iterator<Item = u32>) -> Option<u32> {
    let mut frames = BTreeMap::new();
    for epoch in epochs {
        *frames.entry(epoch).or_insert(0_usize) += 1;
    }
    frames.into_iter().rev().max_by_key(|&(_, count)| count).map(|(epoch, _)| epoch)
}

/// Every frame with a pose, at the final pose of its keyframe in the map, with the epoch that it belongs to in the end:
/// tracked frames, except those on a rejected keyframe, and frames from before the start of their map that were
/// aligned to it afterwards. A tracked frame whose keyframe the final map does not hold keeps its published pose. Empty
/// where no frame was tracked on arrival: a map that began with the last frames is unproven.
pub fn final_poses(record: &RunRecord) -> Vec<EpochPose> {
    if !is_any_tracked(&record.poses) {
        return Vec::new();
    }
    let keyframes = record.map.keyframes.iter();
    let places: HashMap<u64, _> = keyframes.map(|k| (k.keyframe_id, k)).collect();
    let estimates = record.poses.iter().map(|pose| &pose.estimate);
    let kept = estimates.filter(|estimate| !is_withdrawn(record, estimate));
    let with_pose = kept.filter_map(|estimate| {
        let (keyframe_id, at) = match record.map.frame(estimate.sequence) {
            Some(aligned) => (aligned.keyframe_id, &aligned.keyframe_from_camera),
            None if !estimate.state.is_tracked() => return None,
            None => (estimate.keyframe_id, &estimate.keyframe_from_camera),
        };
        let (epoch, place) = match places.get(&keyframe_id) {
            Some(keyframe) => (keyframe.epoch, keyframe.map_from_keyframe.transform_pose(at)),
            None => (estimate.epoch, estimate.map_from_camera),
        };
        let pose = StampedPose { nanos: estimate.capture_nanos, world_from_camera: place };
        Some(EpochPose { epoch, pose })
    });
    with_pose.collect()
}

/// The poses of one epoch; empty for `None`.
pub fn of_epoch(poses: &[EpochPose], epoch: Option<u32>) -> Vec<StampedPose> {
    poses.iter().filter(|of| Some(of.epoch) == epoch).map(|of| of.pose).collect()
}

/// Frames from before the start of their map that were aligned to it afterwards.
pub fn placed_later<'a>(
    poses: &'a [RecordedPose],
    map: &'a Map,
) -> impl Iterator<Item = &'a PoseEstimate> {
    let is_proven = is_any_tracked(poses);
    let estimates = poses.iter().map(|pose| &pose.estimate);
    estimates
        .filter(move |of| is_proven && !of.state.is_tracked() && map.frame(of.sequence).is_some())
}

fn is_any_tracked(poses: &[RecordedPose]) -> bool {
    poses.iter().any(|pose| pose.estimate.state.is_tracked())
}

/// The epoch that a frame belongs to in the end: its own may have been joined to another.
fn final_epoch(record: &RunRecord, estimate: &PoseEstimate) -> u32 {
    record.map.get(estimate.keyframe_id).map_or(estimate.epoch, |keyframe| keyframe.epoch)
}

/// Tracked frames of one epoch as published. Where other epochs were joined to it, each had a separate world, in which
/// odometry stayed: the frames of the world with the most of them.
pub fn online_trajectory(record: &RunRecord, epoch: Option<u32>) -> Vec<StampedPose> {
    let is_of_epoch = tracked(record).map(|of| Some(final_epoch(record, of)) == epoch);
    let with_world = online_poses(record).into_iter().zip(is_of_epoch);
    let poses: Vec<EpochPose> = with_world.filter_map(|(pose, is)| is.then_some(pose)).collect();
    of_epoch(&poses, most_frequent(poses.iter().map(|of| of.epoch)))
}

/// Every tracked frame as published, with the epoch that its world began with.
pub fn online_poses(record: &RunRecord) -> Vec<EpochPose> {
    let with_epoch = tracked(record).scan(0, |newest, estimate| {
        // Where an epoch is joined to an older one, or an older one is resumed, odometry does not jump.
        *newest = estimate.epoch.max(*newest);
        Some(EpochPose { epoch: *newest, pose: in_world(estimate) })
    });
    with_epoch.collect()
}

fn tracked(record: &RunRecord) -> impl Iterator<Item = &PoseEstimate> {
    record.poses.iter().map(|pose| &pose.estimate).filter(|of| of.state.is_tracked())
}

fn in_world(estimate: &PoseEstimate) -> StampedPose {
    StampedPose { nanos: estimate.capture_nanos, world_from_camera: estimate.world_from_camera }
}

/// Errors of the tracked frames of one epoch relative to their covariance: on their keyframes, in the map and of their
/// velocities; `None` without ground truth, or where poses were given.
pub fn normalized_errors_of(
    record: &RunRecord,
    epoch: Option<u32>,
) -> [Option<NormalizedErrors>; 3] {
    if record.depth_scale == DepthScale::Given {
        return [None; 3];
    }
    let in_epoch = |of: u32| epoch.is_none_or(|epoch| of == epoch);
    let tracked: Vec<&PoseEstimate> =
        tracked(record).filter(|estimate| in_epoch(final_epoch(record, estimate))).collect();
    let keyframes = record.own_keyframes().filter(|keyframe| in_epoch(keyframe.epoch));
    let stamps: Vec<(u64, i64)> = keyframes.map(|k| (k.keyframe_id, k.capture_nanos)).collect();
    let truth = &record.ground_truth;
    // Before its epoch was joined to this one, a frame was placed in another map.
    let in_map: Vec<&PoseEstimate> =
        tracked.iter().copied().filter(|estimate| in_epoch(estimate.epoch)).collect();
    [
        normalized_errors(&tracked, &stamps, truth, MAX_DIFFERENCE_NANOS),
        map_normalized_errors(&in_map, truth, MAX_DIFFERENCE_NANOS),
        velocity_normalized_errors(&tracked, &stamps, truth, MAX_DIFFERENCE_NANOS),
    ]
}

/// The pose of a keyframe in the map.
pub fn keyframe_pose(keyframe: &Keyframe) -> StampedPose {
    StampedPose {
        nanos: keyframe.capture_nanos,
        world_from_camera: keyframe.map_from_keyframe.rigid,
    }
}

/// The keyframes of the longest epoch: each epoch has a separate world and unit.
pub fn keyframes_of_longest_epoch(record: &RunRecord) -> impl Iterator<Item = &Keyframe> {
    let epoch = longest_epoch(record);
    record.map.keyframes.iter().filter(move |k| epoch.is_none_or(|epoch| k.epoch == epoch))
}

/// Writes one line per keyframe: its pose as in a TUM file, then what a map needs besides.
pub fn write_keyframes(path: &Path, map: &Map) -> io::Result<()> {
    write_atomically(path, |file| {
        writeln!(file, "# map_from_keyframe; lengths in the keyframe x scale = map units")?;
        writeln!(
            file,
            "# timestamp tx ty tz qx qy qz qw scale keyframe_id sequence epoch points state"
        )?;
        map.keyframes.iter().try_for_each(|k| {
            writeln!(
                file,
                "{} {} {} {} {} {} {:?}",
                tum_line(&keyframe_pose(k)),
                k.map_from_keyframe.scale,
                k.keyframe_id,
                k.sequence,
                k.epoch,
                k.points.len(),
                k.map_state,
            )
        })
    })
}
