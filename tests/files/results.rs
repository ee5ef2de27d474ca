//! The files that a run leaves behind, from handmade records.

use crate::records::{UNIT_M, keyframe, nanos, pose, record, written};
use semidense::service::adjustments::{AdjustmentRecord, Fate, SearchRecord};
use semidense::service::results::output_folder::prepare_output;
use semidense::service::results::record::{LoadedMap, Rejection, RunRecord};
use semidense::service::trajectory_file::{read_trajectory, read_trajectory_file};
use semidense::slam::evaluation::MAX_DIFFERENCE_NANOS;
use semidense::slam::evaluation::depth_error::DepthScale;
use semidense::slam::evaluation::epochs::evaluate_epochs;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::graph::constraint::Refusal;
use semidense::slam::keyframe::{Keyframe, MapState};
use semidense::slam::loops::{SearchOutcome, SearchReport};
use semidense::slam::map::{ConfirmedPoint, RealignedFrame};
use semidense::slam::mapper::consistency::Contradiction;
use semidense::slam::pose::{DegradedReason, LostReason, TrackingState};
use semidense::slam::window::Adjustment;
use std::path::Path;

#[test]
fn frames_aligned_afterwards_count_only_if_the_map_was_tracked_on() {
    let placed = |record: &RunRecord| -> RunRecord {
        let mut record = record.clone();
        for sequence in 0..3 {
            let keyframe_from_camera = SE3::identity();
            record.map.store_frame_pose(&RealignedFrame {
                sequence,
                keyframe_id: 0,
                keyframe_from_camera,
            });
        }
        record
    };
    let state =
        |i, last| if i < last { TrackingState::Initializing } else { TrackingState::Tracking };
    for (last, tracked, later) in [(8, 5, 3), (10, 0, 0)] {
        let poses = (0..10).map(|i| pose(i, state(i, last), 0)).collect();
        let record = placed(&record(poses, vec![keyframe(0)], false));
        let folder = tempfile::tempdir().unwrap();
        let (summary, _) = written(&folder.path().join("out"), &record);
        assert_eq!(summary["frames_tracked"], tracked);
        assert_eq!(summary["frames_tracked_later"], later);
        assert_eq!(summary["untracked"].is_null(), tracked > 0);
        let lines = std::fs::read_to_string(folder.path().join("out/trajectory.txt")).unwrap();
        assert_eq!(lines.lines().filter(|line| !line.starts_with('#')).count(), tracked);
    }
}

#[test]
fn frames_on_a_keyframe_rejected_afterwards_are_left_out_of_the_trajectory() {
    let poses = (0..50).map(|i| pose(i, TrackingState::Tracking, u64::from(i >= 20))).collect();
    let mut record = record(poses, vec![keyframe(0), keyframe(1)], true);
    record.map.keyframes[1].map_state = MapState::Rejected;
    let (sequence, keyframe_from_camera) = (45, SE3::identity());
    let aligned = RealignedFrame { sequence, keyframe_id: 1, keyframe_from_camera };
    record.map.store_frame_pose(&aligned);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trajectory.txt");
    let check = |record: &RunRecord, left: &[usize]| {
        let (summary, _) = written(folder.path(), record);
        assert_eq!(summary["frames_tracked"], 50);
        assert_eq!(summary["frames_withdrawn"], 50 - left.iter().sum::<usize>());
        let found = poses_by_epoch(&path).into_iter().map(|(_, poses)| poses);
        assert_eq!(found.collect::<Vec<_>>(), left);
    };
    // 20 frames on the first keyframe, 30 on the second, of which one was aligned.
    check(&record, &[21]);
    // Given poses do not come from the map.
    check(&RunRecord { depth_scale: DepthScale::Given, ..record.clone() }, &[50]);
    // An epoch of which nothing stands is marked as another.
    record.map.keyframes[1].epoch = 1;
    check(&record, &[20, 30]);
}

