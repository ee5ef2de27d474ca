//! Real-time semi-dense direct visual SLAM for robot computers.
//!
//! # Three ways to use it
//!
//! **The algorithm, in your own program.** Images in, poses and a map out, on your thread; none of the default features
//! is needed. See [`Odometry`]:
//!
//! ```
//! use semidense::{FrameView, Intrinsics, Odometry, OdometryParams};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let camera = Intrinsics { fx: 262.0, fy: 262.0, cx: 159.5, cy: 119.5, width: 320, height: 240 };
//! let mut odometry = Odometry::new(camera, OdometryParams::default())?;
//! # let image = vec![100; 320 * 240];
//! let pose = odometry.push(&FrameView::new(&camera, 0, 0, &image));
//! println!("{:?}: {}", pose.state, pose.world_from_camera.translation);
//! # Ok(())
//! # }
//! ```
//!
//! **The topics of a running instance**, from any process of the same user: [`reader`] (feature `service`).
//!
//! **The program itself**, `semidense run`, `replay` and the processes that systemd starts: [`command`] is its command
//! line, one short file per subcommand, and [`service`] the processes behind it (feature `service`).
//!
//! # Layout
//!
//! Dependencies point one way: [`command`] → [`service`] → [`slam`], [`wire`], [`capture`].
//! * [`slam`] is pure: images and poses in, poses and depth out; no clock, thread, I/O or log.
//! * [`capture`] provides the frames: dataset readers, the simulator, cameras.
//! * [`wire`] is the shared memory between the processes and the only module that names iceoryx2; [`reader`] reads it.
//! * [`service`] holds the process shells: clock, threads, configuration, health, results.
//! * [`command`] is the command line.
//!
//! # Features
//!
//! | feature | contents | default |
//! |---|---|---|
//! | `service` | processes, topics, results, the program; needs `cameras` | yes |
//! | `cameras` | sources of frames: cameras, recordings, the simulator | yes |
//!
//! Without them (`default-features = false`) the algorithm needs only nalgebra, rayon, serde and thiserror.

#[cfg(feature = "cameras")]
pub mod capture;
#[cfg(feature = "service")]
pub mod command;
#[cfg(feature = "service")]
pub mod service;
pub mod slam;
#[cfg(feature = "service")]
pub mod wire;

#[cfg(feature = "service")]
pub use service::reader;
pub use slam::frame::FrameView;
pub use slam::geometry::intrinsics::Intrinsics;
pub use slam::odometry::{Odometry, OdometryError, OdometryParams};
