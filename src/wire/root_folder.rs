//! The default folder for the files of an instance, found by all processes of a user.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::wire::folders::{ROOT_VARIABLE, SYSTEM_ROOT};

/// Returns the folder named by the environment, else systemd's runtime folder, else the services' if this user owns it,
/// else the user's, else one in the temporary folder; then also the default name if another one was chosen.
pub(in crate::wire) fn usual_root() -> (PathBuf, Option<PathBuf>) {
    let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    if let Some(root) = variable(ROOT_VARIABLE).or_else(|| variable("RUNTIME_DIRECTORY")) {
        return (PathBuf::from(root), None);
    }
    let is_my_folder = |folder: &Path| fs::metadata(folder).is_ok_and(|found| is_mine(&found));
    if is_my_folder(Path::new(SYSTEM_ROOT)) {
        return (PathBuf::from(SYSTEM_ROOT), None);
    }
    // After `su` or `sudo` it may name the previous user's folder.
    if let Some(folder) = variable("XDG_RUNTIME_DIR").map(PathBuf::from)
        && is_my_folder(&folder)
    {
        return (folder.join("semidense"), None);
    }
    private_root(&std::env::temp_dir())
}

/// Returns this user's folder in `temporary`, where any user may create one of any name first: of the names
/// `semidense-UID`, `semidense-UID-1` and so on the first that is ours, so that all our processes find the same one,
/// else the first that is free. Also returns the default name if a different one was chosen.
fn private_root(temporary: &Path) -> (PathBuf, Option<PathBuf>) {
    /// Names to try; a user who takes more does so on purpose.
    const NAMES: usize = 20;
    let user = rustix::process::geteuid().as_raw();
    let usual = temporary.join(format!("semidense-{user}"));
    let numbered = (1..NAMES).map(|n| temporary.join(format!("semidense-{user}-{n}")));
    let names: Vec<PathBuf> = std::iter::once(usual.clone()).chain(numbered).collect();
    // Links are not followed: one could lead anywhere.
    let is_ours =
        |path: &&PathBuf| fs::symlink_metadata(path).is_ok_and(|found| is_private(&found));
    let is_free = |path: &&PathBuf| {
        fs::symlink_metadata(path).is_err_and(|error| error.kind() == io::ErrorKind::NotFound)
    };
    let found = names.iter().find(is_ours).or_else(|| names.iter().find(is_free));
    let root = found.unwrap_or(&usual).clone();
    let occupied = (root != usual).then_some(usual);
    (root, occupied)
}

/// Whether this user owns the file or folder.
pub(in crate::wire) fn is_mine(found: &fs::Metadata) -> bool {
    found.uid() == rustix::process::geteuid().as_raw()
}

/// Whether it is a folder of this user that no other user can write to.
fn is_private(found: &fs::Metadata) -> bool {
    const WRITABLE_BY_OTHERS: u32 = 0o022;
    found.is_dir() && is_mine(found) && found.mode() & WRITABLE_BY_OTHERS == 0
}

#[cfg(test)]
mod tests {
    use std::fs::DirBuilder;
    use std::os::unix::fs::{DirBuilderExt, PermissionsExt, symlink};

    use super::*;

    #[test]
    fn a_taken_name_in_the_temporary_folder_is_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let user = rustix::process::geteuid().as_raw();
        let name = |suffix: &str| folder.path().join(format!("semidense-{user}{suffix}"));
        assert_eq!(private_root(folder.path()), (name(""), None));
        // A link, a file, a folder that any user may write to.
        symlink(folder.path(), name("")).unwrap();
        fs::write(name("-1"), "").unwrap();
        fs::create_dir(name("-2")).unwrap();
        fs::set_permissions(name("-2"), fs::Permissions::from_mode(0o777)).unwrap();
        let expected = (name("-3"), Some(name("")));
        assert_eq!(private_root(folder.path()), expected);
        DirBuilder::new().mode(0o700).create(name("-3")).unwrap();
        // It is found again, even once an earlier name is free.
        fs::remove_file(name("")).unwrap();
        assert_eq!(private_root(folder.path()), expected);
    }
}