#[test]
fn a_map_loaded_on_request_is_not_graded_as_a_broken_one() {
    let poses = (0..60).map(|i| pose(i, TrackingState::Tracking, i as u64 / 20)).collect();
    let in_epoch = |id| Keyframe { epoch: id as u32, ..keyframe(id) };
    let record = record(poses, (0..3).map(in_epoch).collect(), false);
    for (first_epoch, parts) in [(None, Some(3)), (Some(1), Some(2)), (Some(2), None)] {
        let (folder, read_only) = (String::new(), false);
        let first_keyframe_id = 0;
        let loaded_map = first_epoch.map(|first_epoch| LoadedMap {
            folder,
            read_only,
            first_epoch,
            first_keyframe_id,
        });
        let folder = tempfile::tempdir().unwrap();
        let loaded = RunRecord { loaded_map, ..record.clone() };
        let (summary, _) = written(&folder.path().join("out"), &loaded);
        assert_eq!(summary["epochs"], 3);
        let reasons = summary["grade"]["reasons"].to_string();
        let expected = parts.map(|parts| format!("the map has {parts} separate parts"));
        assert_eq!(reasons.contains("separate parts"), parts.is_some(), "{reasons}");
        assert!(reasons.contains(&expected.unwrap_or_default()), "{reasons}");
    }
}

#[test]
fn keyframes_of_earlier_runs_are_not_compared() {
    const VARIANCES: [usize; 6] = [0, 6, 11, 15, 18, 20];
    let certain = |i| {
        let mut pose = pose(i, TrackingState::Tracking, u64::from(i >= 40));
        VARIANCES.iter().for_each(|&at| pose.estimate.covariance[at] = 1e-4);
        pose
    };
    // After a restart the keyframes are in the order of their epochs.
    for (order, first_keyframe_id, frames, pixels) in
        [([0, 1], 0, 60, 40), ([0, 1], 1, 20, 20), ([1, 0], 1, 20, 20)]
    {
        let record = record((0..60).map(certain).collect(), order.map(keyframe).to_vec(), true);
        let record = RunRecord { first_keyframe_id, ..record };
        let folder = tempfile::tempdir().unwrap();
        let (summary, _) = written(&folder.path().join("out"), &record);
        assert_eq!(summary["keyframes"], 2, "of the map");
        assert_eq!(
            (&summary["nees_frames"], &summary["depth_pixels"]),
            (&frames.into(), &pixels.into())
        );
    }
}

#[test]
fn figures_and_files_of_a_run_with_truth_and_a_loss() {
    let state = |i| match i {
        0..3 => TrackingState::Initializing,
        20 | 21 | 30 => TrackingState::Lost(LostReason::TooFewInliers),
        25 => TrackingState::Degraded(DegradedReason::LowOverlap),
        _ => TrackingState::Tracking,
    };
    let poses = (0..60).map(|i| pose(i, state(i), u64::from(i >= 40))).collect();
    let contradiction = Contradiction::ScaleJump;
    let reason = contradiction.to_string();
    let rejections = Some(vec![Rejection { sequence: 20, reason }]);
    let record = record(poses, vec![keyframe(0), keyframe(1)], true);
    let record = RunRecord { rejections, ..record };
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("deep/output");
    let (summary, report) = written(&dir, &record);

    for (key, value) in [
        ("frames_in", 60.0),
        ("frames_tracked", 54.0),
        ("frames_degraded", 1.0),
        ("frames_initializing", 3.0),
        ("frames_lost", 3.0),
        ("lost_count", 2.0),
        ("keyframes", 2.0),
        ("points", 38.0),
        ("matched_poses", 54.0),
        ("realtime_factor", 2.0),
    ] {
        assert_eq!(summary[key].as_f64(), Some(value), "{key}");
    }
    assert!((summary["initialization_secs"].as_f64().unwrap() - 0.1).abs() < 1e-6);
    let rejected = serde_json::json!([{ "sequence": 20, "reason": contradiction.to_string() }]);
    assert_eq!(summary["map_rejections"], rejected);
    assert_eq!(summary["track_ms"]["max"], 7.0);
    assert_eq!(summary["pyramid_ms"]["p50"], 0.05);
    let levels = serde_json::json!([{ "level": 1, "frames": 57, "points": 1000.0,
        "iterations_median": 2.0, "iterations_mean": 3.0, "nanos_per_point": 3.0 }]);
    assert_eq!(summary["alignment_levels"], levels);
    assert!(summary["latency_ms"].is_null() && summary["deadline_ms"].is_null());
    // The published poses are correct up to their scale; in the final ones the keyframe has moved.
    assert!(summary["online"]["ate_rmse_m"].as_f64().unwrap() < 1e-9);
    assert!((summary["online"]["ate_scale"].as_f64().unwrap() - UNIT_M).abs() < 1e-9);
    assert!(summary["ate_rmse_m"].as_f64().unwrap() > 0.01);
    assert!(summary["depth_relative_error_median"].as_f64().unwrap() < 1e-6);
    assert_eq!(summary["depth_pixels"], 40);
    assert!(report.contains("Position error") && report.contains("data:image/png"));

    for (name, pose) in [
        ("trajectory.txt", "# map_from_camera of"),
        ("trajectory_online.txt", "# world_from_camera of"),
        ("keyframes.txt", "# map_from_keyframe;"),
    ] {
        assert!(std::fs::read_to_string(dir.join(name)).unwrap().starts_with(pose), "{name}");
    }
    let last = read_trajectory(&dir.join("trajectory.txt")).unwrap()[53];
    assert_eq!(last.nanos, nanos(59));
    let online = read_trajectory(&dir.join("trajectory_online.txt")).unwrap()[53];
    let moved = last.world_from_camera.translation - online.world_from_camera.translation;
    assert!((moved.x - 1.0).abs() < 1e-12 && moved.y.abs() < 1e-12);

    let names: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 7, "nothing temporary is left: {names:?}");
}

