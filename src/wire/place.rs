//! Where an instance lives: its name, the folder of its files, the prefix of its shared memory, and
//! the claim of a process to be the only one of its kind.

use std::fs::{self, DirBuilder, File};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::prelude::{Config, FileName, Path as IpcPath, SemanticString};
use rustix::fs::FlockOperation;

use crate::wire::folders::{MAX_ROOT_BYTES, SHARED_MEMORY, SYSTEM_ROOT};
use crate::wire::limits::raise_open_files;
use crate::wire::lock_file::{LockFile, Locking, USER_ALONE, is_held, lock_named};
use crate::wire::place_error::PlaceError;
use crate::wire::root_folder::{is_mine, usual_root};

/// Longest wait for a process that joins or tidies up: both take milliseconds, on a busy machine up to a second.
const LONGEST_HOLD: Duration = Duration::from_secs(10);

/// Lock held while a process joins, and by the last process while it tidies up.
pub(in crate::wire) const JOIN_LOCK: &str = ".join.lock";

/// The processes of an instance, by the names under which they claim it.
pub(in crate::wire) const MEMBERS: [&str; 3] = ["capture", "tracker", "mapper"];

/// The process that starts them in a run, by the name of its claim.
pub(in crate::wire) const SUPERVISOR: &str = "supervisor";

/// Suffix of the mapper's checkpoint, after the name of the instance.
pub(in crate::wire) const CHECKPOINT_SUFFIX: &str = ".checkpoint";

/// Suffix of the file with capture's position in its source, after the name of the instance.
pub(in crate::wire) const POSITION_SUFFIX: &str = ".position";

/// Suffix of the file that names the map which the mapper has switched to, after the name of the instance.
pub(in crate::wire) const LOADED_MAP_SUFFIX: &str = ".map";

/// Suffix of a claim's file, after the names of the instance and the process.
pub(in crate::wire) const CLAIM_SUFFIX: &str = ".lock";

/// Longest name of an instance: it is part of every topic's name.
const MAX_INSTANCE_BYTES: usize = 32;

/// Where an instance lives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Name of the instance, first part of every topic's name.
    pub instance: String,
    /// Folder of sockets, locks and lists; owned by one user.
    pub root: PathBuf,
    /// Prefix of the names in [`SHARED_MEMORY`].
    pub prefix: String,
    /// The default folder below the temporary one, if another user's file or folder occupies it.
    pub occupied: Option<PathBuf>,
}

