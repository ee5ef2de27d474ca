//! Sources of frames: dataset readers, simulator, cameras. The only module that names image files and video devices.

pub(crate) mod bag;
#[cfg(test)]
mod conformance;
pub mod dataset_writer;
pub mod decode_error;
pub mod euroc;
mod foreign_rig;
pub(crate) mod frame_store;
pub mod image_file;
#[cfg(test)]
mod image_file_tests;
pub(crate) mod image_folder;
pub(crate) mod input_file;
pub(crate) mod jpeg_image;
pub(crate) mod listing;
pub(crate) mod looped;
pub mod mask;
pub mod opening;
pub mod png_image;
pub(crate) mod recording;
mod rectifier;
pub mod rig;
pub mod rig_error;
pub mod ros_image;
pub mod ros_topic;
pub mod sensor_yaml;
pub mod simulator;
pub mod source;
pub mod source_error;
pub mod source_name;
pub mod stream;
#[cfg(test)]
mod test_bag;
#[cfg(test)]
mod test_images;
pub mod tum;
pub mod v4l;

pub use recording::Recording;
