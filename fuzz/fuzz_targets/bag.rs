//! See `parsers::bag`.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| semidense_fuzz::parsers::bag(bytes));
