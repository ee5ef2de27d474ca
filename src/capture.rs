//! Frames in: dataset readers, simulator, cameras. The only place that names image files and video devices.

pub mod bag;
#[cfg(test)]
mod conformance;
pub mod dataset_writer;
pub mod decode_error;
pub mod euroc;
pub mod frame_store;
pub mod image_file;
#[cfg(test)]
mod image_file_tests;
pub mod image_folder;
pub mod input_file;
pub mod jpeg_image;
pub mod listing;
pub mod looped;
pub mod opening;
pub mod png_image;
pub mod recording;
pub mod rig;
pub mod rig_error;
pub mod ros_image;
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
