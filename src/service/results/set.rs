//! The files of a run as one set: written aside, then put in the place of the previous set, all or none.
//!
//! A set is written into a separate folder inside the output folder, synchronised, and renamed to a name that marks it
//! as complete. From then on its files only have to be moved up: a process that finds a complete set (see
//! [`finish_commit`]) continues with that, so that two sets are never mixed. Only files that a run writes are ever
//! replaced or removed.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use rustix::fs::FlockOperation;

use crate::service::results::{full_points, pcd};

/// Files of every set, with their beginnings: a file of that name that begins otherwise is the user's.
const FILES: [(&str, &str); 7] = [
    ("summary.json", "{\n  \"mode\": \""),
    ("trajectory.txt", "# map_from_camera of every tracked frame"),
    ("trajectory_online.txt", "# world_from_camera of every tracked frame"),
    ("keyframes.txt", "# map_from_keyframe; lengths in the keyframe"),
    ("map.ply", "ply\nformat binary_little_endian 1.0\ncomment x y z in map units"),
    ("points.ply", "ply\nformat binary_little_endian 1.0\ncomment points of the joint estimation"),
    ("report.html", "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">"),
];
/// Files of sets on request, likewise.
const ON_REQUEST: [(&str, &str); 2] =
    [("map.pcd", pcd::BEGINNING), ("points-full.ply", full_points::BEGINNING)];
/// Beginnings of the files of earlier versions and of `map export`, which count as ours too.
const EARLIER: [(&str, &str); 3] = [
    ("trajectory.txt", "# world_from_camera of every tracked frame"),
    ("keyframes.txt", "# world_from_keyframe; lengths in the keyframe"),
    ("keyframes.txt", "# map_from_keyframe of every keyframe"),
];
/// The file that is moved up first: while it is still aside, the files of the previous set are in place.
const FIRST: &str = FILES[0].0;
/// Folder of pictures for work on the algorithms, in sets that have them.
pub const DEBUG_FOLDER: &str = "debug";

/// Name of a set that is being written, followed by the process id.
const PARTIAL: &str = ".semidense-results.partial-";
/// Name of a set that is complete and not yet moved up.
const COMPLETE: &str = ".semidense-results.complete";

/// A set that is being written. Removed when dropped without a commit, and the previous set stays.
#[derive(Debug)]
pub struct ResultSet {
    output: PathBuf,
    folder: PathBuf,
    /// Held while the set is written: a folder that no process holds was left by one that died.
    _lock: File,
}

impl ResultSet {
    /// Begins a set inside the folder `output`, and removes what killed processes left half written there.
    pub fn begin(output: &Path) -> io::Result<Self> {
        // No other process clears up between the creation of the folder and its lock.
        let _alone = lock(output)?;
        remove_abandoned(output)?;
        let folder = output.join(format!("{PARTIAL}{}", std::process::id()));
        fs::create_dir(&folder)?;
        let lock = File::open(&folder)?;
        rustix::fs::flock(&lock, FlockOperation::LockExclusive)?;
        Ok(Self { output: output.to_owned(), folder, _lock: lock })
    }

    /// The folder for its files.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Puts the set in the place of the previous one.
    pub fn commit(self) -> io::Result<()> {
        synchronise(&self.folder)?;
        let output = lock(&self.output)?;
        move_up(&self.output)?;
        fs::rename(&self.folder, self.output.join(COMPLETE))?;
        output.sync_all()?;
        move_up(&self.output)
    }
}

impl Drop for ResultSet {
    fn drop(&mut self) {
        // What cannot be removed is left to the next set. After a commit there is nothing to remove.
        drop(fs::remove_dir_all(&self.folder));
    }
}

/// Moves up a complete set that a killed process left in `output`; returns whether there was one.
pub fn finish_commit(output: &Path) -> io::Result<bool> {
    if !output.join(COMPLETE).exists() {
        return Ok(false);
    }
    let _lock = lock(output)?;
    move_up(output)?;
    Ok(true)
}

/// The first file in `output` that a set would replace and that no run wrote.
pub fn foreign_file(output: &Path) -> io::Result<Option<PathBuf>> {
    for (name, beginning) in FILES.into_iter().chain(ON_REQUEST) {
        let path = output.join(name);
        if fs::symlink_metadata(&path).is_ok()
            && !begins_with(&path, beginning)?
            && !begins_as_earlier(&path, name)?
        {
            return Ok(Some(path));
        }
    }
    Ok(None)
}

/// A file of the user in `output` in the place of the folder of pictures.
pub fn foreign_debug(output: &Path) -> Option<PathBuf> {
    let debug = output.join(DEBUG_FOLDER);
    (fs::symlink_metadata(&debug).is_ok() && !debug.is_dir()).then_some(debug)
}

/// Whether `output` holds a set.
pub fn has_set(output: &Path) -> bool {
    let (name, beginning) = FILES[0];
    begins_with(&output.join(name), beginning).unwrap_or(false)
}

/// Whether `output` holds a set of a run with tracked frames.
pub fn has_tracked_set(output: &Path) -> bool {
    let tracked = || {
        let text = fs::read_to_string(output.join(FILES[0].0)).ok()?;
        let summary: serde_json::Value = serde_json::from_str(&text).ok()?;
        summary["frames_tracked"].as_u64()
    };
    has_set(output) && tracked().is_some_and(|frames| frames > 0)
}

/// Whether `output` holds a set that was written after `time`.
pub fn has_set_since(output: &Path, time: SystemTime) -> bool {
    let written = fs::metadata(output.join(FILES[0].0)).and_then(|found| found.modified());
    has_set(output) && written.is_ok_and(|written| written > time)
}

fn begins_as_earlier(path: &Path, name: &str) -> io::Result<bool> {
    for (_, beginning) in EARLIER.iter().filter(|(of, _)| *of == name) {
        if begins_with(path, beginning)? {
            return Ok(true);
        }
    }
    Ok(false)
}

fn begins_with(path: &Path, beginning: &str) -> io::Result<bool> {
    // A pipe would never end, a folder cannot be read.
    if !fs::metadata(path)?.is_file() {
        return Ok(false);
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(beginning.len() as u64).read_to_end(&mut bytes)?;
    Ok(bytes == beginning.as_bytes())
}

/// Keeps other processes from moving a set up in the same folder, until it is dropped.
fn lock(output: &Path) -> io::Result<File> {
    let folder = File::open(output)?;
    rustix::fs::flock(&folder, FlockOperation::LockExclusive)?;
    Ok(folder)
}

/// Moves the files of a complete set up, if there is one. Can be interrupted anywhere and repeated.
fn move_up(output: &Path) -> io::Result<()> {
    let complete = output.join(COMPLETE);
    if !complete.exists() {
        return Ok(());
    }
    if complete.join(FIRST).exists() {
        remove_debug_pictures(output)?;
        remove_on_request(output)?;
        fs::rename(complete.join(FIRST), output.join(FIRST))?;
    }
    move_files(&complete, output)?;
    let debug = complete.join(DEBUG_FOLDER);
    if debug.exists() {
        match foreign_debug(output) {
            None => {
                fs::create_dir_all(output.join(DEBUG_FOLDER))?;
                move_files(&debug, &output.join(DEBUG_FOLDER))?;
                fs::remove_dir(debug)?;
            }
            // It appeared during the run. The results are worth more than the pictures.
            Some(file) => {
                tracing::warn!("{} is not a folder; no pictures are written", file.display());
                fs::remove_dir_all(debug)?;
            }
        }
    }
    fs::remove_dir(complete)?;
    File::open(output)?.sync_all()
}

fn move_files(from: &Path, to: &Path) -> io::Result<()> {
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        if entry.file_type()?.is_file() {
            fs::rename(entry.path(), to.join(entry.file_name()))?;
        }
    }
    Ok(())
}

/// Removes the pictures of the previous set: the new one may have fewer.
fn remove_debug_pictures(output: &Path) -> io::Result<()> {
    let debug = output.join(DEBUG_FOLDER);
    if !has_set(output) || !debug.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(&debug)? {
        let entry = entry?;
        if is_debug_picture(&entry.file_name().to_string_lossy()) && entry.file_type()?.is_file() {
            fs::remove_file(entry.path())?;
        }
    }
    // A folder with a file of the user stays.
    drop(fs::remove_dir(debug));
    Ok(())
}

/// Removes the files that the previous set had on request: the new one may lack them.
fn remove_on_request(output: &Path) -> io::Result<()> {
    for (name, beginning) in ON_REQUEST {
        let path = output.join(name);
        if fs::symlink_metadata(&path).is_ok() && begins_with(&path, beginning)? {
            fs::remove_file(&path)?;
        }
    }
    Ok(())
}

/// Whether a file is named like a picture of a keyframe: `keyframe-NNNN-kind.png`.
fn is_debug_picture(name: &str) -> bool {
    let kinds = ["inverse-depth", "variance", "density", "weights"];
    let rest = name.strip_prefix("keyframe-").and_then(|rest| rest.strip_suffix(".png"));
    rest.and_then(|rest| rest.split_once('-')).is_some_and(|(number, kind)| {
        number.bytes().all(|b| b.is_ascii_digit()) && kinds.contains(&kind)
    })
}

/// Removes sets that processes were writing when they died. Call while the folder is locked.
fn remove_abandoned(output: &Path) -> io::Result<()> {
    for entry in fs::read_dir(output)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if !name.starts_with(PARTIAL) || !path.is_dir() {
            continue;
        }
        let Ok(folder) = File::open(&path) else { continue };
        if rustix::fs::flock(&folder, FlockOperation::NonBlockingLockExclusive).is_ok()
            && let Err(error) = fs::remove_dir_all(&path)
            // Its writer has just removed it.
            && error.kind() != io::ErrorKind::NotFound
        {
            return Err(error);
        }
    }
    Ok(())
}

