//! Where journals are, and which belong to runs that were killed.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use rustix::fs::FlockOperation;

use crate::service::atomic_file::write_privately;
use crate::service::results::output_folder::{PARENT, utc_stamp};
use crate::slam::keyframe::Keyframe;
use crate::wire::place::Place;

/// Prefix of a journal's name, before the second (UTC) of its start and the process id.
const PREFIX: &str = ".semidense-journal-";
/// Name of the log in it.
pub const LOG: &str = "log";
/// Suffix of the name of a pointer to a journal, after instance and process id.
const POINTER_SUFFIX: &str = ".journal";
/// Prefix of keyframe files.
const KEYFRAME_PREFIX: &str = "keyframe-";

/// Name of the file of a keyframe, whose epoch may change when epochs are joined.
pub(super) fn keyframe_file(keyframe: &Keyframe) -> String {
    format!("{KEYFRAME_PREFIX}{}-{}.map", keyframe.keyframe_id, keyframe.sequence)
}

/// Makes the folder of a new journal in `output`, for this user alone: it holds images.
pub(super) fn begin_folder(output: &Path) -> io::Result<PathBuf> {
    use std::os::unix::fs::DirBuilderExt;
    let stamp = utc_stamp(SystemTime::now());
    let name = format!("{PREFIX}{stamp}-{}", std::process::id());
    let folder = std::path::absolute(output.join(name))?;
    fs::DirBuilder::new().mode(0o700).create(&folder)?;
    Ok(folder)
}

/// Holds a log, to write it or to make results from it; `None` where another process holds it.
pub fn lock(log: &Path) -> io::Result<Option<File>> {
    // On NFS only a file open for writing can be held alone; one that cannot be written may be held elsewhere.
    let open = File::options().read(true).write(true).open(log);
    let file = open.or_else(|_| File::open(log))?;
    match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(Some(file)),
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Removes a journal: its own files, then the folder, which must hold nothing else.
pub fn remove_folder(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(KEYFRAME_PREFIX) {
            fs::remove_file(entry.path())?;
        }
    }
    // Last: a folder without it is not a journal.
    fs::remove_file(folder.join(LOG))?;
    fs::remove_dir(folder)
}

/// A file in the runtime folder that names the journal of a run, so that it is found from any folder.
#[derive(Debug)]
pub(super) struct Pointer(PathBuf);

impl Pointer {
    /// Writes it for the journal `folder`.
    pub fn set(place: &Place, folder: &Path) -> io::Result<Self> {
        use std::os::unix::ffi::OsStrExt;
        place.create().map_err(io::Error::other)?;
        let name = format!("{}.{}{POINTER_SUFFIX}", place.instance, std::process::id());
        let path = place.root.join(name);
        write_privately(&path, |file| file.write_all(folder.as_os_str().as_bytes()))?;
        Ok(Self(path))
    }

    /// Removes it.
    pub fn clear(self) -> io::Result<()> {
        fs::remove_file(self.0)
    }
}

/// A journal that no process writes any more.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Unfinished {
    /// The second of its start and the process id, as in its name: the order of journals.
    pub stamp: String,
    /// Its folder.
    pub folder: PathBuf,
}

impl Unfinished {
    /// The output folder that contains it.
    pub fn output(&self) -> &Path {
        self.folder.parent().unwrap_or(Path::new("."))
    }
}

/// Journals of killed runs, oldest first: in `output`, in all folders that the instance at `place` has written into,
/// and in those below [`PARENT`].
pub fn unfinished(place: Option<&Place>, output: &Path) -> Vec<Unfinished> {
    let mut folders = journals_in(output);
    for entry in fs::read_dir(PARENT).into_iter().flatten().flatten() {
        // The link to the newest leads to one of the others.
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            folders.extend(journals_in(&entry.path()));
        }
    }
    folders.extend(place.into_iter().flat_map(pointed_at));
    let mut found: Vec<Unfinished> = folders.into_iter().filter_map(unlocked_journal).collect();
    found.sort();
    found.dedup();
    found
}

/// The journals in a folder.
fn journals_in(output: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(output).into_iter().flatten().flatten();
    let names = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX));
    names.map(|entry| entry.path()).collect()
}

/// The journals that pointers of the instance name; removes pointers to journals that are gone.
fn pointed_at(place: &Place) -> Vec<PathBuf> {
    use std::os::unix::ffi::OsStringExt;
    let mut found = Vec::new();
    for entry in fs::read_dir(&place.root).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let process = name.strip_suffix(POINTER_SUFFIX).and_then(|name| name.rsplit_once('.'));
        if process.is_none_or(|(instance, _)| instance != place.instance) {
            continue;
        }
        let Ok(bytes) = fs::read(entry.path()) else { continue };
        let folder = PathBuf::from(std::ffi::OsString::from_vec(bytes));
        match folder.join(LOG).exists() {
            true => found.push(folder),
            // What cannot be removed is left to the next search.
            false => drop(fs::remove_file(entry.path())),
        }
    }
    found
}

/// The journal in `folder`, if no process holds it.
fn unlocked_journal(folder: PathBuf) -> Option<Unfinished> {
    let folder = folder.canonicalize().ok()?;
    lock(&folder.join(LOG)).ok()??;
    let name = folder.file_name()?.to_string_lossy().into_owned();
    Some(Unfinished { stamp: name.strip_prefix(PREFIX)?.to_owned(), folder })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unheld_journal_is_found_in_its_folder_and_by_its_pointer() {
        let root = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", root.path().to_str().unwrap()).unwrap();
        let output = tempfile::tempdir().unwrap();
        let folder = begin_folder(output.path()).unwrap();
        fs::write(folder.join(LOG), "x").unwrap();
        let pointer = Pointer::set(&place, &folder).unwrap();
        let held = lock(&folder.join(LOG)).unwrap().unwrap();
        assert_eq!(unfinished(Some(&place), output.path()), []);
        drop(held);
        let nowhere = Path::new("/nowhere");
        for (place, output) in [(Some(&place), nowhere), (None, output.path())] {
            let found = unfinished(place, output);
            assert_eq!(found.len(), 1, "{found:?}");
            assert_eq!(found[0].folder, folder.canonicalize().unwrap());
        }
        let other = Place::new("rig2", root.path().to_str().unwrap()).unwrap();
        assert_eq!(unfinished(Some(&other), nowhere), []);
        fs::write(folder.join("mine"), "x").unwrap();
        assert!(remove_folder(&folder).is_err() && folder.join("mine").exists());
        assert_eq!(unfinished(Some(&place), nowhere), []);
        assert!(pointer.clear().is_err(), "a pointer to a journal that is gone goes");
    }
}
