//! Removes files from the folder of an instance and from shared memory when a process leaves and no other process needs
//! them.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use iceoryx2::node::NodeState;
use iceoryx2::prelude::*;
use rustix::fs::FlockOperation;

use crate::wire::folders::SHARED_MEMORY;
use crate::wire::lock_file::{is_held, lock_named};
use crate::wire::place::{
    CHECKPOINT_SUFFIX, CLAIM_SUFFIX, JOIN_LOCK, LOADED_MAP_SUFFIX, MEMBERS, POSITION_SUFFIX, Place,
    SUPERVISOR,
};
use crate::wire::unfinished::{OWNER_MAY_WRITE, is_ours};

/// Longest wait before tidying up; the next process that leaves can do it as well.
const LONGEST_TIDY_WAIT: Duration = Duration::from_secs(1);
/// How long the files kept by a killed process wait for its successor: the service manager starts one within five
/// seconds, and a busy machine takes a few more.
const SUCCESSOR_WAIT: Duration = Duration::from_secs(30);

impl Place {
    /// Removes what iceoryx2 leaves behind after its last node: its counter of nodes, its empty folders, and what a
    /// process had when it was killed while it joined; and what killed processes left, unless a successor may still
    /// need it. While a process is present only the remains of dead ones are removed, and while one joins nothing.
    pub fn tidy(&self) {
        let path = self.root.join(JOIN_LOCK);
        // Waits for a process that joins or tidies up: of two that leave together, the second must also check for what
        // the first could not remove while it was present. If the other process is stopped, the next one tidies up.
        let end = Instant::now() + LONGEST_TIDY_WAIT;
        let alone = FlockOperation::NonBlockingLockExclusive;
        let Ok(Some(_lock)) = lock_named(&path, alone, end) else { return };
        self.remove_unfinished();
        // What cannot be removed is left to the next process.
        self.remove_dead_nodes();
        self.remove_failed_nodes();
        self.remove_left_files();
        if self.is_deserted() {
            // Without a node no process has any of it open; what iceoryx2 did not remove belongs to processes that were
            // killed while they joined.
            self.transport_files(Path::new(SHARED_MEMORY), "")
                .for_each(|path| drop(fs::remove_file(path)));
            self.remove_abandoned();
            let _ = fs::remove_dir_all(self.root.join("nodes"));
            let _ = fs::remove_dir_all(self.root.join("services"));
            // The sockets of events.
            self.transport_files(&self.root, ".event").for_each(|path| drop(fs::remove_file(path)));
            let _ = fs::remove_file(&path);
        }
    }

    /// Whether there are nodes, living or dead, below the root.
    fn has_nodes(&self) -> bool {
        fs::read_dir(self.root.join("nodes")).is_ok_and(|mut nodes| nodes.next().is_some())
    }

    /// Whether no node lives: there is none, or each is known to be dead. Only while no process can join.
    fn is_deserted(&self) -> bool {
        let monitors = self.node_monitors().count();
        if monitors == 0 {
            return true;
        }
        let Ok(config) = self.transport_config() else { return false };
        let mut dead = 0;
        let listed = Node::<ipc::Service>::list(&config, |state| {
            dead += usize::from(matches!(state, NodeState::Dead(_)));
            CallbackProgression::Continue
        });
        listed.is_ok() && dead == monitors
    }

    /// Names of the files by which nodes are known to live.
    fn node_monitors(&self) -> impl Iterator<Item = String> {
        let nodes = fs::read_dir(self.root.join("nodes")).into_iter().flatten().flatten();
        let names = nodes.map(|entry| entry.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.ends_with(".node_monitor"))
    }

    /// Removes what killed processes left in shared memory. The last process to leave may be the only one to do so.
    fn remove_dead_nodes(&self) {
        let Ok(config) = self.transport_config() else { return };
        if !self.has_nodes() {
            return;
        }
        // What cannot be listed or removed is left to the next process.
        let _ = Node::<ipc::Service>::list(&config, |state| {
            if let NodeState::Dead(node) = state {
                let _ = node.try_remove_stale_resources();
            }
            CallbackProgression::Continue
        });
    }

