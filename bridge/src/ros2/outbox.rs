//! Messages that wait for the network: few, the newest of each kind, so that a slow `publish` holds nobody up.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::ros::converter::PoseMessages;
use crate::ros::message::{CameraInfo, DiagnosticArray, Image, PointCloud2, PoseArray};

/// Poses that may wait: a quarter of a second at 30 Hz, ten times the longest `publish` that was seen.
const MAX_POSES: usize = 8;
/// Reports that may wait: several of each process.
const MAX_DIAGNOSTICS: usize = 16;

/// Something to publish.
#[derive(Debug, Clone, PartialEq)]
pub enum Outgoing {
    /// A pose: in the map, odometry and transforms.
    Pose(Box<PoseMessages>),
    /// A report of a process.
    Diagnostics(Box<DiagnosticArray>),
    /// An image with its camera.
    Image(Box<(Image, CameraInfo)>),
    /// The depth of a keyframe.
    Points(Box<PointCloud2>),
    /// Poses of all keyframes.
    Keyframes(Box<PoseArray>),
}

/// Messages that were replaced by newer ones before they were published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Drops {
    /// Poses.
    pub poses: u64,
    /// Images.
    pub images: u64,
    /// Clouds.
    pub points: u64,
}

#[derive(Debug, Default)]
struct Waiting {
    poses: VecDeque<Box<PoseMessages>>,
    diagnostics: VecDeque<Box<DiagnosticArray>>,
    image: Option<Box<(Image, CameraInfo)>>,
    points: Option<Box<PointCloud2>>,
    keyframes: Option<Box<PoseArray>>,
    drops: Drops,
    is_closed: bool,
}

impl Waiting {
    /// What is most urgent.
    fn next(&mut self) -> Option<Outgoing> {
        if let Some(pose) = self.poses.pop_front() {
            return Some(Outgoing::Pose(pose));
        }
        if let Some(diagnostics) = self.diagnostics.pop_front() {
            return Some(Outgoing::Diagnostics(diagnostics));
        }
        self.image
            .take()
            .map(Outgoing::Image)
            .or_else(|| self.points.take().map(Outgoing::Points))
            .or_else(|| self.keyframes.take().map(Outgoing::Keyframes))
    }
}

/// Between the thread that reads and the one that publishes.
#[derive(Debug, Default)]
pub struct Outbox {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // Nothing is left half done under the lock.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a message; never waits. The oldest of its kind goes where there are too many.
    pub fn put(&self, message: Outgoing) {
        let mut waiting = self.lock();
        match message {
            Outgoing::Pose(pose) => {
                if waiting.poses.len() >= MAX_POSES {
                    waiting.poses.pop_front();
                    waiting.drops.poses += 1;
                }
                waiting.poses.push_back(pose);
            }
            Outgoing::Diagnostics(diagnostics) => {
                if waiting.diagnostics.len() >= MAX_DIAGNOSTICS {
                    waiting.diagnostics.pop_front();
                }
                waiting.diagnostics.push_back(diagnostics);
            }
            Outgoing::Image(image) => {
                let dropped = waiting.image.replace(image).is_some();
                waiting.drops.images += u64::from(dropped);
            }
            Outgoing::Points(points) => {
                let dropped = waiting.points.replace(points).is_some();
                waiting.drops.points += u64::from(dropped);
            }
            Outgoing::Keyframes(keyframes) => waiting.keyframes = Some(keyframes),
        }
        self.arrived.notify_one();
    }

    /// The most urgent message, waited for at most `longest`; `Err` once it is closed and empty.
    pub fn take(&self, longest: Duration) -> Result<Option<Outgoing>, Closed> {
        let mut waiting = self.lock();
        let mut next = waiting.next();
        if next.is_none() && !waiting.is_closed {
            let (woken, _) =
                self.arrived.wait_timeout(waiting, longest).unwrap_or_else(PoisonError::into_inner);
            waiting = woken;
            next = waiting.next();
        }
        if next.is_none() && waiting.is_closed { Err(Closed) } else { Ok(next) }
    }

    /// What was dropped so far.
    pub fn drops(&self) -> Drops {
        self.lock().drops
    }

    /// Nothing more comes.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.arrived.notify_all();
    }
}

/// Nothing more will come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Closed;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::message::{
        Header, Odometry, Pose, PoseWithCovariance, PoseWithCovarianceStamped, TfMessage, Time,
        Twist, TwistWithCovariance,
    };

    fn header(sec: i32) -> Header {
        Header { stamp: Time { sec, nanosec: 0 }, frame_id: String::new() }
    }

    fn pose(sec: i32) -> Outgoing {
        let pose = PoseWithCovariance { pose: Pose::default(), covariance: [0.0; 36] };
        let twist = TwistWithCovariance { twist: Twist::default(), covariance: [0.0; 36] };
        let odometry = Odometry {
            header: header(sec),
            child_frame_id: String::new(),
            pose: pose.clone(),
            twist,
        };
        Outgoing::Pose(Box::new(PoseMessages {
            pose: PoseWithCovarianceStamped { header: header(sec), pose },
            odometry,
            transforms: TfMessage { transforms: Vec::new() },
        }))
    }

    fn keyframes(sec: i32) -> Outgoing {
        Outgoing::Keyframes(Box::new(PoseArray { header: header(sec), poses: Vec::new() }))
    }

    #[test]
    fn the_newest_wins_poses_come_first_and_drops_are_counted() {
        let outbox = Outbox::default();
        outbox.put(keyframes(1));
        outbox.put(keyframes(2));
        (0..11).for_each(|sec| outbox.put(pose(sec)));
        for sec in 3..11 {
            assert_eq!(outbox.take(Duration::ZERO), Ok(Some(pose(sec))));
        }
        assert_eq!(outbox.take(Duration::ZERO), Ok(Some(keyframes(2))));
        assert_eq!(outbox.take(Duration::ZERO), Ok(None));
        assert_eq!(outbox.drops(), Drops { poses: 3, ..Drops::default() });
        outbox.put(pose(1));
        outbox.close();
        assert_eq!(outbox.take(Duration::from_secs(9)), Ok(Some(pose(1))));
        assert_eq!(outbox.take(Duration::from_secs(9)), Err(Closed));
    }
}