/// Syncs every file of `folder`, and the folder itself, to disk.
fn synchronise(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        match entry.file_type()?.is_dir() {
            true => synchronise(&entry.path())?,
            false => File::open(entry.path())?.sync_all()?,
        }
    }
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a set whose files all end in `text`, with this many pictures.
    fn write(set: &ResultSet, text: &str, pictures: usize) {
        for (name, beginning) in FILES {
            fs::write(set.folder().join(name), format!("{beginning}{text}")).unwrap();
        }
        // A set with pictures also has the other files on request.
        for (name, beginning) in ON_REQUEST.into_iter().filter(|_| pictures > 0) {
            fs::write(set.folder().join(name), format!("{beginning}{text}")).unwrap();
        }
        let debug = set.folder().join(DEBUG_FOLDER);
        for i in 0..pictures {
            fs::create_dir_all(&debug).unwrap();
            fs::write(debug.join(format!("keyframe-{i:04}-variance.png")), text).unwrap();
        }
    }

    fn commit(output: &Path, text: &str, pictures: usize) {
        let set = ResultSet::begin(output).unwrap();
        write(&set, text, pictures);
        set.commit().unwrap();
    }

    /// Every file of `output` with its content.
    fn content(output: &Path) -> Vec<(String, String)> {
        let mut found = Vec::new();
        for entry in fs::read_dir(output).unwrap().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            match entry.path().is_dir() {
                true => {
                    let inner = content(&entry.path()).into_iter();
                    found.extend(inner.map(|(file, text)| (format!("{name}/{file}"), text)));
                    found.push((name, String::new()));
                }
                false => found.push((name, fs::read_to_string(entry.path()).unwrap())),
            }
        }
        found.sort();
        found
    }

    fn all_of(content: &[(String, String)], text: &str) -> bool {
        let files = content.iter().filter(|(name, _)| FILES.iter().any(|(file, _)| file == name));
        files.filter(|(_, found)| found.ends_with(text)).count() == FILES.len()
    }

    #[test]
    fn a_set_replaces_the_previous_one_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path();
        for (name, text) in [("notes.txt", "mine"), ("debug.txt", "mine")] {
            fs::write(output.join(name), text).unwrap();
        }
        commit(output, "first", 3);
        fs::write(output.join("debug/mine.png"), "mine").unwrap();
        commit(output, "second", 1);
        let found = content(output);
        assert!(all_of(&found, "second"), "{found:?}");
        let names: Vec<&str> = found.iter().map(|(name, _)| name.as_str()).collect();
        assert!(names.contains(&"debug/keyframe-0000-variance.png"));
        assert!(!names.contains(&"debug/keyframe-0001-variance.png"), "of the first set");
        assert!(names.contains(&"debug/mine.png") && names.contains(&"notes.txt"));
        assert!(!names.iter().any(|name| name.starts_with('.')), "{names:?}");
        fs::remove_file(output.join("debug/mine.png")).unwrap();
        assert!(names.contains(&"map.pcd") && names.contains(&"points-full.ply"));
        commit(output, "third", 0);
        assert!(!output.join("debug").exists());
        assert!(
            ON_REQUEST.iter().all(|(name, _)| !output.join(name).exists()),
            "of the second set"
        );
    }

    #[test]
    fn an_abandoned_set_leaves_the_previous_one() {
        let folder = tempfile::tempdir().unwrap();
        commit(folder.path(), "first", 1);
        let before = content(folder.path());
        let set = ResultSet::begin(folder.path()).unwrap();
        write(&set, "second", 2);
        drop(set);
        assert_eq!(content(folder.path()), before);
    }

    #[test]
    fn a_commit_interrupted_anywhere_is_completed_by_the_next() {
        for moved in 0..FILES.len() {
            let folder = tempfile::tempdir().unwrap();
            let output = folder.path();
            commit(output, "first", 2);
            let set = ResultSet::begin(output).unwrap();
            write(&set, "second", 1);
            fs::rename(set.folder(), output.join(COMPLETE)).unwrap();
            drop(set);
            // The process dies after it has moved this many files.
            if moved > 0 {
                remove_debug_pictures(output).unwrap();
                remove_on_request(output).unwrap();
            }
            for (name, _) in &FILES[..moved] {
                fs::rename(output.join(COMPLETE).join(name), output.join(name)).unwrap();
            }
            assert!(finish_commit(output).unwrap());
            let found = content(output);
            assert!(all_of(&found, "second"), "after {moved} files: {found:?}");
            assert_eq!(found.len(), FILES.len() + ON_REQUEST.len() + 2, "{found:?}");
            assert!(!finish_commit(output).unwrap());
        }
    }

    #[test]
    fn a_set_of_a_killed_process_is_removed_and_one_being_written_stays() {
        let folder = tempfile::tempdir().unwrap();
        let abandoned = folder.path().join(format!("{PARTIAL}4194304"));
        fs::create_dir(&abandoned).unwrap();
        fs::write(abandoned.join("map.ply"), "half").unwrap();
        let living = folder.path().join(format!("{PARTIAL}1"));
        fs::create_dir(&living).unwrap();
        let held = File::open(&living).unwrap();
        rustix::fs::flock(&held, FlockOperation::LockExclusive).unwrap();
        drop(ResultSet::begin(folder.path()).unwrap());
        assert!(!abandoned.exists() && living.exists());
    }

    #[test]
    fn a_user_file_in_place_of_the_pictures_survives() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path();
        assert_eq!(foreign_debug(output), None);
        let mine = output.join(DEBUG_FOLDER);
        fs::write(&mine, "mine").unwrap();
        assert_eq!(foreign_debug(output), Some(mine.clone()));
        commit(output, "first", 2);
        commit(output, "second", 0);
        let found = content(output);
        assert!(all_of(&found, "second") && found.len() == FILES.len() + 1, "{found:?}");
        assert_eq!(fs::read_to_string(mine).unwrap(), "mine");
    }

    #[test]
    fn concurrent_sets_do_not_take_each_others_folder() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path();
        let is_over = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|scope| {
            // As other processes do when they begin their own sets.
            let clearing = scope.spawn(|| {
                while !is_over.load(std::sync::atomic::Ordering::Relaxed) {
                    let _alone = lock(output).unwrap();
                    remove_abandoned(output).unwrap();
                }
            });
            let taken = (0..300).filter(|_| {
                let set = ResultSet::begin(output);
                !set.is_ok_and(|set| fs::write(set.folder().join("map.ply"), "x").is_ok())
            });
            let taken = taken.count();
            is_over.store(true, std::sync::atomic::Ordering::Relaxed);
            clearing.join().unwrap();
            assert_eq!(taken, 0);
        });
    }

    #[test]
    fn only_a_user_file_counts_as_foreign() {
        let folder = tempfile::tempdir().unwrap();
        assert!(foreign_file(folder.path()).unwrap().is_none() && !has_set(folder.path()));
        commit(folder.path(), "first", 0);
        assert!(foreign_file(folder.path()).unwrap().is_none() && has_set(folder.path()));
        for (name, beginning) in EARLIER {
            fs::write(folder.path().join(name), beginning).unwrap();
        }
        assert_eq!(foreign_file(folder.path()).unwrap(), None, "of an earlier version");
        let mine = folder.path().join("trajectory.txt");
        fs::write(&mine, "1.0 0 0 0 0 0 0 1\n").unwrap();
        assert_eq!(foreign_file(folder.path()).unwrap(), Some(mine));
    }
}
