//! Merges two maps into one folder.

use std::path::Path;
use std::sync::Arc;

use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::numbering::Numbering;
use crate::service::map_folder::reading::Loaded;
use crate::service::map_folder::write_new;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;

/// Writes a map that holds all epochs of `first` and, renumbered, those of `second` into a folder that holds none.
/// Their relative pose stays unknown: the camera is located in either.
pub fn merge(
    folder: &Path,
    [first, second]: [Loaded; 2],
    [first_folder, second_folder]: [&Path; 2],
) -> Result<Map, MapFolderError> {
    let camera = first.manifest.camera;
    if camera != second.manifest.camera {
        return Err(MapFolderError::Cameras {
            first: first_folder.to_owned(),
            second: second_folder.to_owned(),
            cameras: Box::new([camera, second.manifest.camera]),
        });
    }
    let map = joined(first.map, second.map);
    write_new(folder, &camera, first.manifest.detail, &map, map.free_epoch, &mut || ())?;
    Ok(map)
}

/// Joins both maps, with the ids and epochs of the second above those of the first.
fn joined(first: Map, second: Map) -> Map {
    let newest = |number: fn(&Keyframe) -> u64| {
        first.keyframes.iter().map(number).max().map_or(0, |newest| newest.saturating_add(1))
    };
    let ids = newest(|keyframe| keyframe.keyframe_id);
    let epochs = newest(|keyframe| u64::from(keyframe.epoch)).max(u64::from(first.free_epoch));
    let epochs = u32::try_from(epochs).unwrap_or(u32::MAX);
    let moved = Numbering { ids, epochs, revisions: 0 }.in_run(second);
    Map {
        keyframes: first.keyframes.into_iter().chain(moved.keyframes).collect(),
        loops: Arc::new(Arc::unwrap_or_clone(first.loops).with(&moved.loops, 0)),
        revision: first.revision.max(moved.revision),
        free_epoch: moved.free_epoch,
        ..Map::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::loop_bytes::tests::loops;
    use crate::service::map_folder::depth_file::MapDetail;
    use crate::service::map_folder::manifest::Manifest;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::sim3::Sim3;

    #[test]
    fn maps_of_two_cameras_are_refused_by_name() {
        let empty = |fx: f64| {
            let manifest = Manifest::new(Intrinsics::pinhole(64, 48, fx), MapDetail::Full);
            Loaded { manifest, map: Map::default(), without_memory: 0, problems: Vec::new() }
        };
        let folder = tempfile::tempdir().unwrap();
        let merged = folder.path().join("merged");
        let told = merge(&merged, [60.0, 61.0].map(empty), [Path::new("one"), Path::new("other")]);
        assert_eq!(
            told.unwrap_err().to_string(),
            "one and other are maps of different cameras (64x48, fx 60.000, fy 60.000, cx 31.500, cy 23.500 and 64x48, \
             fx 61.000, fy 61.000, cx 31.500, cy 23.500): only maps of one camera and its calibration can be merged"
        );
        assert!(!merged.exists());
    }

    #[test]
    fn merged_maps_share_no_numbers() {
        let camera = Intrinsics::pinhole(64, 48, 60.0);
        let keyframe = |keyframe_id: u64, epoch: u32| Keyframe {
            keyframe_id,
            epoch,
            ..Keyframe::at(Sim3::identity(), camera, Vec::new(), Vec::new())
        };
        let map = |of: &[(u64, u32)], free_epoch: u32| Map {
            keyframes: of.iter().map(|&(id, epoch)| keyframe(id, epoch)).collect(),
            free_epoch,
            ..Map::default()
        };
        let both = joined(map(&[(0, 0), (7, 2)], 5), map(&[(0, 0), (3, 1)], 2));
        let numbers: Vec<(u64, u32)> =
            both.keyframes.iter().map(|of| (of.keyframe_id, of.epoch)).collect();
        assert_eq!(numbers, [(0, 0), (7, 2), (8, 5), (11, 6)]);
        assert_eq!(both.free_epoch, 7);
        let looped = |of: &[(u64, u32)]| Map { loops: Arc::new(loops()), ..map(of, 1) };
        let both = joined(looped(&[(0, 0), (7, 0)]), looped(&[(1, 0)])).loops;
        let pairs: Vec<(u64, u64)> = both.links.iter().map(|link| (link.i, link.j)).collect();
        assert_eq!(pairs, [(7, 3), (8, 3), (15, 11), (16, 11)]);
        assert_eq!(both.held_by[&15], [13, 14]);
        let covariances = &both.relative_covariances;
        assert!(covariances.keys().eq(&[7, 9, 15, 17]) && covariances[&17] == covariances[&9]);
        assert_eq!((both.beginnings.contains(&12), both.searched_to), (true, Some(16)));
    }
}
