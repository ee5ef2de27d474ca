//! Process shells: clock, threads, scheduling, configuration, health, results; one loop a process.

pub mod atomic_file;
pub mod budget;
pub mod capture;
pub mod checkpoint;
pub mod child;
pub mod clock;
pub mod config;
pub mod doctor;
pub mod frame_order;
pub mod given_pose;
pub mod health;
pub mod latency_bench;
pub mod map_file;
pub mod mapper;
pub mod mode;
pub mod pairing;
pub mod peers;
pub mod recorder;
pub mod reference_feed;
pub mod replay;
pub mod results;
pub mod schedule;
pub mod shutdown;
pub mod supervisor;
pub mod tracker;
pub mod trajectory_file;