#[test]
fn joint_estimates_are_in_summary_and_report_and_their_points_in_a_file() {
    let estimate = |sequence: u64, fate| AdjustmentRecord {
        sequence,
        frames: 3,
        nanos: 1_000_000 * sequence,
        fate,
        adjustment: Adjustment {
            inlier_ratio: 0.9,
            rms_grey: 0.1 * sequence as f64,
            ..Adjustment::default()
        },
    };
    let fates = [(10, Fate::Entered), (20, Fate::Merged), (30, Fate::Dropped)];
    let point = |keyframe_id: u64, u: u16| ConfirmedPoint {
        keyframe_id,
        u,
        v: 3,
        confirmations: 7,
        inverse_depth: 0.25,
        intensity: 99.0,
    };
    let poses = (0..60).map(|i| pose(i, TrackingState::Tracking, u64::from(i >= 40))).collect();
    let mut record = record(poses, vec![keyframe(0), keyframe(1)], false);
    record.adjustments = fates.map(|(sequence, fate)| estimate(sequence, fate)).to_vec();
    // A point whose keyframe is gone has no position.
    record.map.confirmed = vec![point(0, 1), point(1, 1), point(5, 1)];
    let folder = tempfile::tempdir().unwrap();
    let (summary, report) = written(folder.path(), &record);
    for (key, value) in [
        ("adjustments", 2.0),
        ("adjustments_merged", 1.0),
        ("adjustments_dropped", 1.0),
        ("adjustment_frames_max", 3.0),
        ("adjustment_inlier_ratio_median", 0.9),
        ("adjustment_rms_grey_median", 2.0),
    ] {
        assert_eq!(summary[key].as_f64(), Some(value), "{key}");
    }
    assert_eq!(summary["adjustment_ms"]["max"], 30.0);
    assert!(report.contains("Joint estimation") && report.contains("Inliers of joint estimates"));
    let ply = std::fs::read(folder.path().join("points.ply")).unwrap();
    let begin = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert_eq!(ply.len() - begin, 2 * 24, "2 points of six numbers");
    let number = |at: usize| f32::from_le_bytes(ply[begin + at..][..4].try_into().unwrap());
    let count = |at: usize| u32::from_le_bytes(ply[begin + at..][..4].try_into().unwrap());
    assert!((number(8) - 2.0).abs() < 1e-6, "4 keyframe units are 2 map units");
    assert!((number(24) - number(0) - 1.0).abs() < 1e-6, "the second keyframe has moved by 1");
    assert_eq!((number(12), count(16), count(20), count(44)), (99.0, 7, 0, 1));
}

