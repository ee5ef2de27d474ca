//! The pure part: images and poses in, poses and depth out. No I/O, clock, thread or log.
//!
//! [`tracker`] tracks a frame, [`mapper`] performs a map step; both build on [`geometry`], [`image`], [`alignment`] and
//! [`depth`].

pub mod alignment;
pub(crate) mod counted;
pub mod depth;
pub mod evaluation;
pub mod frame;
pub mod fusion;
pub mod geometry;
pub mod graph;
pub mod image;
pub(crate) mod image_motion;
pub mod kernel;
pub mod keyframe;
pub mod keyframe_pose_covariance;
pub mod loops;
pub mod map;
pub mod mapper;
pub mod modes;
pub mod odometry;
pub mod parameter;
pub mod places;
pub mod pose;
pub mod rolling_shutter;
#[cfg(test)]
pub mod test_scene;
pub mod tracker;
pub mod trajectory;
pub mod two_frame;
pub mod up;
pub(crate) mod upper_median;
pub mod vignette;
pub mod window;
