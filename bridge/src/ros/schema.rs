//! Message definitions as carried by recordings and Foxglove (`ros2msg`), and the hashes of their types.

use std::collections::BTreeSet;

/// Line between the definitions of a schema.
const SEPARATOR: &str =
    "================================================================================";

/// Each type and its fields, as in the packages of ROS 2 Humble (and all later distributions so far).
const DEFINITIONS: &[(&str, &str)] = &[
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"),
    ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
    (
        "geometry_msgs/PoseWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    ("geometry_msgs/PoseArray", "std_msgs/Header header\ngeometry_msgs/Pose[] poses\n"),
    ("geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"),
    ("geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"),
    (
        "nav_msgs/Odometry",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
         geometry_msgs/TwistWithCovariance twist\n",
    ),
    (
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    ),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    (
        "sensor_msgs/PointField",
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n\
         uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    ),
    (
        "sensor_msgs/PointCloud2",
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n\
         bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    ),
    (
        "sensor_msgs/Image",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
         uint32 step\nuint8[] data\n",
    ),
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"),
    (
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    ),
    (
        "sensor_msgs/CameraInfo",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n\
         float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n\
         sensor_msgs/RegionOfInterest roi\n",
    ),
    ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
    (
        "diagnostic_msgs/DiagnosticStatus",
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n\
         string hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
    ),
    (
        "diagnostic_msgs/DiagnosticArray",
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
    ),
    (
        "semidense_msgs/Frame",
        "std_msgs/Header header\nuint64 sequence\nint64 capture_nanos\nint64 clock_nanos\n\
         uint64 exposure_nanos\nfloat32 gain\n",
    ),
    (
        "semidense_msgs/Pose",
        "std_msgs/Header header\nuint64 sequence\nint64 capture_nanos\nuint64 latency_nanos\n\
         uint64 track_nanos\nuint64 keyframe_id\nuint64 revision\nuint64 map_revision\nuint32 epoch\n\
         uint32 state\nuint32 reason\nfloat64[7] world_from_camera\nfloat64[7] map_from_camera\n\
         float64[7] keyframe_from_camera\nfloat64[21] covariance\nfloat64[21] map_covariance\n\
         uint32 has_velocity\nfloat64[3] linear_velocity\nfloat64[3] angular_velocity\n\
         float64[21] velocity_covariance\nfloat64[2] brightness\nfloat64 in_view_ratio\nfloat64 inlier_ratio\nfloat64 residual_rmse\n\
         uint32 points\nuint32 iterations\n",
    ),
    (
        "semidense_msgs/Keyframe",
        "std_msgs/Header header\nuint64 keyframe_id\nuint64 revision\nuint64 sequence\n\
         uint64 map_revision\nuint32 epoch\nuint32 points\nfloat64[8] world_from_keyframe\n\
         float64[8] map_from_keyframe\nfloat64[4] intrinsics\n",
    ),
    (
        "semidense_msgs/Graph",
        "std_msgs/Header header\nuint64 map_revision\nuint32 epoch\nuint64[] keyframe_ids\n\
         uint64[] revisions\nfloat64[] map_from_keyframes\n",
    ),
];

/// Hashes of the types (REP 2011), by which ROS 2 since Iron checks that both ends use the same message.
const TYPE_HASHES: &[(&str, &str)] = &[
    (
        "geometry_msgs/PoseWithCovarianceStamped",
        "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    ),
    ("geometry_msgs/PoseArray", "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0"),
    ("nav_msgs/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
    ("tf2_msgs/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    ("sensor_msgs/PointCloud2", "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"),
    ("sensor_msgs/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
    (
        "sensor_msgs/CompressedImage",
        "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    ),
    ("sensor_msgs/CameraInfo", "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275"),
    (
        "diagnostic_msgs/DiagnosticArray",
        "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    ),
];

/// The name of a type as the tools of ROS 2 spell it: `nav_msgs/msg/Odometry` for `nav_msgs/Odometry`.
pub fn full_name(name: &str) -> String {
    name.replacen('/', "/msg/", 1)
}

/// The hash of a type, as `RIHS01_…`; `None` for a type without a topic here.
pub fn type_hash(name: &str) -> Option<String> {
    let (_, hash) = TYPE_HASHES.iter().find(|(known, _)| *known == name)?;
    Some(format!("RIHS01_{hash}"))
}

fn fields(name: &str) -> Option<&'static str> {
    DEFINITIONS.iter().find(|(known, _)| *known == name).map(|(_, fields)| *fields)
}

/// The complete definition of a type: its fields, then each type they use, in the form `ros2msg`. `None` for
/// an unknown type.
pub fn schema(name: &str) -> Option<String> {
    let mut text = fields(name)?.to_owned();
    let mut seen = BTreeSet::from([name]);
    let mut waiting = vec![name];
    while let Some(name) = waiting.pop() {
        for line in fields(name)?.lines() {
            let word = line.split([' ', '[']).next().unwrap_or_default();
            let Some((used, used_fields)) = DEFINITIONS.iter().find(|(known, _)| *known == word)
            else {
                continue;
            };
            if seen.insert(used) {
                text.push_str(&format!("{SEPARATOR}\nMSG: {used}\n{used_fields}"));
                waiting.push(used);
            }
        }
    }
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schema_contains_every_type_that_it_uses_once() {
        for (name, _) in TYPE_HASHES {
            let text = schema(name).unwrap();
            for line in text.lines().filter(|line| !line.starts_with("MSG: ")) {
                let word = line.split([' ', '[']).next().unwrap();
                if word.contains('/') {
                    let section = format!("MSG: {word}\n");
                    assert_eq!(text.matches(&section).count(), 1, "{name}: {word}");
                }
            }
        }
        assert_eq!(schema("std_msgs/String"), None);
        assert_eq!(full_name("nav_msgs/Odometry"), "nav_msgs/msg/Odometry");
    }
}
