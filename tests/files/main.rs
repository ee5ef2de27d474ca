//! Input and output files: recordings, damaged and wrong inputs, maps, results.

#[path = "../support/recordings.rs"]
mod recording;
#[path = "../support/records.rs"]
mod records;
#[allow(dead_code, reason = "the tests of processes use all of it")]
#[path = "../support/mod.rs"]
mod support;

#[path = "../../fuzz/parsers.rs"]
mod parsers;
#[path = "../../fuzz/seeds.rs"]
mod seeds;
#[path = "../../src/capture/test_bag.rs"]
mod test_bag;
#[path = "../../src/capture/test_images.rs"]
mod test_images;

mod bad_input;
mod damaged_images;
mod fuzz_findings;
mod map_files;
mod recordings;
mod rendered;
mod replay;
mod results;
mod untracked;
