//! A map on disk is read back unchanged, and damage costs only the damaged part.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use super::*;
use crate::service::config::MapConfig;
use crate::service::map_folder::reading::{BEFORE, KEYFRAMES, MANIFEST, load};
use crate::service::map_folder::session::first_own_id;
use crate::service::map_folder::writer::{MapWriter, head_of};
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::prior::MapUse;
use crate::slam::places::Description;
use crate::slam::test_scene::Scene;

const CAMERA: Intrinsics =
    Intrinsics { fx: 60.0, fy: 61.0, cx: 32.0, cy: 24.0, width: 65, height: 48 };
const ALL: usize = usize::MAX;

fn keyframe(keyframe_id: u64, revision: u64) -> Keyframe {
    let place = SE3 { translation: [keyframe_id as f64, 0.5, -1.0].into(), ..SE3::identity() };
    let grey = |i: usize| ((i * 7) as u64 + keyframe_id + revision) as u8;
    let image: Vec<u8> = (0..CAMERA.width * CAMERA.height).map(grey).collect();
    let points = (10..40).map(|u| DepthPoint {
        u,
        v: 20,
        inverse_depth: 0.5 + f32::from(u) / 64.0 + revision as f32,
        variance: 0.01,
        intensity: f32::from(image[20 * CAMERA.width + usize::from(u)]),
    });
    let points = points.collect();
    Keyframe {
        keyframe_id,
        revision,
        epoch: 2,
        ..Keyframe::at(Sim3::new(place, 1.5), CAMERA, points, image)
    }
}

fn head(keyframes: &[Keyframe]) -> Map {
    head_of(&Map { keyframes: keyframes.to_vec(), revision: 6, ..Map::default() }, 4)
}

/// Saves keyframes, all with their depth.
fn save(writer: &mut MapWriter, keyframes: &[Keyframe]) {
    keyframes.iter().for_each(|keyframe| writer.put(keyframe).unwrap());
    writer.save(&CAMERA, head(keyframes)).unwrap();
}

fn open(folder: &Path) -> MapWriter {
    MapWriter::open(folder, MapDetail::Full).unwrap()
}

/// Paths and contents of all files in a folder.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(contents(&entry.path())),
            false => found.push((entry.path(), fs::read(entry.path()).unwrap())),
        }
    }
    found.sort();
    found
}

fn num_files(folder: &Path) -> usize {
    fs::read_dir(folder.join(KEYFRAMES)).unwrap().count()
}

#[test]
fn a_map_is_read_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let keyframes: Vec<Keyframe> = (0..5).map(|id| keyframe(id * 3, 1)).collect();
    save(&mut open(folder.path()), &keyframes);
    let before = contents(folder.path());
    let loaded = load(folder.path(), ALL).unwrap();
    assert!(loaded.map.keyframes == keyframes);
    assert_eq!((loaded.map.revision, loaded.map.free_epoch), (6, 4));
    assert_eq!((loaded.problems.len(), loaded.without_memory), (0, 0));
    assert_eq!(contents(folder.path()), before, "reading changes nothing");
}

#[test]
fn ids_of_a_run_are_above_those_of_earlier_runs() {
    let folder = tempfile::tempdir().unwrap();
    let config = |path: &Path| MapConfig {
        folder: path.to_str().unwrap().to_owned(),
        ..MapConfig::default()
    };
    let here = config(folder.path());
    assert_eq!((first_own_id(&MapConfig::default()), first_own_id(&here)), (0, 0));
    let keyframes: Vec<Keyframe> = (0..5).map(|id| keyframe(id * 3, 1)).collect();
    save(&mut open(folder.path()), &keyframes);
    assert_eq!(first_own_id(&here), 13);
    // What the results take for the first is the first that the mapper makes.
    let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
    let loaded = load(folder.path(), ALL).unwrap().map;
    mapper.start_in_map(loaded, MapUse::Extend).unwrap();
    assert_eq!(mapper.free_keyframe_id(), 13);
}

#[test]
fn a_file_in_place_of_the_folder_is_reported_as_such() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("afile");
    fs::write(&file, "x").unwrap();
    let expected = format!("{} is a file; name a folder", file.display());
    assert_eq!(load(&file, ALL).unwrap_err().to_string(), expected);
    assert_eq!(MapWriter::open(&file, MapDetail::Full).unwrap_err().to_string(), expected);
}

