//! Where an instance lives: its name, the folder of its files, the prefix of its shared memory, and
//! the claim of a process to be the only one of its kind.

use std::fs::{self, DirBuilder, File};
use std::io::Read;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::prelude::{Config, FileName, Path as IpcPath, SemanticString};
use rustix::fs::FlockOperation;

use crate::wire::folders::{MAX_ROOT_BYTES, SHARED_MEMORY, SYSTEM_ROOT};
use crate::wire::limits::raise_open_files;
use crate::wire::lock_file::{LockFile, Locking, USER_ALONE, lock_named};
use crate::wire::place_error::PlaceError;
use crate::wire::root_folder::{is_mine, usual_root};

/// Longest wait for a process that joins or tidies up: both take milliseconds, on a busy machine a second.
const LONGEST_HOLD: Duration = Duration::from_secs(10);

/// Held while a process joins, and by the last one while it clears up.
pub(in crate::wire) const JOIN_LOCK: &str = ".join.lock";

/// The processes of an instance, by the names under which they claim it.
pub(in crate::wire) const MEMBERS: [&str; 3] = ["capture", "tracker", "mapper"];

/// End of the name of the mapper's checkpoint, behind the instance.
pub(in crate::wire) const CHECKPOINT_SUFFIX: &str = ".checkpoint";

/// End of the name of the file with capture's place in its source, behind the instance.
pub(in crate::wire) const POSITION_SUFFIX: &str = ".position";

/// End of the name of the file that names the map which the mapper has gone over to, behind the instance.
pub(in crate::wire) const LOADED_MAP_SUFFIX: &str = ".map";

/// End of the name of a claim's file, behind the instance and the process.
pub(in crate::wire) const CLAIM_SUFFIX: &str = ".lock";

/// Longest name of an instance: it is part of every topic's name.
const MAX_INSTANCE_BYTES: usize = 32;

/// Where an instance lives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Name of the instance, first part of every topic's name.
    pub instance: String,
    /// Folder of sockets, locks and lists; of one user.
    pub root: PathBuf,
    /// First part of the names in [`SHARED_MEMORY`].
    pub prefix: String,
    /// The usual folder in the temporary one, where somebody else's is in its place.
    pub occupied: Option<PathBuf>,
}

impl Place {
    /// The place of `instance` below `root`, the usual folder where that is empty. Touches nothing.
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

    /// Makes the folder, for this user alone.
    pub fn create(&self) -> Result<(), PlaceError> {
        let io = |source| PlaceError::Io { path: self.root.clone(), source };
        DirBuilder::new().recursive(true).mode(0o700).create(&self.root).map_err(io)?;
        // Neither the folder nor a link to it may be somebody else's.
        for found in [fs::symlink_metadata(&self.root), fs::metadata(&self.root)] {
            if !is_mine(&found.map_err(io)?) {
                return Err(PlaceError::Foreign(self.root.clone()));
            }
        }
        Ok(())
    }

    /// Id of the process that claimed to be the only `process` of this instance last; it may have been killed
    /// since.
    pub fn claimant(&self, process: &str) -> Option<u32> {
        let path = self.claim_path_of(&self.instance, process);
        fs::read_to_string(path).ok()?.trim().parse().ok()
    }

    /// Claims to be the only `process` of this instance; the kernel ends the claim with the process.
    pub fn claim(&self, process: &str) -> Result<Claim, PlaceError> {
        raise_open_files()?;
        self.create()?;
        // Keeps away who tidies up and would hold the lock for a moment.
        let _joining = self.hold()?;
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

    /// Where the mapper keeps what it needs to continue after its death.
    pub fn checkpoint_path(&self) -> PathBuf {
        self.kept_path(&self.instance, CHECKPOINT_SUFFIX)
    }

    /// Where the mapper keeps which map it has gone over to.
    pub fn loaded_map_path(&self) -> PathBuf {
        self.kept_path(&self.instance, LOADED_MAP_SUFFIX)
    }

    /// Where capture keeps its place in the source.
    pub fn position_path(&self) -> PathBuf {
        self.kept_path(&self.instance, POSITION_SUFFIX)
    }

    pub(in crate::wire) fn kept_path(&self, instance: &str, suffix: &str) -> PathBuf {
        self.root.join(format!("{instance}{suffix}"))
    }

    pub(in crate::wire) fn claim_path_of(&self, instance: &str, process: &str) -> PathBuf {
        self.root.join(format!("{instance}.{process}{CLAIM_SUFFIX}"))
    }

    /// Removes what processes of this instance keep for their successors. While the supervisor is claimed and
    /// none of them runs.
    pub fn forget_run(&self) {
        for path in self.kept_files() {
            // What cannot be removed is of another run by its key.
            let _ = fs::remove_file(path);
        }
    }

    /// Takes from the group and all others what iceoryx2 gives them: its counter of nodes is the one
    /// segment that it makes for everybody.
    pub(in crate::wire) fn keep_to_user(&self) {
        for path in self.node_counters() {
            // Another user's cannot be changed, and is not ours.
            let _ = fs::set_permissions(path, fs::Permissions::from_mode(USER_ALONE));
        }
    }

    /// The segments of [`SHARED_MEMORY`] in which iceoryx2 counts the nodes below the root.
    pub(in crate::wire) fn node_counters(&self) -> impl Iterator<Item = PathBuf> {
        self.transport_files(Path::new(SHARED_MEMORY), ".global_mgmt")
    }

    /// What iceoryx2 has of this place in `folder`, by the ends of the names.
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

    /// iceoryx2's configuration for this place, independent of any file that lies around.
    pub(in crate::wire) fn transport_config(&self) -> Result<Config, PlaceError> {
        let wrong = |_| PlaceError::Characters(self.root.clone());
        let mut config = Config::default();
        let root = IpcPath::new(self.root.as_os_str().as_encoded_bytes()).map_err(wrong)?;
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(wrong)?;
        Ok(config)
    }

    /// Keeps [`Place::tidy`] away while a process joins.
    pub(in crate::wire) fn hold(&self) -> Result<File, PlaceError> {
        let path = self.root.join(JOIN_LOCK);
        let io = |source| PlaceError::Io { path: path.clone(), source };
        let end = Instant::now() + LONGEST_HOLD;
        let lock = lock_named(&path, FlockOperation::NonBlockingLockShared, end).map_err(io)?;
        lock.ok_or(PlaceError::Held(path))
    }

    /// The process id of a member of the instance that runs, by its claim.
    pub(in crate::wire) fn running(&self) -> Option<String> {
        MEMBERS.iter().find_map(|process| {
            let path = self.claim_path_of(&self.instance, process);
            let mut file = File::open(path).ok()?;
            rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared).err()?;
            let mut holder = String::new();
            file.read_to_string(&mut holder).ok()?;
            Some(holder.trim().to_owned())
        })
    }
}

/// The claim of a process to be the only one; ends when dropped.
pub type Claim = LockFile;

/// Names in shared memory are global: folders that differ need prefixes that differ, of which none begins with
/// another.
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
    fn every_folder_has_its_prefix() {
        let prefix = |root| Place::new("rig", root).unwrap().prefix;
        let roots = [SYSTEM_ROOT, "/tmp/a", "/tmp/b", "/run/user/1000/semidense"];
        for one in roots {
            assert!(prefix(one).starts_with("semidense_"), "{one}");
            // What belongs to a folder is found by the beginning of its name.
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
