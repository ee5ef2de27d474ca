//! Frame ids (REP 105): `map`, `odom` and the camera's optical frame.

/// The frame ids of an instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameIds {
    /// The map: the best estimate of the camera's pose, which may step.
    pub map: String,
    /// Odometry: the camera moves without steps, but drifts.
    pub odom: String,
    /// The camera: x right, y down, z forward.
    pub camera: String,
}

impl FrameIds {
    /// The frame ids of an instance. Several instances share `map` and `odom`, whose origins differ, and only
    /// name their cameras differently; give each its own ids if they share one tree.
    pub fn of_instance(instance: &str) -> Self {
        Self {
            map: "map".to_owned(),
            odom: "odom".to_owned(),
            camera: format!("{instance}_optical_frame"),
        }
    }
}