#[test]
fn a_save_writes_changes_and_removes_unlisted_files() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = open(folder.path());
    let mut keyframes: Vec<Keyframe> = (0..4).map(|id| keyframe(id, 1)).collect();
    save(&mut writer, &keyframes);
    let first = contents(folder.path());
    keyframes[2] = keyframe(2, 2);
    save(&mut writer, &keyframes);
    let second = contents(folder.path());
    let is_new = |of: &&(PathBuf, Vec<u8>)| !first.contains(of);
    let new: Vec<_> = second.iter().filter(is_new).map(|(path, _)| path).collect();
    let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
    let names: Vec<String> = new.into_iter().map(name).collect();
    assert_eq!(names, ["2.2", "manifest", "manifest.before"]);
    assert_eq!(num_files(folder.path()), 5, "the manifest before has a file of its own");
    save(&mut writer, &keyframes);
    assert_eq!(num_files(folder.path()), 4);
    assert!(load(folder.path(), ALL).unwrap().map.keyframes == keyframes);
    // A rejected keyframe is left out, one without depth keeps its file.
    keyframes[0].map_state = MapState::Rejected;
    writer.save(&CAMERA, head(&keyframes)).unwrap();
    assert!(load(folder.path(), ALL).unwrap().map.keyframes == keyframes[1..]);
}

#[test]
fn the_next_process_continues_with_the_same_files() {
    let folder = tempfile::tempdir().unwrap();
    let keyframes: Vec<Keyframe> = (0..3).map(|id| keyframe(id, 1)).collect();
    save(&mut open(folder.path()), &keyframes);
    fs::write(folder.path().join("keyframes/.9.9.17.tmp"), "half").unwrap();
    fs::write(folder.path().join("keyframes/9.9"), "never listed").unwrap();
    let mut writer = MapWriter::open(folder.path(), MapDetail::Small).unwrap();
    assert_eq!(writer.camera(), Some(&CAMERA));
    let more = keyframe(3, 4);
    writer.put(&more).unwrap();
    let all: Vec<Keyframe> = keyframes.into_iter().chain([more]).collect();
    writer.save(&CAMERA, head(&all)).unwrap();
    assert!(load(folder.path(), ALL).unwrap().map.keyframes == all, "and in the same detail");
    assert_eq!(num_files(folder.path()), 4);
}

#[test]
fn a_damaged_keyframe_costs_its_depth_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let keyframes: Vec<Keyframe> = (0..4).map(|id| keyframe(id, 1)).collect();
    save(&mut open(folder.path()), &keyframes);
    let path = |name: &str| folder.path().join(KEYFRAMES).join(name);
    let mut flipped = fs::read(path("0.1")).unwrap();
    flipped[700] ^= 4;
    fs::write(path("0.1"), flipped).unwrap();
    fs::remove_file(path("1.1")).unwrap();
    fs::copy(path("2.1"), path("3.1")).unwrap();
    let loaded = load(folder.path(), ALL).unwrap();
    let has_depth: Vec<bool> = loaded.map.keyframes.iter().map(Keyframe::has_depth).collect();
    assert_eq!(has_depth, [false, false, true, false]);
    assert!(loaded.map.keyframes[2] == keyframes[2]);
    assert_eq!(loaded.map.keyframes[3], keyframes[3].without_depth());
    assert_eq!(loaded.problems.len(), 3);
    for (problem, name) in loaded.problems.iter().zip(["0.1", "1.1", "3.1"]) {
        assert!(problem.contains(name) && problem.lines().count() == 1, "{problem}");
    }
    // All of it, cut at many lengths.
    let whole = fs::read(path("2.1")).unwrap();
    for length in (0..whole.len()).step_by(97) {
        fs::write(path("2.1"), &whole[..length]).unwrap();
        assert_eq!(load(folder.path(), ALL).unwrap().problems.len(), 4);
    }
}

