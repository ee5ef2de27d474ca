//! The names of the frames (REP 105): `map`, `odom` and the camera's optical frame.

/// Names of the frames.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameIds {
    /// The map: the camera is where it is best known to be, which may step.
    pub map: String,
    /// Odometry: the camera moves without steps, and drifts.
    pub odom: String,
    /// The camera: x right, y down, z forward.
    pub camera: String,
}

impl FrameIds {
    /// Those of an instance: several have cameras of different names in the same `map` and `odom`, whose origins are
    /// not the same; give each its own where they share one tree.
    pub fn of_instance(instance: &str) -> Self {
        Self {
            map: "map".to_owned(),
            odom: "odom".to_owned(),
            camera: format!("{instance}_optical_frame"),
        }
    }
}