    /// Removes nodes that never started: a failed start leaves a folder without its `.node_monitor`, or a process that
    /// was killed an unfinished one, neither of which could ever be recognised as dead. Only while no process can join.
    fn remove_failed_nodes(&self) {
        let nodes = self.root.join("nodes");
        for name in self.node_monitors() {
            if is_unfinished(&nodes.join(format!("{name}_context"))) {
                let _ = fs::remove_file(nodes.join(name));
            }
        }
        for entry in fs::read_dir(&nodes).into_iter().flatten().flatten() {
            let id = entry.file_name().to_string_lossy().into_owned();
            let has_monitor = || self.node_monitors().any(|name| name.contains(&id));
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) && !has_monitor() {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }

    /// Removes the files kept for successors once the last process of this instance has left in order, while other
    /// instances go on. Only while no process can join.
    fn remove_left_files(&self) {
        // A killed process leaves its claim, and a supervisor starts its processes again.
        let mut owners = MEMBERS.iter().chain([&SUPERVISOR]);
        let is_left = owners.all(|of| !self.claim_path_of(&self.instance, of).exists());
        if is_left {
            self.kept_files().for_each(|path| drop(fs::remove_file(path)));
        }
    }

    /// Removes checkpoints, positions and dead claims of instances that await no successor. Only while no process can
    /// join.
    fn remove_abandoned(&self) {
        let files = self.instance_files();
        let instances: BTreeSet<&str> =
            files.iter().map(|(instance, ..)| instance.as_str()).collect();
        let waiting: BTreeSet<&str> =
            instances.into_iter().filter(|instance| self.awaits_successor(instance)).collect();
        for (instance, kind, path) in &files {
            let is_needed = match kind {
                // Its writer is dead: it will not be completed.
                Kind::Unfinished => false,
                Kind::Kept => waiting.contains(instance.as_str()),
                Kind::Claim => waiting.contains(instance.as_str()) || is_held(path),
            };
            if !is_needed {
                let _ = fs::remove_file(path);
            }
        }
    }

    /// Whether a process of `instance` may still continue from the files kept for it: one holds its claim but has not
    /// joined yet, or one was killed, which leaves its claim, so recently that its successor is still due.
    fn awaits_successor(&self, instance: &str) -> bool {
        let claims = MEMBERS.map(|member| self.claim_path_of(instance, member));
        let mut there = claims.iter().filter(|path| path.exists()).peekable();
        if there.peek().is_none() {
            return false;
        }
        let mut kept = [CHECKPOINT_SUFFIX, POSITION_SUFFIX].into_iter();
        there.any(|path| is_held(path))
            || kept.any(|suffix| is_young(&self.kept_path(instance, suffix)))
    }

    /// Files that processes of this instance keep for their successors.
    pub(in crate::wire) fn kept_files(&self) -> impl Iterator<Item = PathBuf> {
        let is_ours = |(instance, kind, _): &(String, Kind, PathBuf)| {
            *instance == self.instance && matches!(kind, Kind::Kept | Kind::Unfinished)
        };
        self.instance_files().into_iter().filter(is_ours).map(|(.., path)| path)
    }

    /// The files of all instances in the folder, each with the name of its instance.
    fn instance_files(&self) -> Vec<(String, Kind, PathBuf)> {
        let entries = fs::read_dir(&self.root).into_iter().flatten().flatten();
        let described = entries.filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let kind = Kind::of(&name)?;
            // The name of an unfinished file begins with a dot; the name of an instance contains none.
            let instance = name.trim_start_matches('.').split('.').next()?.to_owned();
            Some((instance, kind, entry.path()))
        });
        described.collect()
    }
}

/// Whether this is the name of a checkpoint, or of a keyframe that belongs to one: `NAME.checkpoint.ID`.
fn is_checkpoint(name: &str) -> bool {
    let id = name.split_once(CHECKPOINT_SUFFIX).map(|(_, id)| id);
    id.is_some_and(|id| {
        id.strip_prefix('.').map_or(id.is_empty(), |id| id.bytes().all(|b| b.is_ascii_digit()))
    })
}

/// Kind of a file of an instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A checkpoint, a position, or the name of the map that was switched to.
    Kept,
    /// One of these that was being written.
    Unfinished,
    /// The claim of a process.
    Claim,
}

