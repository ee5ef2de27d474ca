//! Process shells: clock, threads, scheduling, configuration, health, results; one loop a process.

pub mod alignment_stamps;
pub mod atomic_file;
pub mod budget;
pub mod capture;
pub mod child;
pub mod clock;
pub mod config;
pub mod given_pose;
pub mod health;
pub mod map_file;
pub mod mapper;
pub mod mode;
pub mod pairing;
pub mod peers;
pub mod recorder;
pub mod reference_feed;
pub mod rehearsal;
pub mod replay;
pub mod results;
pub mod shutdown;
pub mod supervisor;
pub mod tracker;
pub mod trajectory_file;
