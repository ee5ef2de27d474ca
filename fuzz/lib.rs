//! Fuzzing of everything that semidense reads. See README.md, "Development".

pub mod parsers;
pub mod seeds;
#[path = "../src/capture/test_bag.rs"]
mod test_bag;
#[path = "../src/capture/test_images.rs"]
mod test_images;
