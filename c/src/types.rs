//! What the header shows: plain structures, laid out as in C.
//!
//! Frames: the camera looks along z, x is right and y is down. `a_from_b` takes points in b to a. Lengths are map units, or
//! those of the keyframe where it says so. Matrices are row by row.

/// Tracking status of a frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum State {
    /// No map that can be trusted yet; the pose is a working value.
    #[default]
    Initializing = 0,
    /// The pose is good to its covariance.
    Tracking = 1,
    /// The pose is usable, but worse than it should be: see the reason.
    Degraded = 2,
    /// The pose is not claimed: see the reason.
    Lost = 3,
}

/// Why a pose is degraded or lost.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Reason {
    /// It is neither.
    #[default]
    None = 0,
    /// Degraded: the deadline came before the finest level was solved.
    Budget = 1,
    /// Degraded: few of the keyframe's points are in view.
    LowOverlap = 2,
    /// Degraded: the residuals are larger than noise and depth variance explain.
    HighResidual = 3,
    /// Degraded: frames are missing between this one and the one before.
    Gap = 4,
    /// Degraded: the known depth is out of view; the rotation holds, the position stands still.
    Turning = 5,
    /// Lost: the iteration left the image or became non-finite.
    Diverged = 6,
    /// Lost: too few of the points match.
    TooFewInliers = 7,
    /// Lost: the keyframe has no usable points.
    NoPoints = 8,
    /// Lost: the frame has another size than the keyframe, or no contrast at all.
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

/// The pose of one frame; every frame has one, also when the camera is lost.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Number of the frame at its source; a gap is a frame that is missing.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
    pub capture_nanos: i64,
    /// CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 where unknown.
    pub realtime_nanos: i64,
    /// CLOCK_MONOTONIC when the pose was published.
    pub published_nanos: i64,
    /// From the frame to the publication of its pose.
    pub latency_nanos: u64,
    /// Keyframe it was tracked on, all ones before the first.
    pub keyframe_id: u64,
    /// Revision of that keyframe.
    pub keyframe_revision: u64,
    /// How often the map had been corrected: `map_from_camera` may jump where it grows.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// Tracking status.
    pub state: State,
    /// Why it is degraded or lost.
    pub reason: Reason,
    /// 1 where the velocities are known, else 0.
    pub has_velocity: u32,
    /// Odometry: never jumps within an epoch, and drifts.
    pub world_from_camera: Transform,
    /// The best estimate in the map; jumps where the map is corrected.
    pub map_from_camera: Transform,
    /// Relative to the keyframe, keyframe units.
    pub keyframe_from_camera: Transform,
    /// 6×6, of the left increment (translation, rotation) of camera_from_keyframe, keyframe units and radians.
    pub covariance: [f64; 36],
    /// 6×6, of the left increment (translation, rotation) of `map_from_camera`, map units and radians.
    pub map_covariance: [f64; 36],
    /// Of the camera, in its own axes, world units a second.
    pub linear_velocity: [f64; 3],
    /// Of the camera, in its own axes, radians a second.
    pub angular_velocity: [f64; 3],
    /// 6×6, of (linear, angular) velocity.
    pub velocity_covariance: [f64; 36],
    /// a, b of `I_camera ≈ eᵃ I_keyframe + b`, grey levels.
    pub brightness: [f64; 2],
    /// Share of the keyframe's points in view, 0 to 1.
    pub in_view_ratio: f64,
    /// Share of those compared that are explained, 0 to 1.
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

/// An image of the camera; its pixels lie in shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Number of the frame at its source, as in its pose.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds.
    pub capture_nanos: i64,
    /// CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 where unknown.
    pub realtime_nanos: i64,
    /// Exposure time, nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
    /// Pixels in a row; rows follow each other without a gap.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Of the rectified image.
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

/// A frame with depth; points and image lie in shared memory.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Its id, as poses and graph name it.
    pub keyframe_id: u64,
    /// Counts up with every change of the map: the same keyframe comes again with refined depth.
    pub revision: u64,
    /// Number of its frame.
    pub sequence: u64,
    /// Stamp of its frame, nanoseconds.
    pub capture_nanos: i64,
    /// How often the map had been corrected by then.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// Pixels in a row of its image.
    pub width: u32,
    /// Rows of its image.
    pub height: u32,
    /// Points with depth.
    pub num_points: u32,
    /// Of its image.
    pub intrinsics: Intrinsics,
    /// Where odometry has it; the scale is its unit.
    pub world_from_keyframe: Transform,
    /// Where the map has it; the scale is its unit.
    pub map_from_keyframe: Transform,
    /// `num_points` of them. Valid until the next `semidense_newest_keyframe` on this reader, or its end.
    pub points: *const DepthPoint,
    /// Grey, `width * height` bytes. Valid for as long as `points`.
    pub image: *const u8,
}

/// Where the map has a keyframe.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Its place; the scale is its unit.
    pub map_from_keyframe: Transform,
}

/// The poses of all keyframes in the map.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Graph {
    /// Newest revision of a keyframe in it.
    pub revision: u64,
    /// How often the map had been corrected.
    pub map_revision: u64,
    /// Life of the map.
    pub epoch: u32,
    /// Keyframes in it.
    pub num_keyframes: u32,
    /// `num_keyframes` of them. Valid until the next `semidense_newest_graph` on this reader, or its end.
    pub keyframes: *const KeyframePose,
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;
    use std::mem::offset_of;
    use std::process::Command;

    use super::*;

    /// Lines of C that hold the header's structure to ours.
    macro_rules! asserts {
        ($text:ident, $kind:ty, $name:literal, [$($field:ident),* $(,)?]) => {
            writeln!($text, "_Static_assert(sizeof({}) == {}, \"size of {}\");", $name, size_of::<$kind>(), $name).unwrap();
            $(writeln!($text, "_Static_assert(offsetof({}, {}) == {}, \"{}.{}\");", $name, stringify!($field),
                offset_of!($kind, $field), $name, stringify!($field)).unwrap();)*
        };
    }

    #[test]
    fn the_header_lays_out_what_we_write() {
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
