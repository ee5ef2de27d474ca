//! Behaviour of tracker and mapper: accuracy and its figures, the start, loss and recovery, noise, bit-identical
//! results for any number of threads.

#[path = "../support/figures.rs"]
mod figures;
#[path = "../support/g2o.rs"]
mod g2o;
#[path = "../support/recordings.rs"]
mod recording;
#[allow(dead_code, reason = "the tests of processes use all of it")]
#[path = "../support/mod.rs"]
mod support;

mod accuracy;
mod camera_effects;
mod depth_modes;
mod determinism;
mod dim_light;
mod evaluation;
mod interval_filter;
mod keyframe_reuse;
mod map_correction;
mod map_surface;
mod mask;
mod observation_noise;
mod odometry;
mod pose_graphs;
mod propagation_noise;
mod recovery;
mod two_frame_start;
mod world_scale;