#[test]
fn a_damaged_description_is_recomputed_and_costs_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::new(3);
    let mut kept = scene.keyframe(0, SE3::identity(), 1.0);
    let camera = kept.intrinsics;
    let mut other = Mapper::new(camera, MapperParams::default()).unwrap();
    let begun = Map { keyframes: vec![kept.clone()], ..Map::default() };
    other.start_in_map(begun, MapUse::Extend).unwrap();
    let made = other.map().keyframes[0].description.clone();
    kept.description = made.clone();
    let mut writer = open(folder.path());
    writer.put(&kept).unwrap();
    writer.save(&camera, head(std::slice::from_ref(&kept))).unwrap();
    let whole = load(folder.path(), ALL).unwrap().map;
    let features = |of: &Option<Arc<Description>>| of.as_ref().unwrap().features().to_vec();
    assert_eq!(features(&whole.keyframes[0].description), features(&made));
    let path = contents(&folder.path().join(KEYFRAMES))[0].0.clone();
    let mut bytes = fs::read(&path).unwrap();
    bytes[1000] ^= 4;
    fs::write(&path, &bytes).unwrap();
    let loaded = load(folder.path(), ALL).unwrap();
    assert!(loaded.problems.is_empty() && loaded.map.keyframes[0].description.is_none());
    assert!(loaded.map.keyframes[0].points == kept.points);
    let mut mapper = Mapper::new(camera, MapperParams::default()).unwrap();
    mapper.start_in_map(loaded.map, MapUse::Extend).unwrap();
    assert_eq!(mapper.map().keyframes[0].description, made);
}

#[test]
fn a_damaged_manifest_costs_the_last_save() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = open(folder.path());
    save(&mut writer, &[keyframe(0, 1)]);
    let first = [keyframe(0, 2), keyframe(1, 2)];
    save(&mut writer, &first);
    save(&mut writer, &[keyframe(0, 3), keyframe(1, 3), keyframe(2, 3)]);
    drop(writer);
    let path = folder.path().join(MANIFEST);
    let mut bytes = fs::read(&path).unwrap();
    bytes[99] ^= 1;
    fs::write(&path, &bytes).unwrap();
    let loaded = load(folder.path(), ALL).unwrap();
    assert!(loaded.map.keyframes == first);
    assert!(loaded.problems[0].contains("damaged"), "{:?}", loaded.problems);
    // As left by a process killed between the two.
    fs::remove_file(&path).unwrap();
    assert!(load(folder.path(), ALL).unwrap().map.keyframes == first);
    // A map that cannot be read is not overwritten.
    fs::write(folder.path().join(BEFORE), "semidense").unwrap();
    fs::write(&path, &bytes).unwrap();
    assert!(load(folder.path(), ALL).is_err());
    assert!(MapWriter::open(folder.path(), MapDetail::Full).is_err());
}

#[test]
fn memory_goes_to_the_newest_keyframes() {
    let folder = tempfile::tempdir().unwrap();
    let keyframes: Vec<Keyframe> = (0..4).map(|id| keyframe(id, 1)).collect();
    save(&mut open(folder.path()), &keyframes);
    let of_one = CAMERA.width * CAMERA.height + 30 * size_of::<DepthPoint>();
    let loaded = load(folder.path(), 2 * of_one).unwrap();
    let has_depth: Vec<bool> = loaded.map.keyframes.iter().map(Keyframe::has_depth).collect();
    assert_eq!((has_depth, loaded.without_memory), (vec![false, false, true, true], 2));
    assert!(loaded.problems.is_empty());
}

#[test]
fn a_missing_or_invalid_map_gives_a_one_line_error() {
    let folder = tempfile::tempdir().unwrap();
    let missing = load(folder.path(), ALL).unwrap_err().to_string();
    assert!(missing.contains("holds no map"), "{missing}");
    let mut writer = open(folder.path());
    let held = MapWriter::open(folder.path(), MapDetail::Full).unwrap_err().to_string();
    assert!(held.contains("another process"), "{held}");
    save(&mut writer, &[keyframe(0, 1)]);
    drop(writer);
    let path = folder.path().join(MANIFEST);
    let mut newer = fs::read(&path).unwrap();
    newer[16] = 9;
    fs::write(&path, &newer).unwrap();
    fs::copy(&path, folder.path().join(BEFORE)).unwrap();
    let version = load(folder.path(), ALL).unwrap_err().to_string();
    assert!(version.contains("version 9") && version.lines().count() == 1, "{version}");
    let foreign = tempfile::tempdir().unwrap();
    fs::write(foreign.path().join("thesis.tex"), "x").unwrap();
    let refused = MapWriter::open(foreign.path(), MapDetail::Full).unwrap_err().to_string();
    assert!(refused.contains("not empty"), "{refused}");
}
