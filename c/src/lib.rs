//! semidense for C and C++: reads what a running instance puts into shared memory.
//!
//! # Rules
//! * `unsafe` stands in this crate only where a pointer of the caller is read or written, each time with its reason; the
//!   rest is safe Rust over the readers that every Rust program uses.
//! * A reader's handle is a number in the table of the thread that opened it (`table`), never an address: one that is
//!   closed, made up, or of another thread gives an error.
//! * No function panics across the boundary: a panic becomes `SEMIDENSE_ERROR_INTERNAL`.
//!
//! The header `include/semidense.h` is made from here: `cbindgen --config c/cbindgen.toml --crate semidense-c --output
//! c/include/semidense.h`; a test compares the two.

mod conversion;
mod exports;
mod reader;
mod status;
mod table;
mod types;
