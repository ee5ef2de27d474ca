//! Real-time semi-dense direct visual SLAM for robot computers.
//!
//! # Layout
//! Imports run down: `command` → `service` → `slam`, `wire`, `capture`.
//! * [`slam`] is pure: images and poses in, poses and depth out; no clock, thread, I/O or log.
//! * [`capture`] brings frames in: dataset readers, the simulator, cameras.
//! * [`wire`] is shared memory: the only place that names iceoryx2.
//! * [`service`] is the process shells: clock, threads, configuration, health, results.
//! * [`command`] is the command line: one short file a subcommand.

pub mod capture;
pub mod command;
pub mod service;
pub mod slam;
pub mod wire;