#[test]
fn searches_for_loops_are_in_summary_and_report() {
    let search = |keyframe_id: u64, fate| SearchRecord {
        sequence: 5,
        nanos: 2_000_000,
        report: SearchReport {
            keyframe_id,
            other: Some(0),
            likeness: 20.0,
            compared: 1,
            outcome: fate,
            measured: None,
        },
    };
    let poses = (0..60).map(|i| pose(i, TrackingState::Tracking, u64::from(i >= 40))).collect();
    let mut record = record(poses, vec![keyframe(0), keyframe(1)], false);
    let folder = tempfile::tempdir().unwrap();
    let (_, report) = written(folder.path(), &record);
    assert!(!report.contains("<h2>Loops</h2>"), "none was looked for");
    let fates = [
        SearchOutcome::Proposed,
        SearchOutcome::Closed,
        SearchOutcome::Refused(Refusal::FewInliers),
        SearchOutcome::Refused(Refusal::NotReciprocal(20.0)),
        SearchOutcome::Refused(Refusal::NotReciprocal(30.0)),
        SearchOutcome::AgainstDrift(99.0),
    ];
    record.searches = Some(fates.map(|fate| search(1, fate)).to_vec());
    let (summary, report) = written(tempfile::tempdir().unwrap().path(), &record);
    for (key, value) in [
        ("loop_searches", 5),
        ("loops_closed", 1),
        ("loops_refused", 3),
        ("loops_against_drift", 1),
    ] {
        assert_eq!(summary[key].as_u64(), Some(value), "{key}");
    }
    for part in [
        "<h2>Loops</h2>",
        "5 keyframes searched, 1 closed, 0 held already",
        "2 times the two directions disagree; 1 time too few points are inliers",
        "Loops from above",
        "against the drift",
    ] {
        assert!(report.contains(part), "{part}");
    }
}

#[test]
fn the_longest_of_several_epochs_is_evaluated_and_all_are_written() {
    let mut poses: Vec<_> = (0..60).map(|i| pose(i, TrackingState::Tracking, 0)).collect();
    for pose in &mut poses[20..] {
        // The second epoch has a different origin and unit.
        pose.estimate.epoch = 1;
        pose.estimate.keyframe_id = 1;
        pose.estimate.world_from_camera.translation *= 3.0;
        pose.estimate.world_from_camera.translation.x += 100.0;
        // The final map has no keyframe for it.
        pose.estimate.map_from_camera = pose.estimate.world_from_camera;
    }
    let folder = tempfile::tempdir().unwrap();
    let (summary, report) = written(folder.path(), &record(poses, Vec::new(), true));
    assert_eq!((&summary["epochs"], &summary["evaluated_epoch"]), (&2.into(), &1.into()));
    assert_eq!(summary["matched_poses"], 40);
    assert!(summary["ate_rmse_m"].as_f64().unwrap() < 1e-9);
    assert!((summary["ate_scale"].as_f64().unwrap() - UNIT_M / 3.0).abs() < 1e-9);
    assert!(report.contains("Position error"));
    assert_eq!(read_trajectory(&folder.path().join("trajectory.txt")).unwrap().len(), 60);
}

/// Number of poses of each epoch of a trajectory file, in the order of its comments.
fn poses_by_epoch(path: &Path) -> Vec<(String, usize)> {
    let mut parts: Vec<(String, usize)> = vec![(String::new(), 0)];
    for line in std::fs::read_to_string(path).unwrap().lines().skip(2) {
        match line.strip_prefix("# epoch ").and_then(|rest| rest.split_once(':')) {
            Some((epoch, _)) => parts.push((epoch.to_owned(), 0)),
            None => parts.last_mut().unwrap().1 += 1,
        }
    }
    parts.retain(|(_, poses)| *poses > 0);
    parts
}

