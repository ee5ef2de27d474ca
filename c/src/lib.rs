//! semidense for C and C++: reads what a running instance publishes in shared memory.
//!
//! # Rules
//! * `unsafe` occurs in this crate only where a pointer from the caller is read or written, each time with
//!   its reason; the rest is safe Rust on top of the readers that every Rust program uses.
//! * A reader's handle is a number in the table of the thread that opened it (`table`), never an address: a
//!   handle that is closed, made up, or from another thread gives an error.
//! * No function panics across the boundary: a panic becomes `SEMIDENSE_STATUS_ERROR_INTERNAL`.
//!
//! The header `include/semidense.h` is generated from this crate: `cbindgen --config c/cbindgen.toml --crate
//! semidense-c --output c/include/semidense.h`; a test compares the two.

mod conversion;
mod exports;
mod reader;
mod status;
mod table;
mod types;
