//! Place recognition: finds keyframes by their appearance, independently of their estimated poses.
//!
//! [`Describer`] turns an image into a [`Description`]: corners at several scales (`scales`, `corners`) with an
//! orientation and a binary descriptor (`pattern`, `description`). [`PlaceIndex`] keeps the descriptors of all
//! keyframes in a tree that grows with them (`tree`), and ranks keyframes by the features shared with an image in one
//! arrangement (`arrangement`). There is no vocabulary; the index is rebuilt from stored descriptions, or images.

mod arrangement;
mod corners;
mod description;
mod index;
mod pattern;
mod scales;
mod tree;

pub use description::{Describer, Description, Feature, FeaturePlace, MAX_FEATURES};
pub use index::{PlaceCandidate, PlaceIndex};
