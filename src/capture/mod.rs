//! Frames in: dataset readers, simulator, cameras. The only place that names image files and v4l.

pub mod dataset_writer;
pub mod image_file;
pub mod jpeg_image;
pub mod listing;
pub mod png_image;
#[cfg(test)]
mod real_recordings;
pub mod recording;
pub mod rig;
pub mod simulator;
pub mod source;
pub mod tum;
