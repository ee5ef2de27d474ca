//! Variance-normalised direct image alignment on SE(3) (Engel, Schöps, Cremers 2014, §3.3).
//!
//! [`mod@reference`] prepares a keyframe, [`residual`] evaluates the cost of one pose on one pyramid
//! level, `normal_equations` solves for a step, [`align`] iterates coarse to fine.

pub mod align;
mod damping;
pub mod displacement;
pub(crate) mod fusion;
mod kernel;
pub(crate) mod misfit;
#[cfg(test)]
mod mode_tests;
#[cfg(test)]
mod no_data_tests;
pub(crate) mod normal_equations;
mod params;
pub mod points;
pub mod reference;
pub mod residual;
pub mod scatter;
#[cfg(test)]
pub(crate) mod scene;
pub mod selection;
pub(crate) mod surroundings;
#[cfg(test)]
mod tests;
pub(crate) mod tiles;
pub(crate) mod unknown_depth;
pub mod weights;

pub use fusion::LevelPoint;
pub use misfit::TileMisfit;
pub use normal_equations::NormalEquations;
pub use tiles::TileSum;
