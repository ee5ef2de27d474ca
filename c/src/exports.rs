//! The functions of the header.

use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use semidense::wire::place::Place;
use semidense::wire::topic::WIRE_VERSION;

use crate::reader::{Reader, open, wants};
use crate::status::{Failure, Status, last_error, remember};
use crate::table;
use crate::types::{Frame, Graph, Keyframe, Pose, Transform};

/// An open reader: closed by `semidense_close`, used only by the thread that opened it.
pub struct ReaderHandle {
    _private: (),
}

/// Runs a call: an error or a panic is kept for `semidense_last_error`.
fn call(act: impl FnOnce() -> Result<Status, Failure>) -> Status {
    let failure = match catch_unwind(AssertUnwindSafe(act)) {
        Ok(Ok(status)) => return status,
        Ok(Err(failure)) => failure,
        Err(_) => Failure::new(
            Status::ErrorInternal,
            "a bug in libsemidense: please report it with the message on standard error",
        ),
    };
    // Return a status even if the message cannot be kept.
    let _ = catch_unwind(AssertUnwindSafe(|| remember(&failure.message)));
    failure.status
}

fn invalid_argument(what: &str) -> Failure {
    Failure::new(Status::ErrorArgument, what)
}

fn number(handle: *const ReaderHandle) -> usize {
    handle.addr()
}

/// A text from the caller; `None` for null.
///
/// # Safety
/// `text` is null or a zero-terminated string.
unsafe fn text<'a>(text: *const c_char, name: &str) -> Result<Option<&'a str>, Failure> {
    if text.is_null() {
        return Ok(None);
    }
    // SAFETY: it is not null, and the caller promises the zero at its end.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(Some).map_err(|_| invalid_argument(&format!("{name} is not UTF-8")))
}

/// Checks that `out` can be written to.
fn check_out<T>(out: *mut T, name: &str) -> Result<(), Failure> {
    if out.is_null() {
        return Err(invalid_argument(&format!("{name} is null")));
    }
    if !out.is_aligned() {
        return Err(invalid_argument(&format!("{name} is not aligned for its type")));
    }
    Ok(())
}

/// Calls `ask` on a reader and writes the result to `out`.
///
/// # Safety
/// `out` is null or valid for writes.
unsafe fn write_next<T>(
    reader: *mut ReaderHandle,
    out: *mut T,
    ask: impl FnOnce(&mut Reader) -> Result<Option<T>, Failure>,
) -> Status {
    call(|| {
        check_out(out, "the structure to write to")?;
        let (value, nothing) =
            table::with(number(reader), |reader| Ok((ask(reader)?, reader.empty_status())))?;
        let Some(value) = value else { return Ok(nothing) };
        // SAFETY: neither null nor misaligned, and the caller promises that it may be written to.
        unsafe { out.write(value) };
        Ok(Status::Ok)
    })
}

/// The answer of a reader; `otherwise` after an error.
fn ask<T>(reader: *const ReaderHandle, otherwise: T, ask: impl FnOnce(&Reader) -> T) -> T {
    let mut answer = otherwise;
    call(|| {
        answer = table::with(number(reader), |reader| Ok(ask(reader)))?;
        Ok(Status::Ok)
    });
    answer
}

/// Waits for an instance and joins it.
///
/// `instance`: its name, null for "semidense". `root`: its folder, null for the default (SEMIDENSE_ROOT and so on).
/// `wanted`: the sum of the SEMIDENSE_WANT_… to read. `timeout_ms`: how long to wait for the instance, -1 forever, 0
/// if it must be running already. `reader` receives the reader; it is null after an error.
///
/// Returns SEMIDENSE_STATUS_OK, or SEMIDENSE_STATUS_ERROR_NOT_RUNNING, …_WIRE_VERSION, …_TRANSPORT, …_ARGUMENT.
///
/// # Safety
/// Texts are null or zero-terminated; `reader` is null or valid for writes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_open(
    instance: *const c_char,
    root: *const c_char,
    wanted: u32,
    timeout_ms: i64,
    reader: *mut *mut ReaderHandle,
) -> Status {
    call(|| {
        check_out(reader, "reader")?;
        // SAFETY: neither null nor misaligned, and the caller promises that it may be written to.
        unsafe { reader.write(std::ptr::null_mut()) };
        // SAFETY: the caller promises that texts are null or end with a zero.
        let (instance, root) = unsafe { (text(instance, "instance")?, text(root, "root")?) };
        let known = wants::POSES | wants::FRAMES | wants::KEYFRAMES | wants::GRAPH;
        if wanted == 0 || wanted & !known != 0 {
            return Err(invalid_argument("wanted is not a sum of SEMIDENSE_WANT_…"));
        }
        let place = Place::new(instance.unwrap_or("semidense"), root.unwrap_or(""))
            .map_err(|error| invalid_argument(&error.to_string()))?;
        let opened = open(&place, wanted, duration(timeout_ms))?;
        let handle = std::ptr::without_provenance_mut(table::insert(opened)?);
        // SAFETY: as above.
        unsafe { reader.write(handle) };
        Ok(Status::Ok)
    })
}

/// Converts milliseconds; `None`, for no limit, if negative.
fn duration(milliseconds: i64) -> Option<Duration> {
    u64::try_from(milliseconds).ok().map(Duration::from_millis)
}

/// Leaves the instance and invalidates everything the reader has returned. Does nothing for null.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_close(reader: *mut ReaderHandle) -> Status {
    call(|| {
        if !reader.is_null() {
            drop(table::remove(number(reader))?);
        }
        Ok(Status::Ok)
    })
}

