//! Only the user of the service can read or write what it shares: folders, files, sockets, shared memory.

#[allow(dead_code, reason = "every test uses its part of what they share")]
mod support;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use rustix::process::Signal;
use semidense::service::peers::Peer;
use semidense::wire::folders::SHARED_MEMORY;
use semidense::wire::topic::MAPPER_HEALTH;
use support::{Rig, end, signal, until};

/// Permissions of the group and of all others.
const NOT_THE_USER: u32 = 0o077;

/// Collects everything below `folder`, including itself.
fn below(folder: &Path, found: &mut Vec<PathBuf>) {
    found.push(folder.to_owned());
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        match entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            true => below(&entry.path(), found),
            false => found.push(entry.path()),
        }
    }
}

#[test]
fn files_shared_by_a_run_are_accessible_to_its_user_only() {
    let rig = Rig::new();
    // Logins usually set a mask; with 0, only explicitly requested permissions protect.
    rustix::process::umask(rustix::fs::Mode::from_raw_mode(0));
    let child = rig.run(60, &["--live", "--source", "loop:1000000:20:sim"]).spawn().unwrap();
    let hub = rig.observe();
    let mut mapper = until("the mapper", || Peer::open(&hub, &MAPPER_HEALTH).ok());
    until("a checkpoint", || {
        mapper.update().unwrap();
        rig.place().checkpoint_path().exists().then_some(())
    });
    let prefix = rig.place().prefix;
    let shared: Vec<PathBuf> = fs::read_dir(SHARED_MEMORY)
        .unwrap()
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        .map(|entry| entry.path())
        .collect();
    let mut own = Vec::new();
    below(&rig.root(), &mut own);
    // Seven topics with their data, and the sockets, locks and lists of the root.
    assert!(shared.len() > 10 && own.len() > 10, "{shared:?} {own:?}");
    let open_to_others: Vec<String> = shared
        .iter()
        .chain(&own)
        .filter_map(|path| Some((path, fs::symlink_metadata(path).ok()?.permissions().mode())))
        .filter(|(path, mode)| {
            // A folder that cannot be entered protects everything below it.
            let is_within = path.starts_with(rig.root()) && **path != rig.root();
            !is_within && mode & NOT_THE_USER != 0
        })
        .map(|(path, mode)| format!("{:o} {}", mode & 0o7777, path.display()))
        .collect();
    assert_eq!(open_to_others, Vec::<String>::new());
    drop((mapper, hub));
    signal(&child, Signal::INT);
    assert_eq!(end(child).status.code(), Some(130));
}
