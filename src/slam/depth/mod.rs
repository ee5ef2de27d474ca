//! Inverse depth by small-baseline stereo, and the filters that keep it (Engel, Sturm, Cremers 2013).
//!
//! [`epipolar`] is the geometry between a keyframe and a frame, [`matching`] the search along an
//! epipolar segment, [`gaussian`] the semi-dense filter, [`propagation`] the step to a new keyframe,
//! [`regularisation`] the smoothing of the map.

pub mod epipolar;
pub mod gaussian;
pub mod map;
pub mod matching;
pub mod propagation;
pub mod regularisation;