impl Place {
    /// Returns the place of `instance` in `root`, or in the default folder if `root` is empty. Touches no file.
    pub fn new(instance: &str, root: &str) -> Result<Self, PlaceError> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        let named = (1..=MAX_INSTANCE_BYTES).contains(&instance.len());
        if !named || !instance.chars().all(allowed) {
            return Err(PlaceError::Instance(instance.to_owned()));
        }
        let (root, occupied) = match root {
            "" => usual_root(),
            named => (PathBuf::from(named), None),
        };
        let root = std::path::absolute(&root)
            .map_err(|source| PlaceError::Io { path: root.clone(), source })?;
        if root.as_os_str().len() > MAX_ROOT_BYTES {
            return Err(PlaceError::TooLong(root));
        }
        if root.to_str().is_none() {
            return Err(PlaceError::Characters(root));
        }
        let prefix = prefix_of(&root);
        Ok(Self { instance: instance.to_owned(), root, prefix, occupied })
    }

    /// Creates the folder for this user alone.
    pub fn create(&self) -> Result<(), PlaceError> {
        let io = |source| PlaceError::Io { path: self.root.clone(), source };
        DirBuilder::new().recursive(true).mode(0o700).create(&self.root).map_err(io)?;
        // Neither the folder nor a link to it may belong to another user.
        for found in [fs::symlink_metadata(&self.root), fs::metadata(&self.root)] {
            if !is_mine(&found.map_err(io)?) {
                return Err(PlaceError::Foreign(self.root.clone()));
            }
        }
        Ok(())
    }

    /// Id of the process that last claimed to be the only `process` of this instance; it may have been killed since.
    pub fn claimant(&self, process: &str) -> Option<u32> {
        let path = self.claim_path_of(&self.instance, process);
        fs::read_to_string(path).ok()?.trim().parse().ok()
    }

    /// Claims to be the only `process` of this instance; the kernel releases the claim when the process ends.
    pub fn claim(&self, process: &str) -> Result<Claim, PlaceError> {
        raise_open_files()?;
        self.create()?;
        // Keeps away a process that tidies up, which would hold the lock for a moment.
        let _joining = self.block_tidy()?;
        let path = self.claim_path_of(&self.instance, process);
        let io = |source| PlaceError::Io { path: path.clone(), source };
        match LockFile::take(&path, USER_ALONE).map_err(io)? {
            Locking::Locked(lock) => Ok(lock),
            Locking::HeldBy(holder) => {
                let (process, instance) = (process.to_owned(), self.instance.clone());
                Err(PlaceError::Taken { process, instance, holder })
            }
        }
    }

    /// Path of the mapper's checkpoint, from which it continues after it was killed.
    pub fn checkpoint_path(&self) -> PathBuf {
        self.kept_path(&self.instance, CHECKPOINT_SUFFIX)
    }

    /// Path of the file that names the map which the mapper has switched to.
    pub fn loaded_map_path(&self) -> PathBuf {
        self.kept_path(&self.instance, LOADED_MAP_SUFFIX)
    }

    /// Path of the file with capture's position in the source.
    pub fn position_path(&self) -> PathBuf {
        self.kept_path(&self.instance, POSITION_SUFFIX)
    }

    pub(in crate::wire) fn kept_path(&self, instance: &str, suffix: &str) -> PathBuf {
        self.root.join(format!("{instance}{suffix}"))
    }

    pub(in crate::wire) fn claim_path_of(&self, instance: &str, process: &str) -> PathBuf {
        self.root.join(format!("{instance}.{process}{CLAIM_SUFFIX}"))
    }

    /// Removes the files that processes of this instance keep for their successors. Only while the supervisor is
    /// claimed and none of them runs.
    pub fn remove_run_files(&self) {
        for path in self.kept_files() {
            // A file that cannot be removed is recognised as another run's by its key.
            let _ = fs::remove_file(path);
        }
    }

    /// Revokes the access that iceoryx2 grants to the group and to others: its counter of nodes is the only segment
    /// that it creates for everybody.
    pub(in crate::wire) fn keep_to_user(&self) {
        for path in self.node_counters() {
            // Another user's counter cannot be changed, and is not ours.
            let _ = fs::set_permissions(path, fs::Permissions::from_mode(USER_ALONE));
        }
    }

    /// The segments of [`SHARED_MEMORY`] in which iceoryx2 counts the nodes below the root.
    pub(in crate::wire) fn node_counters(&self) -> impl Iterator<Item = PathBuf> {
        self.transport_files(Path::new(SHARED_MEMORY), ".global_mgmt")
    }

    /// Files of iceoryx2 for this place in `folder` whose names end in `suffix`.
    pub(in crate::wire) fn transport_files(
        &self,
        folder: &Path,
        suffix: &str,
    ) -> impl Iterator<Item = PathBuf> {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).filter(move |path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(&self.prefix) && name.ends_with(suffix)
        })
    }

    /// iceoryx2's configuration for this place, independent of any configuration file.
    pub(in crate::wire) fn transport_config(&self) -> Result<Config, PlaceError> {
        let wrong = |_| PlaceError::Characters(self.root.clone());
        let mut config = Config::default();
        let root = IpcPath::new(self.root.as_os_str().as_encoded_bytes()).map_err(wrong)?;
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(wrong)?;
        Ok(config)
    }

    /// Keeps [`Place::tidy`] away while a process joins.
    pub(in crate::wire) fn block_tidy(&self) -> Result<File, PlaceError> {
        let path = self.root.join(JOIN_LOCK);
        let io = |source| PlaceError::Io { path: path.clone(), source };
        let end = Instant::now() + LONGEST_HOLD;
        let lock = lock_named(&path, FlockOperation::NonBlockingLockShared, end).map_err(io)?;
        lock.ok_or(PlaceError::Held(path))
    }

    /// Whether `process` of this instance runs.
    pub fn is_running(&self, process: &str) -> bool {
        let path = self.claim_path_of(&self.instance, process);
        path.exists() && is_held(&path)
    }

    /// Process id of a running member of the instance, from its claim.
    pub(in crate::wire) fn running(&self) -> Option<String> {
        let process = MEMBERS.iter().find(|process| self.is_running(process))?;
        let holder = fs::read_to_string(self.claim_path_of(&self.instance, process)).ok()?;
        Some(holder.trim().to_owned())
    }
}

/// A process's claim to be the only one of its kind; released when dropped.
pub type Claim = LockFile;

/// Names in shared memory are global: different folders need different prefixes, none of which begins with another.
fn prefix_of(root: &Path) -> String {
    if root == Path::new(SYSTEM_ROOT) {
        return "semidense_system_".to_owned();
    }
    // FNV-1a, 32 bits.
    const OFFSET: u32 = 0x811c_9dc5;
    const PRIME: u32 = 0x0100_0193;
    let bytes = root.as_os_str().as_encoded_bytes();
    let hash = bytes.iter().fold(OFFSET, |hash, &b| (hash ^ u32::from(b)).wrapping_mul(PRIME));
    format!("semidense_{hash:08x}_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_folders_are_checked() {
        assert!(Place::new("rig-1", "/tmp/x").is_ok());
        for bad in ["", "a/b", "ä", &"x".repeat(33)] {
            assert!(matches!(Place::new(bad, "/tmp/x"), Err(PlaceError::Instance(_))), "{bad}");
        }
        let long = format!("/tmp/{}", "x".repeat(60));
        assert!(matches!(Place::new("rig", &long), Err(PlaceError::TooLong(_))));
    }

    #[test]
    fn every_folder_has_its_own_prefix() {
        let prefix = |root| Place::new("rig", root).unwrap().prefix;
        let roots = [SYSTEM_ROOT, "/tmp/a", "/tmp/b", "/run/user/1000/semidense"];
        for one in roots {
            assert!(prefix(one).starts_with("semidense_"), "{one}");
            // The files of a folder are found by the prefix of their names.
            for other in roots.into_iter().filter(|&other| other != one) {
                assert!(!prefix(other).starts_with(&prefix(one)), "{other} is taken for {one}");
            }
        }
    }

    #[test]
    fn only_one_claim_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let first = place.claim("capture").unwrap();
        let error = place.claim("capture").unwrap_err().to_string();
        assert!(error.contains(&format!("process {}", std::process::id())), "{error}");
        assert!(place.claim("tracker").is_ok());
        drop(first);
        drop(place.claim("capture").unwrap());
        place.tidy();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
