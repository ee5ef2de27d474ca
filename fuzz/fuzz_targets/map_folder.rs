//! See `parsers::map_folder`.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| semidense_fuzz::parsers::map_folder(bytes));
