//! The output folder of a run: the one that the user names, or a new one for each run.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use rustix::fs::{Mode, OFlags};

use crate::service::results::output_lock::lock_output;
use crate::service::results::results_error::ResultsError;
use crate::service::results::set::{finish_commit, foreign_file};
use crate::wire::lock_file::{LockFile, Locking};

/// Folder of the output folders, below the working directory.
pub const PARENT: &str = "output";
/// Name of the link to the newest folder.
pub const LATEST: &str = "latest";

/// Most runs that start in the same second in the same folder.
const MAX_SAME_SECOND: u32 = 1000;

/// The folder of a run's results, locked for this process. If the program has made it, it is removed on drop when
/// nothing was written.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    /// Folders to remove if they stay empty, the innermost first.
    made: Vec<PathBuf>,
    kind: Kind,
    /// Released before the folders are removed.
    lock: Option<LockFile>,
}

/// Origin of the folder's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// Named by the user.
    Named,
    /// Named by the time: made for this run.
    New,
    /// Named by a killed run that is being recovered.
    Recovered,
}

impl OutputFolder {
    /// The folder `named`, else a new one in [`PARENT`], named by the second (UTC) of its creation. Checks that it can
    /// be written, so that a lack of space or permission is noticed before the run, and locks it.
    pub fn prepare(named: Option<&Path>) -> Result<Self, ResultsError> {
        match named {
            Some(path) => Self::open(path, missing_folders(path), Kind::Named),
            None => {
                let parent = Path::new(PARENT);
                let mut made = missing_folders(parent);
                let path = new_folder(parent, &utc_stamp(SystemTime::now()))
                    .map_err(|source| write_error(parent, source))?;
                made.insert(0, path.clone());
                Self::open(&path, made, Kind::New)
            }
        }
    }

    /// The folder of a killed run.
    pub fn of_recovery(path: &Path) -> Result<Self, ResultsError> {
        let mut made = missing_folders(path);
        if made.is_empty() && path.file_name().is_some_and(is_stamp) {
            // Made by the killed run.
            made.push(path.to_owned());
        }
        Self::open(path, made, Kind::Recovered)
    }

