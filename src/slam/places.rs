//! Place recognition: keyframes found by what they look like, not by where they are thought to be.
//!
//! [`Describer`] makes of an image a [`Description`]: corners at several scales (`scales`, `corners`) with an orientation
//! and a binary descriptor (`pattern`, `description`). [`PlaceIndex`] keeps the descriptors of all keyframes in a tree
//! that grows with them (`tree`), and ranks keyframes by how many features of an image they share in one arrangement
//! (`arrangement`). There is no vocabulary; an index is not kept on disk but made again of descriptions, which are kept, or images.

mod arrangement;
mod corners;
mod description;
mod index;
mod pattern;
mod scales;
mod tree;

pub use description::{Describer, Description, Feature, FeaturePlace, MAX_FEATURES};
pub use index::{PlaceCandidate, PlaceIndex};
