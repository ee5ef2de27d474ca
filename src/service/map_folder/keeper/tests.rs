//! A disk that refuses for a while.

use std::collections::BTreeSet;
use std::fs;

use super::*;
use crate::service::adjustments::tests::{KEYFRAME_INTERVAL, Walk};
use crate::service::map_folder::depth_file::MapDetail;
use crate::service::map_folder::reading::load;
use crate::slam::test_scene::CAMERA;

#[test]
fn keyframes_that_the_disk_refused_are_written_once_it_accepts_them() {
    let folder = tempfile::tempdir().unwrap();
    let (keyframes, away) = (folder.path().join("keyframes"), folder.path().join("away"));
    let writer = MapWriter::open(folder.path(), MapDetail::Full).unwrap();
    let mut saver =
        MapSaver::start(writer, CAMERA, &Map::default(), Numbering::default(), true).unwrap();
    let mut walk = Walk::new();
    let mut failures = 0;
    for frame in 0..7 * KEYFRAME_INTERVAL {
        if frame == 2 * KEYFRAME_INTERVAL {
            fs::rename(&keyframes, &away).unwrap();
        }
        if frame == 4 * KEYFRAME_INTERVAL {
            fs::rename(&away, &keyframes).unwrap();
        }
        // Without estimates, which would change the keyframes and have them written for that.
        let outcome = walk.step();
        saver.follow(&walk.mapper, &outcome);
        failures += usize::from(saver.take_failure().is_some());
    }
    assert!(failures > 1, "{failures}");
    // As at a kill: nothing is written at the end.
    drop(saver);
    let written = load(folder.path(), usize::MAX).unwrap().map.keyframes;
    let written: BTreeSet<u64> = written.iter().map(|keyframe| keyframe.keyframe_id).collect();
    let active = walk.mapper.keyframe().unwrap().keyframe_id;
    assert_eq!(written, (0..active).collect(), "all but the active one");
}
