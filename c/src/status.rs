//! Statuses of calls, and messages about failures.

use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char};

/// Outcome of a call: 0 and above are not errors.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Done.
    Ok = 0,
    /// Nothing new: everything has been read, or the timeout has passed.
    None = 1,
    /// The run has ended and everything has been read: close the reader.
    Ended = 2,
    /// A pointer is null or misaligned, a text is not UTF-8, or a number is out of range.
    ErrorArgument = -1,
    /// The reader is closed, or was opened by another thread.
    ErrorHandle = -2,
    /// No instance of this name is running here.
    ErrorNotRunning = -3,
    /// The instance uses another wire version than this library.
    ErrorWireVersion = -4,
    /// Shared memory cannot be used: it belongs to another user, is full, or a limit is reached.
    ErrorTransport = -5,
    /// The reader was not opened for this kind of message.
    ErrorNotWanted = -6,
    /// A defect of this library.
    ErrorInternal = -7,
}

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// The kind of failure.
    pub status: Status,
    /// What, where, what to do.
    pub message: String,
}

impl Failure {
    /// A failure of this kind.
    pub fn new(status: Status, message: impl Into<String>) -> Self {
        Self { status, message: message.into() }
    }
}

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::new(CString::default());
}

/// Keeps the message for [`last_error`].
pub fn remember(message: &str) {
    let text: Vec<u8> = message.bytes().filter(|&byte| byte != 0).collect();
    // Without zeros it always converts.
    let text = CString::new(text).unwrap_or_default();
    // The storage of an ending thread is gone.
    let _ = LAST_ERROR.try_with(|last| last.try_borrow_mut().map(|mut last| *last = text));
}

/// The message of this thread's last failure; empty before the first.
pub fn last_error() -> *const c_char {
    const NOTHING: &CStr = c"";
    let message = LAST_ERROR.try_with(|last| last.try_borrow().map(|text| text.as_ptr()));
    message.ok().and_then(Result::ok).unwrap_or(NOTHING.as_ptr())
}
