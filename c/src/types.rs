//! The structures of the header, laid out as in C.
//!
//! Frames: the camera looks along z, x is right and y is down. `a_from_b` maps points of b into a. Lengths
//! are in map units, or in those of the keyframe where stated. Matrices are row by row.

/// Tracking status of a frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum State {
    /// There is no reliable map and no pose yet: do not use it.
    #[default]
    Initializing = 0,
    /// The pose is accurate to its covariance.
    Tracking = 1,
    /// The pose is usable, but less accurate than usual: see the reason.
    Degraded = 2,
    /// The pose is not claimed: see the reason.
    Lost = 3,
}

/// Why a pose is degraded or lost.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Reason {
    /// Neither degraded nor lost.
    #[default]
    None = 0,
    /// Degraded: the deadline passed before the finest level was solved.
    Budget = 1,
    /// Degraded: few of the keyframe's points are in view.
    LowOverlap = 2,
    /// Degraded: the residuals are larger than noise and depth variance explain.
    HighResidual = 3,
    /// Degraded: frames are missing between this one and the previous one.
    Gap = 4,
    /// Degraded: the known depth is out of view; the rotation is valid, the position is held.
    Turning = 5,
    /// Lost: the iteration left the image or became non-finite.
    Diverged = 6,
    /// Lost: too few of the points match.
    TooFewInliers = 7,
    /// Lost: the keyframe has no usable points.
    NoPoints = 8,
    /// Lost: the frame differs in size from the keyframe, or has no contrast at all.
    UnusableFrame = 9,
    /// Lost: the mapper found the map inconsistent.
    MapRejected = 10,
}

/// `x' = scale · R x + t`; the scale of a rigid transform is 1.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Transform {
    /// Rotation as a unit quaternion: x, y, z, w.
    pub quaternion: [f64; 4],
    /// Translation.
    pub translation: [f64; 3],
    /// Scale.
    pub scale: f64,
}

/// The pose of one frame; every frame has one, even when the camera is lost.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Number of the frame at its source; a gap is a missing frame.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
    pub capture_nanos: i64,
    /// CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 if unknown.
    pub realtime_nanos: i64,
    /// CLOCK_MONOTONIC when the pose was published.
    pub published_nanos: i64,
    /// Time from the frame to the publication of its pose.
    pub latency_nanos: u64,
    /// Keyframe it was tracked on; all ones before the first.
    pub keyframe_id: u64,
    /// Revision of that keyframe.
    pub keyframe_revision: u64,
    /// Number of corrections of the map: `map_from_camera` may jump when it increases.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Tracking status.
    pub state: State,
    /// Why it is degraded or lost.
    pub reason: Reason,
    /// 1 if the velocities are known, else 0.
    pub has_velocity: u32,
    /// Odometry: never jumps within an epoch, but drifts.
    pub world_from_camera: Transform,
    /// The best estimate in the map; jumps when the map is corrected.
    pub map_from_camera: Transform,
    /// Relative to the keyframe, keyframe units.
    pub keyframe_from_camera: Transform,
    /// 6×6 covariance of the left increment (translation, rotation) of camera_from_keyframe, keyframe units and rad.
    pub covariance: [f64; 36],
    /// 6×6 covariance of the left increment (translation, rotation) of `map_from_camera`, map units and rad.
    pub map_covariance: [f64; 36],
    /// Linear velocity of the camera in its own axes, world units per second.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the camera in its own axes, radians per second.
    pub angular_velocity: [f64; 3],
    /// 6×6 covariance of the velocity (linear, angular).
    pub velocity_covariance: [f64; 36],
    /// a, b of `I_camera ≈ eᵃ I_keyframe + b`, grey levels.
    pub brightness: [f64; 2],
    /// Share of the keyframe's points in view, 0 to 1.
    pub in_view_ratio: f64,
    /// Share of the compared points that are inliers, 0 to 1.
    pub inlier_ratio: f64,
    /// Root mean square residual, grey levels.
    pub residual_rmse: f64,
}

/// A camera without distortion: images are rectified. Integer coordinates are the centres of pixels.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Intrinsics {
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
}

/// An image of the camera; its pixels are in shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Number of the frame at its source, as in its pose.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds.
    pub capture_nanos: i64,
    /// CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 if unknown.
    pub realtime_nanos: i64,
    /// Exposure time, nanoseconds, 0 if unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 if unknown.
    pub gain: f32,
    /// Pixels in a row; rows are contiguous.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Intrinsics of the rectified image.
    pub intrinsics: Intrinsics,
    /// Grey, `width * height` bytes. Valid until the next `semidense_newest_frame` on this reader, or its end.
    pub pixels: *const u8,
}

/// One pixel with depth.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DepthPoint {
    /// Column of the pixel.
    pub u: u16,
    /// Row of the pixel.
    pub v: u16,
    /// 1/z along the optical axis, 1/keyframe units; 0 or less: infinitely far.
    pub inverse_depth: f32,
    /// Variance of the inverse depth.
    pub variance: f32,
    /// Brightness of the pixel, 0 to 255.
    pub intensity: f32,
}

