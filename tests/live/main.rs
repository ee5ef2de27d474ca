//! The running processes: started, killed, stopped, starved, watched, and what they leave behind.

#[path = "../support/mod.rs"]
mod support;
#[path = "../support/waves.rs"]
mod waves;

mod cameras;
mod folders;
mod hostile_frames;
mod journal;
mod map_loading;
mod map_on_disk;
mod overload;
mod processes;
mod service_manager;
mod soak;
mod status;
mod supervision;