#[test]
fn trajectories_mark_where_another_epoch_begins() {
    let epoch_of = |i: usize| if (20..40).contains(&i) { 1 } else { 0 };
    let state = |i| match i {
        15..20 => TrackingState::Lost(LostReason::TooFewInliers),
        _ => TrackingState::Tracking,
    };
    let mut poses: Vec<_> = (0..60).map(|i| pose(i, state(i), 0)).collect();
    for (i, pose) in poses.iter_mut().enumerate() {
        pose.estimate.epoch = epoch_of(i);
        pose.estimate.keyframe_id = u64::from(epoch_of(i));
        // Variances on the diagonal.
        for place in [0, 6, 11, 15, 18, 20] {
            pose.estimate.map_covariance[place] = 1e-4;
        }
        if i >= 20 {
            // Odometry starts with another unit.
            pose.estimate.world_from_camera.translation *= 3.0;
        }
    }
    let mut record = record(poses, vec![keyframe(0), keyframe(1)], true);
    // Two frames before the second epoch are aligned to it afterwards.
    record.map.keyframes[1].epoch = 1;
    for sequence in 18..20 {
        let keyframe_from_camera = SE3::identity();
        record.map.store_frame_pose(&RealignedFrame {
            sequence,
            keyframe_id: 1,
            keyframe_from_camera,
        });
    }
    let part = |epoch: &str, poses: usize| (epoch.to_owned(), poses);
    let parts = |record: &RunRecord| {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path(), record);
        ["trajectory.txt", "trajectory_online.txt"]
            .map(|name| poses_by_epoch(&folder.path().join(name)))
    };
    // Odometry stays in the second world when the first epoch is resumed.
    let online = vec![part("0", 15), part("1", 40)];
    let apart = vec![part("0", 15), part("1", 22), part("0", 20)];
    assert_eq!(parts(&record), [apart, online.clone()]);
    // The figures of the run equal those of `evaluate` for its longest epoch.
    let folder = tempfile::tempdir().unwrap();
    let (summary, _) = written(folder.path(), &record);
    let file = read_trajectory_file(&folder.path().join("trajectory.txt")).unwrap();
    let truth = &record.ground_truth;
    let found =
        evaluate_epochs(&file.poses, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
            .unwrap();
    let longest = found.epochs.iter().find(|of| summary["evaluated_epoch"] == of.epoch).unwrap();
    let longest = longest.result.as_ref().unwrap();
    assert_eq!((&summary["evaluated_epoch"], longest.pairs.len()), (&0.into(), 35));
    for (key, found) in [("ate_rmse_m", longest.ate.rmse), ("path_length_m", longest.path_length)] {
        let expected = summary[key].as_f64().unwrap();
        assert!((found - expected).abs() < 1e-9, "{key}: {found}, {expected}");
    }
    // The units of two epochs are unrelated.
    assert!(summary["depth_scale_ratio"].is_null(), "{}", summary["depth_scale_ratio"]);
    // Joined to the first at the end: one map, but still two worlds of odometry.
    record.map.keyframes[1].epoch = 0;
    assert_eq!(parts(&record), [vec![part("", 57)], online]);
    let (summary, _) = written(folder.path(), &record);
    let odometry = &summary["online"];
    assert_eq!(odometry["matched_poses"], 40);
    assert!(odometry["ate_rmse_m"].as_f64().unwrap() < 1e-9, "{odometry}");
    // Frames of the second epoch were placed in a separate map.
    assert_eq!(summary["map_nees"]["nees_frames"], 35);
    assert_eq!(summary["depth_scale_ratio"], 1.0);
}