    fn open(path: &Path, made: Vec<PathBuf>, kind: Kind) -> Result<Self, ResultsError> {
        let mut folder = Self { path: path.to_owned(), made, kind, lock: None };
        let locking = fs::create_dir_all(path).and_then(|()| lock_output(path));
        match locking.map_err(|source| write_error(path, source))? {
            Locking::Locked(lock) => folder.lock = Some(lock),
            Locking::HeldBy(process) => {
                return Err(ResultsError::Held { folder: path.to_owned(), process });
            }
        }
        prepare_output(path)?;
        Ok(folder)
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Links [`LATEST`] to a folder that was made for the run, and to that of a recovered run unless a newer run has
    /// the link. Leaves a `latest` of the user's own alone.
    pub fn become_latest(&self) -> io::Result<()> {
        let (Some(parent), Some(name)) = (self.path.parent(), self.path.file_name()) else {
            return Ok(());
        };
        let latest = parent.join(LATEST);
        let is_link = fs::symlink_metadata(&latest).map_or(true, |found| found.is_symlink());
        let is_newest = || match fs::read_link(&latest) {
            // Names sort by time.
            Ok(newest) => newest.as_os_str() <= name || !latest.exists(),
            Err(_) => true,
        };
        let is_run = match self.kind {
            Kind::New => true,
            Kind::Named => false,
            Kind::Recovered => is_stamp(name) && is_newest(),
        };
        if !is_run || !is_link {
            return Ok(());
        }
        let temporary = parent.join(format!(".{LATEST}.{}", std::process::id()));
        drop(fs::remove_file(&temporary));
        symlink(name, &temporary)?;
        fs::rename(&temporary, &latest).inspect_err(|_| drop(fs::remove_file(&temporary)))
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        drop(self.lock.take());
        // This removes only empty folders.
        self.made.iter().for_each(|folder| drop(fs::remove_dir(folder)));
    }
}

/// The folders that must be made for `folder`, itself first.
fn missing_folders(folder: &Path) -> Vec<PathBuf> {
    let named = |path: &&Path| !path.as_os_str().is_empty();
    let missing = folder.ancestors().take_while(named).take_while(|path| !path.exists());
    missing.map(Path::to_owned).collect()
}

/// Whether a folder has a name as [`new_folder`] gives it.
fn is_stamp(name: &OsStr) -> bool {
    const FORM: &[u8] = b"0000-00-00T00-00-00Z";
    let fits = |(byte, form): (&u8, &u8)| match form {
        b'0' => byte.is_ascii_digit(),
        form => byte == form,
    };
    let bytes = name.as_encoded_bytes();
    bytes.len() >= FORM.len() && bytes.iter().zip(FORM).all(fits)
}

/// Makes the folder if it is missing, checks that it can be written and holds no user file that results would replace,
/// and completes what a killed process left half done.
pub fn prepare_output(folder: &Path) -> Result<(), ResultsError> {
    let attempt = || {
        fs::create_dir_all(folder)?;
        write_probe(folder)?;
        finish_commit(folder)?;
        foreign_file(folder)
    };
    match attempt().map_err(|source| write_error(folder, source))? {
        Some(file) => Err(ResultsError::Foreign(file)),
        None => Ok(()),
    }
}

fn write_error(path: &Path, source: io::Error) -> ResultsError {
    match path.is_file() {
        true => ResultsError::File(path.to_path_buf()),
        false => ResultsError::Write { path: path.to_path_buf(), source },
    }
}

/// Writes a page into an unnamed file, so that nothing of it can remain.
fn write_probe(folder: &Path) -> io::Result<()> {
    let flags = OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC;
    match rustix::fs::open(folder, flags, Mode::RUSR | Mode::WUSR) {
        Ok(file) => io::Write::write_all(&mut File::from(file), &[0; 4096]),
        // Some file systems (NFS, FUSE) cannot: there the file is unlinked at once.
        Err(rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::ISDIR | rustix::io::Errno::INVAL) => {
            let probe = folder.join(format!(".semidense-write-test.{}", std::process::id()));
            let mut file = File::create(&probe)?;
            fs::remove_file(&probe)?;
            io::Write::write_all(&mut file, &[0; 4096])
        }
        Err(error) => Err(error.into()),
    }
}

/// Makes `parent/stamp`, or `parent/stamp-2` and so on where that is taken.
fn new_folder(parent: &Path, stamp: &str) -> io::Result<PathBuf> {
    fs::create_dir_all(parent)?;
    let numbered = (2..=MAX_SAME_SECOND).map(|n| format!("{stamp}-{n}"));
    for name in std::iter::once(stamp.to_owned()).chain(numbered) {
        let path = parent.join(name);
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::ErrorKind::AlreadyExists.into())
}

/// `2026-11-22T03-15-00Z`: UTC, sorted by name, without a character that shells or Windows dislike.
pub fn utc_stamp(time: SystemTime) -> String {
    utc_text(time).replace(':', "-")
}

/// `2026-11-22T03:15:00Z`: UTC in the form of RFC 3339.
pub fn utc_text(time: SystemTime) -> String {
    const SECS_PER_DAY: u64 = 86_400;
    let secs = time.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let (days, of_day) = (secs / SECS_PER_DAY, secs % SECS_PER_DAY);
    let (year, month, day) = date_of(days);
    let (hour, minute, second) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Gregorian year, month and day from the days since 1970-01-01. Years are counted from March, so that the leap day is
/// the last of its year.
fn date_of(days: u64) -> (u64, u64, u64) {
    const DAYS_PER_ERA: u64 = 146_097; // 400 years
    const DAYS_BEFORE_EPOCH: u64 = 719_468; // from 0000-03-01
    let since_march = days + DAYS_BEFORE_EPOCH;
    let (era, of_era) = (since_march / DAYS_PER_ERA, since_march % DAYS_PER_ERA);
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * of_year + 2) / 153;
    let day = of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    (400 * era + year_of_era + u64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn stamps_are_dates() {
        for (secs, stamp) in [
            (0, "1970-01-01T00-00-00Z"),
            (951_782_399, "2000-02-28T23-59-59Z"),
            (951_782_400, "2000-02-29T00-00-00Z"),
            (1_795_317_300, "2026-11-22T03-15-00Z"),
            (4_107_542_400, "2100-03-01T00-00-00Z"),
        ] {
            assert_eq!(utc_stamp(UNIX_EPOCH + Duration::from_secs(secs)), stamp);
            assert!(is_stamp(OsStr::new(stamp)) && is_stamp(OsStr::new(&format!("{stamp}-2"))));
        }
        assert!(
            !is_stamp(OsStr::new("2026-11-22")) && !is_stamp(OsStr::new("my-old-recording-000"))
        );
        let time = UNIX_EPOCH + Duration::from_secs(1_795_317_300);
        assert_eq!(utc_text(time), "2026-11-22T03:15:00Z");
    }

    #[test]
    fn a_made_folder_is_locked_and_removed_if_it_stays_empty() {
        let root = tempfile::tempdir().unwrap();
        let outer = root.path().join("a");
        let inner = outer.join("b/c");
        let stamped = root.path().join("2026-11-22T03-15-00Z");
        fs::create_dir(&stamped).unwrap();
        drop(OutputFolder::of_recovery(&stamped).unwrap());
        assert!(!stamped.exists(), "the run that was killed had made it");
        let folder = OutputFolder::prepare(Some(&inner)).unwrap();
        let error = OutputFolder::prepare(Some(&inner)).unwrap_err().to_string();
        let held = format!("process {}", std::process::id());
        assert!(error.contains(&held) && error.contains("--output"), "{error}");
        assert!(inner.exists(), "the refused one removes nothing");
        drop(folder);
        assert!(!outer.exists() && root.path().exists());
        fs::create_dir(&outer).unwrap();
        drop(OutputFolder::prepare(Some(&outer)).unwrap());
        assert!(outer.exists(), "it is the user's");
    }

    #[test]
    fn a_recovered_run_gets_the_link_unless_a_newer_run_has_it() {
        let root = tempfile::tempdir().unwrap();
        let latest = root.path().join(LATEST);
        let recover = |name: &str| {
            let path = root.path().join(name);
            fs::create_dir_all(&path).unwrap();
            fs::write(path.join("x"), "x").unwrap();
            OutputFolder::of_recovery(&path).unwrap().become_latest().unwrap();
            fs::read_link(&latest).ok()
        };
        assert_eq!(recover("mine"), None);
        let [old, new] = ["2026-11-22T03-15-00Z", "2026-11-22T03-15-07Z"];
        assert_eq!(recover(old), Some(old.into()));
        assert_eq!(recover(new), Some(new.into()));
        assert_eq!(recover(old), Some(new.into()));
        fs::remove_dir_all(root.path().join(new)).unwrap();
        assert_eq!(recover(old), Some(old.into()), "the link led nowhere");
    }

    #[test]
    fn runs_of_the_same_second_have_separate_folders() {
        let folder = tempfile::tempdir().unwrap();
        let parent = folder.path().join("output");
        let make = || new_folder(&parent, "2026-11-22T03-15-00Z").unwrap();
        let threads: Vec<_> = std::thread::scope(|scope| {
            let all: Vec<_> = (0..8).map(|_| scope.spawn(make)).collect();
            all.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        let mut names = threads;
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 8);
    }

    #[test]
    fn the_link_follows_and_an_empty_folder_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let make = |stamp| {
            let path = new_folder(folder.path(), stamp).unwrap();
            fs::write(path.join("x"), "x").unwrap();
            OutputFolder { path: path.clone(), made: vec![path], kind: Kind::New, lock: None }
        };
        let link = folder.path().join(LATEST);
        for stamp in ["1", "2"] {
            let output = make(stamp);
            output.become_latest().unwrap();
            assert_eq!(fs::read_link(&link).unwrap(), Path::new(stamp));
        }
        let empty = make("3");
        fs::remove_file(empty.path().join("x")).unwrap();
        drop(empty);
        assert!(!folder.path().join("3").exists() && folder.path().join("2").exists());
        fs::remove_file(&link).unwrap();
        fs::create_dir(&link).unwrap();
        make("4").become_latest().unwrap();
        assert!(link.is_dir() && !link.is_symlink(), "it is the user's");
    }

    #[test]
    fn the_probe_leaves_nothing_and_a_user_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        prepare_output(folder.path()).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        fs::write(folder.path().join("map.ply"), "mine").unwrap();
        let error = prepare_output(folder.path()).unwrap_err().to_string();
        assert!(error.contains("map.ply") && error.contains("--output"), "{error}");
    }
}