/// A frame with depth; points and image are in shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Its id, as in poses and the graph.
    pub keyframe_id: u64,
    /// Incremented with every change of the map: the same keyframe is sent again with refined depth.
    pub revision: u64,
    /// Number of its frame.
    pub sequence: u64,
    /// Stamp of its frame, nanoseconds.
    pub capture_nanos: i64,
    /// Number of corrections of the map by then.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Pixels in a row of its image.
    pub width: u32,
    /// Rows of its image.
    pub height: u32,
    /// Points with depth.
    pub num_points: u32,
    /// Intrinsics of its image.
    pub intrinsics: Intrinsics,
    /// Pose in the odometry world; the scale is its unit.
    pub world_from_keyframe: Transform,
    /// Pose in the map; the scale is its unit.
    pub map_from_keyframe: Transform,
    /// Array of `num_points`. Valid until the next `semidense_newest_keyframe` on this reader, or its end.
    pub points: *const DepthPoint,
    /// Grey, `width * height` bytes. Valid for as long as `points`.
    pub image: *const u8,
}

/// The pose of a keyframe in the map.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Pose in the map; the scale is its unit.
    pub map_from_keyframe: Transform,
}

/// The poses of all keyframes in the map.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Graph {
    /// Newest revision of a keyframe in the graph.
    pub revision: u64,
    /// Number of corrections of the map.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Number of keyframes.
    pub num_keyframes: u32,
    /// Array of `num_keyframes`. Valid until the next `semidense_newest_graph` on this reader, or its end.
    pub keyframes: *const KeyframePose,
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;
    use std::mem::offset_of;
    use std::process::Command;

    use super::*;

    /// Assertions in C that check the header's structure against ours.
    macro_rules! asserts {
        ($text:ident, $kind:ty, $name:literal, [$($field:ident),* $(,)?]) => {
            writeln!($text, "_Static_assert(sizeof({}) == {}, \"size of {}\");", $name, size_of::<$kind>(), $name).unwrap();
            $(writeln!($text, "_Static_assert(offsetof({}, {}) == {}, \"{}.{}\");", $name, stringify!($field),
                offset_of!($kind, $field), $name, stringify!($field)).unwrap();)*
        };
    }

    #[test]
    fn the_header_has_the_layout_of_our_structures() {
        let mut text = "#include <stddef.h>\n#include <semidense.h>\n".to_owned();
        asserts!(text, Transform, "semidense_transform", [quaternion, translation, scale]);
        asserts!(
            text,
            Pose,
            "semidense_pose",
            [
                sequence,
                capture_nanos,
                realtime_nanos,
                published_nanos,
                latency_nanos,
                keyframe_id,
                keyframe_revision,
                map_revision,
                epoch,
                state,
                reason,
                has_velocity,
                world_from_camera,
                map_from_camera,
                keyframe_from_camera,
                covariance,
                map_covariance,
                linear_velocity,
                angular_velocity,
                velocity_covariance,
                brightness,
                in_view_ratio,
                inlier_ratio,
                residual_rmse,
            ]
        );
        asserts!(text, Intrinsics, "semidense_intrinsics", [fx, fy, cx, cy]);
        asserts!(
            text,
            Frame,
            "semidense_frame",
            [
                sequence,
                capture_nanos,
                realtime_nanos,
                exposure_nanos,
                gain,
                width,
                height,
                intrinsics,
                pixels,
            ]
        );
        asserts!(
            text,
            DepthPoint,
            "semidense_depth_point",
            [u, v, inverse_depth, variance, intensity]
        );
        asserts!(
            text,
            Keyframe,
            "semidense_keyframe",
            [
                keyframe_id,
                revision,
                sequence,
                capture_nanos,
                map_revision,
                epoch,
                width,
                height,
                num_points,
                intrinsics,
                world_from_keyframe,
                map_from_keyframe,
                points,
                image,
            ]
        );
        asserts!(
            text,
            KeyframePose,
            "semidense_keyframe_pose",
            [keyframe_id, revision, map_from_keyframe]
        );
        asserts!(
            text,
            Graph,
            "semidense_graph",
            [revision, map_revision, epoch, num_keyframes, keyframes]
        );
        for (state, name) in [(State::Tracking, "TRACKING"), (State::Lost, "LOST")] {
            writeln!(
                text,
                "_Static_assert(SEMIDENSE_STATE_{name} == {}, \"state\");",
                state as u32
            )
            .unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("layout.c");
        std::fs::write(&source, text).unwrap();
        let include = concat!("-I", env!("CARGO_MANIFEST_DIR"), "/include");
        let done =
            Command::new("cc").args(["-std=c11", "-fsyntax-only", include]).arg(&source).output();
        let done = done.expect("a C compiler");
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
}
