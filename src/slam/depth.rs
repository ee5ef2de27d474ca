//! Inverse depth by small-baseline stereo, and the filters that keep it (Engel, Sturm, Cremers 2013).
//!
//! [`epipolar`] is the geometry between a keyframe and a frame, [`matching`] the search along an epipolar segment,
//! [`pose_noise`] the covariance of a pose in pixels there, [`gaussian`] the semi-dense filter, [`propagation`] the
//! step to a new keyframe, [`regularisation`] the smoothing of the map. [`interval`] is the sparse filter on
//! [`immature`] points at the pixels that [`candidate`] chooses (Engel, Koltun, Cremers 2018).

pub mod candidate;
pub mod common_error;
pub mod epipolar;
pub(crate) mod expected_gain;
pub(crate) mod gain;
pub mod gaussian;
pub mod gradient_image;
pub mod hypotheses;
pub mod immature;
pub mod interval;
pub mod line_noise;
pub(crate) mod line_search;
pub mod map;
pub mod matching;
mod neighbour_sums;
mod patch_kernel;
pub(crate) mod pattern;
pub mod pose_noise;
pub mod propagation;
pub mod regularisation;
mod segment;
mod trace_kernel;

pub use gain::Uncertainty;
