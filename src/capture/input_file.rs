//! Files and folders named by a user. Only regular files of bounded size are read, and opening one never waits.

use std::fs::{File, FileType, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Reads the regular file at `path` into `bytes`, replacing its content. A file larger than `max_bytes`, or anything
/// but a regular file, is an error that says so.
pub fn read_into(path: &Path, max_bytes: u64, bytes: &mut Vec<u8>) -> io::Result<()> {
    bytes.clear();
    // One byte more than allowed reveals a file that is too large, even one that grows.
    let length = open(path)?.take(max_bytes.saturating_add(1)).read_to_end(bytes)? as u64;
    if length > max_bytes {
        bytes.clear();
        return Err(io::Error::other(format!(
            "it is larger than the limit of {} MB",
            max_bytes.div_ceil(1 << 20)
        )));
    }
    Ok(())
}

/// Reads the regular file at `path`, of at most `max_bytes`, as UTF-8 text.
pub fn read_text(path: &Path, max_bytes: u64) -> io::Result<String> {
    let mut bytes = Vec::new();
    read_into(path, max_bytes, &mut bytes)?;
    String::from_utf8(bytes).map_err(|error| {
        let valid = error.utf8_error().valid_up_to();
        let line = error.as_bytes()[..valid].iter().filter(|&&byte| byte == b'\n').count() + 1;
        io::Error::other(format!("it is not text: line {line} holds bytes that are not UTF-8"))
    })
}

/// Entries of a folder, sorted by name; empty if it cannot be read.
pub fn entries(folder: &Path) -> Vec<PathBuf> {
    let found = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = found.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// Whether a file has one of these extensions, in any case.
pub fn has_ending(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().unwrap_or_default();
    endings.iter().any(|known| ending.eq_ignore_ascii_case(known))
}

/// Opens the regular file at `path` for reading.
pub fn open(path: &Path) -> io::Result<File> {
    // Checked before opening, for a clear error: a socket cannot be opened at all, and opening a pipe could take it
    // from its intended reader.
    check(std::fs::metadata(path)?.file_type())?;
    // And after opening, in case the file was replaced in between; opening a pipe would wait for its writer.
    let file =
        OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path)?;
    check(file.metadata()?.file_type())?;
    Ok(file)
}

/// Refuses anything but a regular file, and names its kind.
fn check(kind: FileType) -> io::Result<()> {
    if kind.is_file() {
        return Ok(());
    }
    let kinds = [
        (kind.is_dir(), "a folder"),
        (kind.is_fifo(), "a named pipe"),
        (kind.is_socket(), "a socket"),
        (kind.is_char_device() || kind.is_block_device(), "a device"),
    ];
    let name = kinds.iter().find(|(is_it, _)| *is_it).map_or("something else", |(_, name)| name);
    Err(io::Error::other(format!("it is {name}, not a regular file")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(path: &Path) -> String {
        read_into(path, 10, &mut Vec::new()).unwrap_err().to_string()
    }

    #[test]
    fn only_regular_files_of_bounded_size_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        std::fs::write(place("ten"), [7; 10]).unwrap();
        std::fs::write(place("eleven"), [7; 11]).unwrap();
        std::fs::write(place("latin"), b"ab\nc\xe9\n").unwrap();
        let mut bytes = vec![1, 2, 3];
        read_into(&place("ten"), 10, &mut bytes).unwrap();
        assert_eq!(bytes, [7; 10]);
        assert!(message(&place("eleven")).contains("larger than"));
        assert!(message(folder.path()).contains("a folder"));
        assert!(message(Path::new("/dev/zero")).contains("a device"));
        assert!(message(&place("none")).contains("No such file"));
        let _socket = std::os::unix::net::UnixListener::bind(place("socket")).unwrap();
        assert!(message(&place("socket")).contains("a socket"));
        let error = read_text(&place("latin"), 10).unwrap_err().to_string();
        assert!(error.contains("line 2"), "{error}");
    }

    #[test]
    fn a_pipe_without_writer_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        assert!(message(&pipe).contains("a named pipe"));
    }
}