#[test]
fn frames_with_a_pose_assigned_afterwards_are_not_lost_and_their_epoch_counts() {
    let state = |i| match i {
        40.. => TrackingState::Lost(LostReason::TooFewInliers),
        _ => TrackingState::Tracking,
    };
    let poses = (0..60).map(|i| pose(i, state(i), 0)).collect();
    let mut record = record(poses, vec![keyframe(0), keyframe(1)], false);
    // A second epoch began with the last frames: none was tracked on it when it arrived.
    record.map.keyframes[1].epoch = 1;
    for sequence in 50..60 {
        let keyframe_from_camera = SE3::identity();
        record.map.store_frame_pose(&RealignedFrame {
            sequence,
            keyframe_id: 1,
            keyframe_from_camera,
        });
    }
    let folder = tempfile::tempdir().unwrap();
    let (summary, report) = written(folder.path(), &record);
    let path = folder.path().join("trajectory.txt");
    assert_eq!(poses_by_epoch(&path), [("0".to_owned(), 40), ("1".to_owned(), 10)]);
    for (key, value) in [
        ("frames_tracked", 50),
        ("frames_tracked_later", 10),
        ("frames_lost", 10),
        ("lost_count", 1),
        ("epochs", 2),
    ] {
        assert_eq!(summary[key], value, "{key}");
    }
    let reasons = summary["grade"]["reasons"].to_string();
    assert!(reasons.contains("for 16.7 % of the frames"), "{reasons}");
    assert!(report.contains("for 16.7 % of the frames"));
    // Joined to the first, it is no longer a separate epoch.
    record.map.keyframes[1].epoch = 0;
    assert_eq!(written(folder.path(), &record).0["epochs"], 1);
}

#[test]
fn a_run_without_truth_keyframes_or_a_tracked_frame_is_reported_too() {
    let folder = tempfile::tempdir().unwrap();
    for frames in [0, 1, 5] {
        let poses = (0..frames).map(|i| pose(i, TrackingState::Initializing, u64::MAX)).collect();
        let (summary, _) = written(folder.path(), &record(poses, Vec::new(), false));
        for key in ["ate_rmse_m", "initialization_secs", "depth_relative_error_median"] {
            assert!(summary[key].is_null(), "{key}");
        }
        assert_eq!(summary["frames_tracked"], 0);
    }
}

#[test]
fn given_poses_and_depth_are_not_judged_as_estimates() {
    let poses = |epochs: u32| {
        let mut poses: Vec<_> = (0..60).map(|i| pose(i, TrackingState::Tracking, 0)).collect();
        for pose in &mut poses[30..] {
            // On a separate keyframe, which the map does not contain.
            (pose.estimate.epoch, pose.estimate.keyframe_id) = (epochs - 1, 1);
        }
        poses
    };
    let of = |record: &RunRecord| written(tempfile::tempdir().unwrap().path(), record).0;
    let estimated = record(poses(2), vec![keyframe(0)], true);
    let summary = of(&estimated);
    assert!(summary["depth_relative_error_median"].is_number());
    assert!(summary["grade"]["reasons"].to_string().contains("its own scale"), "{summary}");
    let of_keyframes = summary["keyframe_depth"].as_array().unwrap();
    assert_eq!(of_keyframes.len(), 1);
    assert!(of_keyframes[0]["units_per_metre"].as_f64().unwrap() > 0.0, "{summary}");
    assert!(summary["depth_scale_ratio"].is_null(), "of one keyframe");
    let from_sensor = RunRecord { is_depth_from_sensor: true, ..estimated.clone() };
    assert!(of(&from_sensor)["depth_relative_error_median"].is_null());
    let given = RunRecord { depth_scale: DepthScale::Given, ..estimated };
    let reasons = of(&given)["grade"]["reasons"].to_string();
    assert!(reasons.contains("2 separate parts") && !reasons.contains("scale"), "{reasons}");
}

#[test]
fn a_long_run_makes_a_small_report() {
    let folder = tempfile::tempdir().unwrap();
    let poses = (0..15_000).map(|i| pose(i, TrackingState::Tracking, 0)).collect();
    let (summary, report) = written(folder.path(), &record(poses, vec![keyframe(0)], true));
    assert_eq!(summary["matched_poses"], 15_000);
    assert!((summary["window_scale_ratio"].as_f64().unwrap() - 1.0).abs() < 1e-9);
    assert!(report.len() < 600_000, "{} bytes", report.len());
}

#[test]
fn an_unwritable_path_is_an_error_that_names_it() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let error = prepare_output(&file.join("output")).unwrap_err().to_string();
    assert!(error.contains("file/output") && error.contains("--output"), "{error}");
}