/// A file descriptor for poll, select and epoll, or -1 after an error: when it is readable, call `semidense_wait` with
/// a timeout of 0, then read until SEMIDENSE_STATUS_NONE. It belongs to the reader: do not read from it or close it.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_descriptor(reader: *const ReaderHandle) -> c_int {
    ask(reader, -1, |reader| reader.descriptor())
}

/// Waits for messages for at most `timeout_ms` (-1: forever).
///
/// Returns SEMIDENSE_STATUS_OK if there may be something to read: read each kind until SEMIDENSE_STATUS_NONE;
/// SEMIDENSE_STATUS_NONE after the timeout; SEMIDENSE_STATUS_ENDED once the run is over and everything has
/// been read: close the reader, and open another for the next run.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_wait(reader: *mut ReaderHandle, timeout_ms: i64) -> Status {
    call(|| table::with(number(reader), |reader| reader.wait(duration(timeout_ms))))
}

/// Reads the oldest unread pose: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. 900 are kept.
///
/// # Safety
/// `pose` is null or valid for writes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_next_pose(reader: *mut ReaderHandle, pose: *mut Pose) -> Status {
    // SAFETY: the caller's promise.
    unsafe { write_next(reader, pose, Reader::next_pose) }
}

/// Reads the newest frame, if unread: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The previous frame becomes
/// invalid, whatever is returned.
///
/// # Safety
/// `frame` is null or valid for writes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_newest_frame(
    reader: *mut ReaderHandle,
    frame: *mut Frame,
) -> Status {
    // SAFETY: the caller's promise.
    unsafe { write_next(reader, frame, Reader::newest_frame) }
}

/// Reads the newest keyframe or revision of its depth, if unread: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The
/// previous one becomes invalid, whatever is returned. A late reader receives the active keyframe.
///
/// # Safety
/// `keyframe` is null or valid for writes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_newest_keyframe(
    reader: *mut ReaderHandle,
    keyframe: *mut Keyframe,
) -> Status {
    // SAFETY: the caller's promise.
    unsafe { write_next(reader, keyframe, Reader::newest_keyframe) }
}

/// Reads the poses of all keyframes, if they have changed: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The
/// previous ones are valid until the next SEMIDENSE_STATUS_OK.
///
/// # Safety
/// `graph` is null or valid for writes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_newest_graph(
    reader: *mut ReaderHandle,
    graph: *mut Graph,
) -> Status {
    // SAFETY: the caller's promise.
    unsafe { write_next(reader, graph, Reader::newest_graph) }
}

/// Number of messages refused because they are malformed; 0 after an error.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_refused(reader: *const ReaderHandle) -> u64 {
    ask(reader, 0, |reader| reader.refused)
}

/// Writes a transform as a 4×4 matrix, row by row; its rotation is multiplied by the scale.
///
/// # Safety
/// `transform` is null or points to one; `matrix` is null or has room for 16 numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn semidense_matrix(transform: *const Transform, matrix: *mut f64) -> Status {
    call(|| {
        check_out(transform.cast_mut(), "transform")?;
        check_out(matrix, "matrix")?;
        // SAFETY: neither null nor misaligned, and the caller promises that it is one.
        let Transform { quaternion: [x, y, z, w], translation: t, scale: s } =
            unsafe { transform.read() };
        let rows = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let mut values = [0.0; 16];
        for (row, (rotation, translation)) in rows.iter().zip(t).enumerate() {
            for (column, entry) in rotation.iter().enumerate() {
                values[4 * row + column] = s * entry;
            }
            values[4 * row + 3] = translation;
        }
        values[15] = 1.0;
        // SAFETY: neither null nor misaligned, and the caller promises room for 16 numbers.
        unsafe { matrix.cast::<[f64; 16]>().write(values) };
        Ok(Status::Ok)
    })
}

/// Describes the last failed call of this thread: what, where, what to do. Never null; valid until the
/// thread's next failure.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_last_error() -> *const c_char {
    last_error()
}

/// The version of this library, as in "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn semidense_version() -> *const c_char {
    const VERSION: &CStr =
        match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
            Ok(version) => version,
            Err(_) => c"",
        };
    VERSION.as_ptr()
}

/// The version of the messages that this library reads; it must equal that of the pipeline.
#[unsafe(no_mangle)]
pub extern "C" fn semidense_wire_version() -> u32 {
    WIRE_VERSION
}

/// The name of a status, as in "SEMIDENSE_STATUS_OK".
#[unsafe(no_mangle)]
pub extern "C" fn semidense_status_name(status: c_int) -> *const c_char {
    let name = [
        (Status::Ok, c"SEMIDENSE_STATUS_OK"),
        (Status::None, c"SEMIDENSE_STATUS_NONE"),
        (Status::Ended, c"SEMIDENSE_STATUS_ENDED"),
        (Status::ErrorArgument, c"SEMIDENSE_STATUS_ERROR_ARGUMENT"),
        (Status::ErrorHandle, c"SEMIDENSE_STATUS_ERROR_HANDLE"),
        (Status::ErrorNotRunning, c"SEMIDENSE_STATUS_ERROR_NOT_RUNNING"),
        (Status::ErrorWireVersion, c"SEMIDENSE_STATUS_ERROR_WIRE_VERSION"),
        (Status::ErrorTransport, c"SEMIDENSE_STATUS_ERROR_TRANSPORT"),
        (Status::ErrorNotWanted, c"SEMIDENSE_STATUS_ERROR_NOT_WANTED"),
        (Status::ErrorInternal, c"SEMIDENSE_STATUS_ERROR_INTERNAL"),
    ]
    .into_iter()
    .find(|(known, _)| *known as c_int == status);
    name.map_or(c"unknown status", |(_, name)| name).as_ptr()
}
