//! A written dataset is read back unchanged.

use super::*;
use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::SimulatorParams;
use crate::capture::source::FrameSource;
use crate::capture::tum;

fn simulator(distortion: Vec<f64>) -> Simulator {
    let mut params = SimulatorParams {
        frames: 3,
        width: 160,
        height: 120,
        focal_px: 131.0,
        ..Default::default()
    };
    params.sensor.distortion = distortion;
    Simulator::new(params).unwrap()
}

fn write(
    simulator: &Simulator,
    target: &Path,
    layout: DatasetLayout,
    replace: bool,
) -> Result<(), DatasetError> {
    let rate_hz = simulator.params().rate_hz;
    let writer = DatasetWriter::create(target, layout, *simulator.camera(), rate_hz, replace)?;
    for frame in 0..simulator.params().frames {
        let pixels = simulator.raw_frame(frame).unwrap();
        let depth = simulator.raw_depth(frame).unwrap();
        writer.write_frame(simulator.nanos(frame), &pixels, &depth)?;
    }
    writer.finish(simulator.ground_truth())
}

#[test]
fn the_tum_reader_reproduces_the_simulated_sequence() {
    for distortion in [vec![], vec![-0.28, 0.07, 0.0002, 0.00002]] {
        let mut simulator = simulator(distortion);
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("sequence");
        write(&simulator, &target, DatasetLayout::Tum, false).unwrap();
        let mut recording = tum::open(&target, None).unwrap();
        assert_eq!(recording.intrinsics(), simulator.intrinsics());
        assert_eq!(recording.ground_truth().len(), 3);
        for (read, exact) in recording.ground_truth().iter().zip(simulator.ground_truth()) {
            assert_eq!(read.nanos, exact.nanos);
            assert_eq!(read.world_from_camera.translation, exact.world_from_camera.translation);
            assert!(
                read.world_from_camera.rotation.angle_to(&exact.world_from_camera.rotation) < 1e-7
            );
        }
        let size = 160 * 120;
        let (mut read, mut exact) = (vec![0; size], vec![0; size]);
        while let Some(stamp) = simulator.next_into(&mut exact).unwrap() {
            let read_stamp = recording.next_into(&mut read).unwrap().unwrap();
            assert_eq!(read_stamp.capture_nanos, stamp.capture_nanos);
            assert_eq!(read, exact);
            let nanos = stamp.capture_nanos;
            let read = recording.depth_at(nanos).unwrap().unwrap();
            let exact = simulator.depth_at(nanos).unwrap().unwrap();
            // Half a step of the 16-bit image; across edges the nearest raw pixel may see another surface.
            let near = |(a, b): (&f32, &f32)| (a - b).abs() < 0.02 * b;
            let agreeing = read.pixels().iter().zip(exact.pixels()).filter(|&p| near(p)).count();
            assert!(agreeing as f64 > 0.93 * size as f64, "{agreeing} of {size}");
        }
        assert!(recording.next_into(&mut read).unwrap().is_none());
    }
}

#[test]
fn a_euroc_dataset_has_body_poses_that_lead_back_to_the_camera() {
    let simulator = simulator(vec![]);
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("sequence");
    write(&simulator, &target, DatasetLayout::Euroc, false).unwrap();
    let text =
        fs::read_to_string(target.join("mav0/state_groundtruth_estimate0/data.csv")).unwrap();
    let rows: Vec<&str> = text.lines().skip(1).collect();
    assert_eq!(rows.len(), 3);
    for (row, pose) in rows.iter().zip(simulator.ground_truth()) {
        let columns: Vec<f64> = row.split(',').map(|c| c.parse().unwrap()).collect();
        assert_eq!(columns.len(), 17);
        assert_eq!(row.split(',').next().unwrap().parse::<i64>().unwrap(), pose.nanos);
        let body = SE3::try_from_parts(
            [columns[5], columns[6], columns[7], columns[4]],
            [columns[1], columns[2], columns[3]],
        );
        let camera = body.unwrap() * body_from_camera();
        assert!((camera.inverse() * pose.world_from_camera).log().norm() < 1e-9);
        let image = format!("mav0/cam0/data/{}.png", pose.nanos);
        assert!(target.join(image).is_file());
        assert!(target.join(format!("mav0/depth0/data/{}.png", pose.nanos)).is_file());
    }
    let yaml = fs::read_to_string(target.join("mav0/cam0/sensor.yaml")).unwrap();
    assert!(yaml.contains("intrinsics: [131, 131, 79.5, 59.5]"), "{yaml}");
}

#[test]
fn only_a_dataset_is_replaced_and_only_on_request() {
    let simulator = simulator(vec![]);
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("sequence");
    fs::create_dir(&target).unwrap();
    write(&simulator, &target, DatasetLayout::Tum, false).unwrap();
    let again = write(&simulator, &target, DatasetLayout::Tum, false);
    assert!(matches!(again, Err(DatasetError::NotEmpty { .. })));
    write(&simulator, &target, DatasetLayout::Euroc, true).unwrap();
    assert!(target.join("mav0").exists() && !target.join("rgb.txt").exists());
    let other = folder.path().join("letters");
    fs::create_dir(&other).unwrap();
    fs::write(other.join("letter"), "dear").unwrap();
    let refused = write(&simulator, &other, DatasetLayout::Tum, true);
    assert!(matches!(refused, Err(DatasetError::NotADataset { .. })));
    // No half-written folder remains.
    let names: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 2, "{names:?}");
}

#[test]
fn a_dropped_dataset_leaves_nothing() {
    let simulator = simulator(vec![]);
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("sequence");
    let writer =
        DatasetWriter::create(&target, DatasetLayout::Tum, *simulator.camera(), 30.0, false)
            .unwrap();
    drop(writer);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn stamps_and_depths_keep_their_digits() {
    assert_eq!(seconds(1_033_333_333), "1.033333333");
    assert_eq!(seconds(-5), "-0.000000005");
    assert_eq!([1.0, 13.1, 13.2, 0.0, f32::NAN].map(depth_steps), [5000, 65500, 0, 0, 0]);
}

#[test]
fn a_link_to_a_folder_is_kept_and_its_dataset_replaced() {
    let simulator = simulator(vec![]);
    let folder = tempfile::tempdir().unwrap();
    let (real, link) = (folder.path().join("real"), folder.path().join("link"));
    fs::create_dir(&real).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    for replace in [false, true] {
        write(&simulator, &link, DatasetLayout::Tum, replace).unwrap();
        assert!(link.is_symlink() && is_dataset(&real), "{replace}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
    // As `.` is resolved where it is the current folder.
    let here = folder.path().join("here");
    fs::create_dir(&here).unwrap();
    write(&simulator, &here.join("."), DatasetLayout::Tum, false).unwrap();
    assert!(is_dataset(&here));
}
