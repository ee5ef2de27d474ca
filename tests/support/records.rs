//! Handmade records of runs, and a source whose depth is a wall.

use semidense::capture::source::{FrameSource, FrameStamp};
use semidense::capture::source_error::SourceError;
use semidense::service::alignment_stamps::{AlignmentTrace, LevelTrace};
use semidense::service::results::output_folder::prepare_output;
use semidense::service::results::record::{
    EndOfRun, RecordedPose, RunCounters, RunMode, RunRecord,
};
use semidense::service::results::{Results, ResultsParams};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::buffer::Image;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::map::Map;
use semidense::slam::pose::{PoseEstimate, TrackingState};
use semidense::slam::trajectory::StampedPose;
use serde_json::Value;
use std::path::Path;

pub const INTRINSICS: Intrinsics = Intrinsics::pinhole(32, 24, 30.0);

/// A source used only for its depth: 4 m at every pixel of every frame.
pub struct Wall;

impl FrameSource for Wall {
    fn intrinsics(&self) -> Intrinsics {
        INTRINSICS
    }

    fn num_frames(&self) -> Option<usize> {
        None
    }

    fn next_into(&mut self, _pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        Ok(None)
    }

    fn depth_at(&mut self, _capture_nanos: i64) -> Result<Option<Image<f32>>, SourceError> {
        Ok(Some(Image::filled(INTRINSICS.width, INTRINSICS.height, 4.0)))
    }
}

pub fn nanos(i: usize) -> i64 {
    1_305_033_527_000_000_001 + i as i64 * 33_333_333
}

/// True pose of the camera for frame i, metres.
pub fn truth(i: usize) -> SE3 {
    let t = i as f64 / 30.0;
    SE3 { translation: [t.sin(), 0.1 * (3.0 * t).cos(), 0.5 * t].into(), ..SE3::identity() }
}

/// A map unit is 2 m; keyframe 1 moved by (1, 0, 0) units after its frames were published.
pub const UNIT_M: f64 = 2.0;

pub fn world_from_keyframe(id: u64) -> Sim3 {
    let shift = if id == 1 { 1.0 } else { 0.0 };
    let rigid = SE3 { translation: [shift, 0.0, 0.0].into(), ..SE3::identity() };
    Sim3::new(rigid, 0.5)
}

pub fn pose(i: usize, state: TrackingState, keyframe_id: u64) -> RecordedPose {
    let mut world_from_camera = truth(i);
    world_from_camera.translation /= UNIT_M;
    let estimate = PoseEstimate {
        keyframe_id,
        state,
        world_from_camera,
        map_from_camera: world_from_camera,
        keyframe_from_camera: world_from_keyframe(0).inverse_transform_pose(&world_from_camera),
        ..PoseEstimate::unknown_at(i as u64, nanos(i))
    };
    RecordedPose {
        estimate,
        latency_nanos: None,
        track_nanos: Some(1_000_000 * (i as u64 % 7 + 1)),
        trace: (state != TrackingState::Initializing).then(|| trace(i)),
        wake_nanos: Some(40_000),
    }
}

/// Level 1 with 1000 points, 2 or 5 iterations of 3 µs.
pub fn trace(i: usize) -> AlignmentTrace {
    let iterations = if i.is_multiple_of(3) { 5 } else { 2 };
    let mut trace = AlignmentTrace { pyramid_nanos: 50_000, ..AlignmentTrace::default() };
    trace.levels[1] = LevelTrace {
        points: 1000,
        iterations,
        timed_evaluations: iterations,
        timed_nanos: 3_000 * u64::from(iterations),
    };
    trace
}

pub fn keyframe(keyframe_id: u64) -> Keyframe {
    // A keyframe unit is half a map unit: 4 m are 4 keyframe units. One point is too uncertain.
    let points = (0..20u16).map(|i| DepthPoint {
        u: i,
        v: 3,
        inverse_depth: 0.25,
        variance: if i == 0 { 0.01 } else { 1e-5 },
        intensity: 100.0,
    });
    Keyframe {
        keyframe_id,
        revision: 1,
        sequence: keyframe_id * 10,
        capture_nanos: nanos(keyframe_id as usize * 10),
        ..Keyframe::at(
            world_from_keyframe(keyframe_id),
            INTRINSICS,
            points.collect(),
            vec![90; 32 * 24],
        )
    }
}

pub fn record(poses: Vec<RecordedPose>, keyframes: Vec<Keyframe>, with_truth: bool) -> RunRecord {
    let frames = poses.len();
    let pose = |i| StampedPose { nanos: nanos(i), world_from_camera: truth(i) };
    RunRecord {
        ended: EndOfRun::Interrupted,
        poses,
        map: Map { keyframes, ..Map::default() },
        ground_truth: if with_truth { (0..frames).map(pose).collect() } else { Vec::new() },
        counters: RunCounters { frames_in: frames as u64, ..RunCounters::default() },
        map_nanos: vec![2_000_000; frames],
        keyframe_step_nanos: vec![5_000_000; 3],
        keyframe_nanos: vec![3_000_000; 3],
        recorded_nanos: 2_000_000_000,
        wall_nanos: 1_000_000_000,
        ..RunRecord::empty(RunMode::Lockstep, "tum:a<script>\"b\"")
    }
}

/// Evaluates a run and writes its files into `dir`.
pub fn write_results(dir: &Path, record: &RunRecord, params: &ResultsParams) {
    let results = Results::new(record, &mut Wall, params, &mut |_, _| ()).unwrap();
    results.write(dir, &|_| Ok(())).unwrap();
}

pub fn written(dir: &Path, record: &RunRecord) -> (Value, String) {
    prepare_output(dir).unwrap();
    write_results(dir, record, &ResultsParams::default());
    let read = |name: &str| std::fs::read_to_string(dir.join(name)).unwrap();
    let report = read("report.html");
    assert!(report.ends_with("</html>\n"));
    assert_eq!(report.matches("<svg").count(), report.matches("</svg>").count());
    assert!(report.contains("a&lt;script&gt;") && !report.contains("a<script>"), "it is escaped");
    for address in ["src=\"http", "href=\"http", "url(http", "@import", "fetch(\"http"] {
        assert!(!report.contains(address), "no network is needed");
    }
    let drawn = report.split("<script").next().unwrap_or_default();
    assert!(!drawn.contains("NaN"));
    (serde_json::from_str(&read("summary.json")).unwrap(), report)
}
