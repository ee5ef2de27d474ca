//! The map's points as files: one surface from all keyframes, and further files on request.

use crate::records::{keyframe, pose, record, write_results, written};
use semidense::service::results::ResultsParams;
use semidense::service::results::output_folder::prepare_output;
use semidense::service::results::ply::read_surface;
use semidense::slam::fusion::MapResolution;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::pose::TrackingState;

#[test]
fn a_wall_seen_by_two_keyframes_is_written_once_and_every_point_on_request() {
    // Offset sideways by one pixel, in front of a wall at 4 keyframe units, which are 2 map units.
    let pixels = (0..24u16).flat_map(|v| (0..32u16).map(move |u| (u, v)));
    let points: Vec<DepthPoint> = pixels
        .map(|(u, v)| DepthPoint { u, v, inverse_depth: 0.25, variance: 1e-6, intensity: 100.0 })
        .collect();
    let wall = |id: u64, points: Vec<DepthPoint>| {
        let mut wall = Keyframe { points, ..keyframe(id) };
        wall.map_from_keyframe.rigid.translation.x = 2.0 / 30.0 * id as f64;
        wall
    };
    let poses = (0..60).map(|i| pose(i, TrackingState::Tracking, u64::from(i >= 40))).collect();
    let mut other = wall(2, points.clone());
    other.epoch = 1;
    let keyframes = vec![wall(0, points.clone()), wall(1, points.clone()), other];
    let record = record(poses, keyframes, false);
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let (summary, _) = written(&first, &record);
    assert_eq!(summary["points"], 3 * 768);
    assert!(!first.join("map.pcd").exists() && !first.join("points-full.ply").exists());
    let surface = read_surface(&first.join("map.ply"), usize::MAX).unwrap();
    assert_eq!(summary["map_points"], surface.len());
    // Each has one column that the other lacks; at 0.5 % of the distance each pixel has its own cell.
    assert!((700..=792).contains(&surface.len()), "{}", surface.len());
    let two = surface.iter().filter(|point| point.keyframes == 2).count();
    assert!(two * 10 > surface.len() * 9, "{two} of {}", surface.len());
    for point in &surface {
        assert!((point.position[2] - 2.0).abs() < 1e-5 && point.grey == 100, "{point:?}");
        assert_eq!(point.normal, [0.0, 0.0, -1.0], "towards the camera");
        // σ/d is 0.004, at 2 map units and more.
        assert!((0.0079..0.0105).contains(&point.sigma), "{point:?}");
    }
    prepare_output(&second).unwrap();
    let resolution = MapResolution::Length(0.4);
    let params = ResultsParams {
        map_resolution: resolution,
        pcd: true,
        full_points: true,
        ..ResultsParams::default()
    };
    write_results(&second, &record, &params);
    let coarse = read_surface(&second.join("map.ply"), usize::MAX).unwrap();
    // 32 of 30 by 24 of 30 of 2 map units: six by five cells.
    assert!((12..=42).contains(&coarse.len()), "{}", coarse.len());
    let pcd = std::fs::read(second.join("map.pcd")).unwrap();
    let data = pcd.windows(12).position(|w| w == b"DATA binary\n").unwrap() + 12;
    let header = std::str::from_utf8(&pcd[..data]).unwrap();
    assert!(header.contains(&format!("\nPOINTS {}\n", coarse.len())), "{header}");
    assert_eq!(pcd.len() - data, coarse.len() * 33);
    let full = std::fs::read(second.join("points-full.ply")).unwrap();
    let begin = full.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert_eq!(full.len() - begin, 3 * 768 * 24, "every point of every keyframe, of both epochs");
    let z = f32::from_le_bytes(full[begin + 8..begin + 12].try_into().unwrap());
    assert!((z - 2.0).abs() < 1e-6, "4 keyframe units are 2 map units");
    // The next result set has neither file.
    write_results(&second, &record, &ResultsParams::default());
    assert!(!second.join("map.pcd").exists() && !second.join("points-full.ply").exists());
}
