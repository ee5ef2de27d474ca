//! Messages queued for the network: few, the newest of each kind, so that a slow `publish` delays nothing else.

use crate::ros::converter::PoseMessages;
use crate::ros::message::{CameraInfo, DiagnosticArray, Image, PointCloud2, PoseArray};
use crate::slots::Slots;

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

/// Slots of the kinds of messages in the outbox, the most urgent first.
pub mod slot {
    /// Poses.
    pub const POSE: usize = 0;
    /// Reports.
    pub const DIAGNOSTICS: usize = 1;
    /// Images.
    pub const IMAGE: usize = 2;
    /// Clouds.
    pub const POINTS: usize = 3;
    /// Poses of all keyframes.
    pub const KEYFRAMES: usize = 4;
}

/// The queue between the reading and the publishing thread. It holds the poses of a quarter of a second at 30
/// Hz, ten times the longest `publish` observed; several reports of each process; else the newest message.
pub fn outbox() -> Slots<Outgoing> {
    Slots::new(&[8, 16, 1, 1, 1])
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::ros::message::{
        Header, Odometry, Pose, PoseWithCovariance, PoseWithCovarianceStamped, TfMessage, Time,
        Twist, TwistWithCovariance,
    };
    use crate::slots::Closed;

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
    fn the_newest_message_wins_poses_have_priority_and_drops_are_counted() {
        let outbox = outbox();
        outbox.put(slot::KEYFRAMES, keyframes(1));
        outbox.put(slot::KEYFRAMES, keyframes(2));
        (0..11).for_each(|sec| outbox.put(slot::POSE, pose(sec)));
        for sec in 3..11 {
            assert_eq!(outbox.take_within(Duration::ZERO), Ok(Some(pose(sec))));
        }
        assert_eq!(outbox.take_within(Duration::ZERO), Ok(Some(keyframes(2))));
        assert_eq!(outbox.take_within(Duration::ZERO), Ok(None));
        let drops = [slot::POSE, slot::IMAGE, slot::POINTS].map(|slot| outbox.dropped(slot));
        assert_eq!(drops, [3, 0, 0]);
        outbox.put(slot::POSE, pose(1));
        outbox.close();
        assert_eq!(outbox.take_within(Duration::from_secs(9)), Ok(Some(pose(1))));
        assert_eq!(outbox.take_within(Duration::from_secs(9)), Err(Closed));
    }
}
