//! Frames in: dataset readers, simulator, cameras. The only place that names image files and v4l.

pub mod simulator;
pub mod source;
