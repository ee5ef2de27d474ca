//! Process shells: clock, threads, scheduling, configuration, health, results; one loop a process.

pub mod atomic_file;
pub mod given_pose;
pub mod replay;
pub mod results;
pub mod trajectory_file;