impl Kind {
    /// Returns the kind by the file's name; `None` for files that are not ours.
    fn of(name: &str) -> Option<Self> {
        let kept = [CHECKPOINT_SUFFIX, POSITION_SUFFIX, LOADED_MAP_SUFFIX];
        if name.ends_with(".tmp") && kept.iter().any(|suffix| name.contains(suffix)) {
            return Some(Self::Unfinished);
        }
        if is_checkpoint(name)
            || name.ends_with(POSITION_SUFFIX)
            || name.ends_with(LOADED_MAP_SUFFIX)
        {
            return Some(Self::Kept);
        }
        (name != JOIN_LOCK && name.ends_with(CLAIM_SUFFIX)).then_some(Self::Claim)
    }
}

/// Whether this is the file about a node's process while it is being made: nobody may read it.
fn is_unfinished(context: &Path) -> bool {
    is_ours(context, |found| found.mode() & 0o777 == OWNER_MAY_WRITE)
}

/// Whether a file was written so recently that a successor of its writer may still start. A stamp in the future counts
/// like one in the past: the clock may have been set.
fn is_young(path: &Path) -> bool {
    let written = fs::metadata(path).and_then(|found| found.modified());
    let age = |written| {
        SystemTime::now().duration_since(written).unwrap_or_else(|ahead| ahead.duration())
    };
    written.is_ok_and(|written| age(written) < SUCCESSOR_WAIT)
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    use rustix::thread::Timespec;

    use super::*;
    use crate::wire::lock_file::{USER_ALONE, is_same_file, lock_until, open_lock};

    /// A place in a temporary folder.
    fn place() -> (tempfile::TempDir, Place) {
        let folder = tempfile::tempdir().unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        (folder, place)
    }

    /// Leaves the claim of a process that was killed.
    fn killed(place: &Place, process: &str) -> PathBuf {
        let path = place.root.join(format!("rig.{process}.lock"));
        fs::write(&path, "4194304\n").unwrap();
        path
    }

    /// Makes a file older than the wait for successors.
    fn age(path: &Path) {
        let long_ago = SystemTime::now() - 2 * SUCCESSOR_WAIT;
        fs::File::options().write(true).open(path).unwrap().set_modified(long_ago).unwrap();
    }

    #[test]
    fn tidying_does_not_wait_forever_for_a_process_that_joins() {
        let (folder, place) = place();
        place.create().unwrap();
        let joining = place.block_tidy().unwrap();
        let end = Instant::now();
        assert!(!lock_until(
            &open_lock(&folder.path().join(JOIN_LOCK), USER_ALONE).unwrap(),
            FlockOperation::NonBlockingLockExclusive,
            end
        ));
        place.tidy();
        assert!(folder.path().join(JOIN_LOCK).exists());
        drop(joining);
        place.tidy();
        assert!(!folder.path().join(JOIN_LOCK).exists());
    }

    #[test]
    fn of_two_that_tidy_up_together_the_second_locks_the_new_file() {
        /// Time for the second to open the file that the first removes.
        const HOLD: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        let (_folder, place) = place();
        place.create().unwrap();
        let path = place.root.join(JOIN_LOCK);
        let end = Instant::now() + Duration::from_secs(240);
        let lock = || lock_named(&path, FlockOperation::NonBlockingLockExclusive, end).unwrap();
        let first = lock();
        let leave = || {
            drop(rustix::thread::nanosleep(&HOLD));
            fs::remove_file(&path).unwrap();
            drop(first);
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let (second, ()) = pool.join(lock, leave);
        assert!(second.is_some_and(|lock| is_same_file(&lock, &path)));
    }

    #[test]
    fn files_kept_by_killed_processes_wait_for_their_successors() {
        let (folder, place) = place();
        let kept = [place.checkpoint_path(), place.position_path(), place.loaded_map_path()];
        let other = folder.path().join("rig2.checkpoint");
        for path in kept.iter().chain([&other]) {
            fs::write(path, "x").unwrap();
        }
        let unfinished = [".rig.checkpoint.17.tmp", ".rig.map.17.tmp", ".rig.position.17.tmp"];
        let unfinished = unfinished.map(|name| folder.path().join(name));
        unfinished.iter().for_each(|path| fs::write(path, "x").unwrap());
        let claims = ["capture", "tracker", "mapper", "supervisor"].map(|p| killed(&place, p));
        // As `status` does on leaving while all of them await their restart.
        place.tidy();
        assert!(kept.iter().chain(&claims).all(|path| path.exists()));
        assert!(!other.exists(), "it has no process that was killed");
        assert!(unfinished.iter().all(|path| !path.exists()));
        // The newer of the two counts: a map that does not change is seldom written.
        age(&kept[0]);
        place.tidy();
        assert!(kept[0].exists());
        age(&kept[1]);
        place.tidy();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn kept_files_wait_for_a_process_that_is_about_to_join() {
        let (_folder, place) = place();
        fs::write(place.checkpoint_path(), "x").unwrap();
        age(&place.checkpoint_path());
        let coming = place.claim("mapper").unwrap();
        place.tidy();
        assert!(place.checkpoint_path().exists());
        // An orderly end removes the claim.
        drop(coming);
        place.tidy();
        assert!(!place.checkpoint_path().exists());
    }

    #[test]
    fn the_last_process_of_an_instance_removes_its_files_while_another_instance_runs() {
        let (folder, place) = place();
        let node = folder.path().join("nodes/123");
        fs::create_dir_all(&node).unwrap();
        fs::write(folder.path().join("nodes/123.node_monitor"), "").unwrap();
        fs::write(place.checkpoint_path(), "x").unwrap();
        let other = folder.path().join("rig2.checkpoint");
        fs::write(&other, "x").unwrap();
        let tracker = place.claim("tracker").unwrap();
        place.tidy();
        assert!(place.checkpoint_path().exists(), "a mapper restarted alone continues");
        drop(tracker);
        let supervisor = place.claim("supervisor").unwrap();
        place.tidy();
        assert!(place.checkpoint_path().exists(), "its processes are started again");
        drop(supervisor);
        place.tidy();
        assert!(!place.checkpoint_path().exists() && other.exists() && node.exists());
    }

    #[test]
    fn claims_of_dead_processes_are_removed_and_others_kept() {
        let (folder, place) = place();
        let dead = killed(&place, "supervisor");
        fs::write(place.position_path(), "").unwrap();
        let foreign = folder.path().join("notes.txt");
        fs::write(&foreign, "").unwrap();
        place.tidy();
        assert!(!dead.exists() && foreign.exists() && !place.position_path().exists());
        let dead = killed(&place, "supervisor");
        let other = folder.path().join("rig2.tracker.lock");
        fs::write(&other, "4194304\n").unwrap();
        let living = place.claim("capture").unwrap();
        place.tidy();
        assert!(place.claim("capture").is_err(), "the living one still holds its claim");
        assert!(dead.exists() && !other.exists());
        drop(living);
        place.tidy();
        assert!(!dead.exists());
    }

    #[test]
    fn leftovers_of_a_failed_start_are_removed() {
        let (folder, place) = place();
        let nodes = folder.path().join("nodes");
        fs::create_dir_all(nodes.join("123")).unwrap();
        fs::write(nodes.join("123/x.details"), "").unwrap();
        fs::create_dir_all(nodes.join("456")).unwrap();
        fs::write(nodes.join("p_456.node_monitor"), "").unwrap();
        // Killed before its monitor was finished.
        fs::create_dir_all(nodes.join("789")).unwrap();
        let context = nodes.join("p_789.node_monitor_context");
        for path in [&nodes.join("p_789.node_monitor"), &context] {
            fs::write(path, "").unwrap();
            fs::set_permissions(path, Permissions::from_mode(OWNER_MAY_WRITE)).unwrap();
        }
        place.tidy();
        assert!(!nodes.join("123").exists() && nodes.join("456").exists());
        assert!(!nodes.join("789").exists());
        fs::remove_file(nodes.join("p_456.node_monitor")).unwrap();
        fs::create_dir(folder.path().join("services")).unwrap();
        fs::write(folder.path().join("services/x.service"), "").unwrap();
        place.tidy();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
