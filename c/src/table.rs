//! The open readers of a thread. A handle is a number that is never reused, not an address: it can be validated.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::reader::Reader;
use crate::status::{Failure, Status};

/// Numbers that cannot be addresses of objects, and are never reused.
static NEXT: AtomicUsize = AtomicUsize::new(1);

thread_local! {
    static READERS: RefCell<BTreeMap<usize, Reader>> = const { RefCell::new(BTreeMap::new()) };
}

/// The thread is ending, or an outer call is using the table.
fn unusable() -> Failure {
    Failure::new(Status::ErrorHandle, "the reader is in use by a call that has not returned")
}

fn unknown() -> Failure {
    Failure::new(
        Status::ErrorHandle,
        "this reader is not open in this thread: it is null, closed, or was opened by another thread",
    )
}

fn with_all<T>(
    act: impl FnOnce(&mut BTreeMap<usize, Reader>) -> Result<T, Failure>,
) -> Result<T, Failure> {
    READERS
        .try_with(|readers| act(&mut *readers.try_borrow_mut().map_err(|_| unusable())?))
        .map_err(|_| unusable())?
}

/// Stores a reader and returns its number.
pub fn insert(reader: Reader) -> Result<usize, Failure> {
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    with_all(|readers| Ok(readers.insert(number, reader)))?;
    Ok(number)
}

/// Calls `act` on the reader with this number.
pub fn with<T>(
    number: usize,
    act: impl FnOnce(&mut Reader) -> Result<T, Failure>,
) -> Result<T, Failure> {
    with_all(|readers| act(readers.get_mut(&number).ok_or_else(unknown)?))
}

/// Removes the reader with this number.
pub fn remove(number: usize) -> Result<Reader, Failure> {
    with_all(|readers| readers.remove(&number).ok_or_else(unknown))
}
