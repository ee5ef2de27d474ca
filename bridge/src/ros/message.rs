//! ROS 2 messages, with the fields of their definitions.

use serde::{Deserialize, Serialize};
use serde_big_array::BigArray;

/// A type of fields, as ROS spells it.
pub trait FieldType {
    /// Its name, or that of its elements.
    const TYPE: &'static str;

    /// What makes it an array: `[]`, or `[9]`.
    fn array() -> String {
        String::new()
    }
}

macro_rules! numbers_and_texts {
    ($($rust:ty: $name:literal),*) => {
        $(impl FieldType for $rust {
            const TYPE: &'static str = $name;
        })*
    };
}
numbers_and_texts!(
    bool: "bool", u8: "uint8", i32: "int32", u32: "uint32", i64: "int64", u64: "uint64", f32: "float32", f64: "float64",
    String: "string"
);

impl<T: FieldType> FieldType for Vec<T> {
    const TYPE: &'static str = T::TYPE;

    fn array() -> String {
        "[]".to_owned()
    }
}

impl<T: FieldType, const N: usize> FieldType for [T; N] {
    const TYPE: &'static str = T::TYPE;

    fn array() -> String {
        format!("[{N}]")
    }
}

/// A message; its type has a package and a name, such as `nav_msgs/Odometry`.
pub trait RosMessage: FieldType + Serialize {
    /// Its definition: a line for each constant and field.
    fn definition() -> String;
}

/// The name of a type, its hash (REP 2011), by which ROS 2 since Iron checks that both ends use the same message, and
/// its definition, as in the packages of ROS 2 Humble (and all later distributions so far).
pub type Declared = (&'static str, Option<&'static str>, fn() -> String);

/// Declares messages, and `$all` of them. A field may name another type than its own (`as`) and a default (`=`), a
/// message its hash, for a topic, and its constants (`with`).
macro_rules! messages {
    ($all:ident: $(
        $(#[$about:meta])*
        $type:literal $name:ident $(hash $hash:literal)? $(with $constants:literal)? {
            $($(#[$of:meta])* $field:ident: $rust:ty $(as $ros:literal)? $(= $default:literal)?,)*
        }
    )*) => {
        /// The types declared here.
        pub const $all: &[$crate::ros::message::Declared] = &[$((
            $type,
            [$(Some($hash),)? None][0],
            <$name as $crate::ros::message::RosMessage>::definition,
        )),*];

        $($(#[$about])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        pub struct $name {
            $($(#[$of])* pub $field: $rust,)*
        }

        impl $crate::ros::message::FieldType for $name {
            const TYPE: &'static str = $type;
        }

        impl $crate::ros::message::RosMessage for $name {
            fn definition() -> String {
                use $crate::ros::message::FieldType;
                let lines = [$({
                    let kind = [$($ros,)? <$rust>::TYPE][0];
                    let default = concat!($(" ", $default)?);
                    format!("{kind}{} {}{default}\n", <$rust>::array(), stringify!($field))
                }),*];
                concat!($($constants)?).to_owned() + &lines.concat()
            }
        })*
    };
}
pub(crate) use messages;

messages! {
    MESSAGES:

    /// `builtin_interfaces/Time`: an instant, of CLOCK_REALTIME if known.
    #[derive(Copy, Eq, Default)]
    "builtin_interfaces/Time" Time {
        /// Seconds.
        sec: i32,
        /// Nanoseconds after them.
        nanosec: u32,
    }

    /// `std_msgs/Header`.
    #[derive(Eq, Default)]
    "std_msgs/Header" Header {
        /// Time of the message's content.
        stamp: Time,
        /// The frame id of its coordinates.
        frame_id: String,
    }

    /// `geometry_msgs/Point` and `geometry_msgs/Vector3`, which have the same fields.
    #[derive(Copy, Default)]
    "geometry_msgs/Vector3" Vector3 {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }

    /// `geometry_msgs/Quaternion`.
    #[derive(Copy)]
    "geometry_msgs/Quaternion" Quaternion {
        /// x.
        x: f64 = "0",
        /// y.
        y: f64 = "0",
        /// z.
        z: f64 = "0",
        /// The real part.
        w: f64 = "1",
    }

    /// `geometry_msgs/Pose`.
    #[derive(Copy, Default)]
    "geometry_msgs/Pose" Pose {
        /// Position.
        position: Vector3 as "geometry_msgs/Point",
        /// Orientation.
        orientation: Quaternion,
    }

    /// `geometry_msgs/PoseWithCovariance`.
    "geometry_msgs/PoseWithCovariance" PoseWithCovariance {
        /// The pose.
        pose: Pose,
        /// Row-major 6×6: position, then rotation about the fixed x, y and z axes of the header's frame.
        #[serde(with = "BigArray")]
        covariance: [f64; 36],
    }

    /// `geometry_msgs/PoseWithCovarianceStamped`.
    "geometry_msgs/PoseWithCovarianceStamped" PoseWithCovarianceStamped
    hash "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e" {
        /// Stamp and frame of the pose.
        header: Header,
        /// The pose.
        pose: PoseWithCovariance,
    }

    /// `geometry_msgs/Twist`.
    #[derive(Copy, Default)]
    "geometry_msgs/Twist" Twist {
        /// Velocity.
        linear: Vector3,
        /// Angular velocity, rad/s.
        angular: Vector3,
    }

    /// `geometry_msgs/TwistWithCovariance`.
    "geometry_msgs/TwistWithCovariance" TwistWithCovariance {
        /// The velocities.
        twist: Twist,
        /// Row-major 6×6: linear, then angular.
        #[serde(with = "BigArray")]
        covariance: [f64; 36],
    }

    /// `nav_msgs/Odometry`.
    "nav_msgs/Odometry" Odometry
    hash "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0" {
        /// Stamp, and the frame of the pose.
        header: Header,
        /// The frame whose pose and twist this is; the twist is expressed in it.
        child_frame_id: String,
        /// The pose.
        pose: PoseWithCovariance,
        /// The velocities.
        twist: TwistWithCovariance,
    }

    /// `geometry_msgs/PoseArray`.
    "geometry_msgs/PoseArray" PoseArray
    hash "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0" {
        /// Stamp and frame of the poses.
        header: Header,
        /// The poses.
        poses: Vec<Pose>,
    }

    /// `geometry_msgs/Transform`.
    #[derive(Copy, Default)]
    "geometry_msgs/Transform" Transform {
        /// Translation.
        translation: Vector3,
        /// Rotation.
        rotation: Quaternion,
    }

    /// `geometry_msgs/TransformStamped`: the pose of the child frame in the header's frame.
    "geometry_msgs/TransformStamped" TransformStamped {
        /// Stamp and parent frame.
        header: Header,
        /// The child frame.
        child_frame_id: String,
        /// `parent_from_child`.
        transform: Transform,
    }

    /// `tf2_msgs/TFMessage`.
    "tf2_msgs/TFMessage" TfMessage
    hash "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087" {
        /// The transforms.
        transforms: Vec<TransformStamped>,
    }

    /// `sensor_msgs/PointField`.
    "sensor_msgs/PointField" PointField
    with "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n\
          uint8 FLOAT32=7\nuint8 FLOAT64=8\n" {
        /// Its name.
        name: String,
        /// Bytes from the start of a point.
        offset: u32,
        /// The type of its numbers: [`PointField::FLOAT32`] and others.
        datatype: u8,
        /// How many numbers it has.
        count: u32,
    }

    /// `sensor_msgs/PointCloud2`.
    "sensor_msgs/PointCloud2" PointCloud2
    hash "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5" {
        /// Stamp and frame of the points.
        header: Header,
        /// Rows: 1 for unordered points.
        height: u32,
        /// Points in a row.
        width: u32,
        /// The fields of a point.
        fields: Vec<PointField>,
        /// Whether numbers are big endian.
        is_bigendian: bool,
        /// Bytes of a point.
        point_step: u32,
        /// Bytes of a row.
        row_step: u32,
        /// The points.
        #[serde(with = "serde_bytes")]
        data: Vec<u8>,
        /// Whether every number is finite.
        is_dense: bool,
    }

    /// `sensor_msgs/Image`.
    "sensor_msgs/Image" Image
    hash "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47" {
        /// Stamp and optical frame.
        header: Header,
        /// Height, pixels.
        height: u32,
        /// Width, pixels.
        width: u32,
        /// Pixel format, such as `mono8`.
        encoding: String,
        /// Whether numbers are big endian.
        is_bigendian: u8,
        /// Bytes from row to row.
        step: u32,
        /// The pixels.
        #[serde(with = "serde_bytes")]
        data: Vec<u8>,
    }

    /// `sensor_msgs/CompressedImage`.
    "sensor_msgs/CompressedImage" CompressedImage
    hash "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a" {
        /// Stamp and optical frame.
        header: Header,
        /// `jpeg` or `png`.
        format: String,
        /// The encoded file.
        #[serde(with = "serde_bytes")]
        data: Vec<u8>,
    }

    /// `sensor_msgs/RegionOfInterest`.
    #[derive(Copy, Eq, Default)]
    "sensor_msgs/RegionOfInterest" RegionOfInterest {
        /// First column.
        x_offset: u32,
        /// First row.
        y_offset: u32,
        /// Rows, 0 for all.
        height: u32,
        /// Columns, 0 for all.
        width: u32,
        /// Whether the region is to be rectified.
        do_rectify: bool,
    }

    /// `sensor_msgs/CameraInfo`.
    "sensor_msgs/CameraInfo" CameraInfo
    hash "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275" {
        /// Stamp and optical frame.
        header: Header,
        /// Height of the image, pixels.
        height: u32,
        /// Width of the image, pixels.
        width: u32,
        /// `plumb_bob`, `rational_polynomial` or `equidistant`.
        distortion_model: String,
        /// Coefficients of the lens.
        d: Vec<f64>,
        /// Intrinsics of the raw image, row-major 3×3.
        k: [f64; 9],
        /// Rectification, row-major 3×3.
        r: [f64; 9],
        /// Projection of the rectified image, row-major 3×4.
        p: [f64; 12],
        /// Number of columns combined into one pixel; 0 means 1.
        binning_x: u32,
        /// Number of rows combined into one pixel; 0 means 1.
        binning_y: u32,
        /// The part of the sensor that the image covers.
        roi: RegionOfInterest,
    }

    /// `diagnostic_msgs/KeyValue`.
    #[derive(Eq)]
    "diagnostic_msgs/KeyValue" KeyValue {
        /// Name of the value, with its unit.
        key: String,
        /// Its value.
        value: String,
    }

    /// `diagnostic_msgs/DiagnosticStatus`.
    #[derive(Eq)]
    "diagnostic_msgs/DiagnosticStatus" DiagnosticStatus with "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n" {
        /// 0 OK, 1 warning, 2 error, 3 stale.
        level: u8 as "byte",
        /// The component that reports.
        name: String,
        /// The state in a few words.
        message: String,
        /// The device.
        hardware_id: String,
        /// Figures.
        values: Vec<KeyValue>,
    }

    /// `diagnostic_msgs/DiagnosticArray`.
    #[derive(Eq)]
    "diagnostic_msgs/DiagnosticArray" DiagnosticArray
    hash "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e" {
        /// Time of the report.
        header: Header,
        /// One for each process.
        status: Vec<DiagnosticStatus>,
    }
}

impl Time {
    /// Nanoseconds in a second.
    const SECOND: i64 = 1_000_000_000;

    /// Converts from nanoseconds, saturating.
    pub fn from_nanos(nanos: i64) -> Self {
        let seconds = nanos.div_euclid(Self::SECOND);
        match i32::try_from(seconds) {
            Ok(sec) => Self { sec, nanosec: nanos.rem_euclid(Self::SECOND) as u32 },
            Err(_) if seconds > 0 => Self { sec: i32::MAX, nanosec: 999_999_999 },
            Err(_) => Self { sec: i32::MIN, nanosec: 0 },
        }
    }

    /// Converts to nanoseconds.
    pub fn nanos(self) -> i64 {
        i64::from(self.sec) * Self::SECOND + i64::from(self.nanosec)
    }
}

impl Header {
    /// A header with this stamp and frame id, which may be empty.
    pub fn new(stamp: Time, frame_id: &str) -> Self {
        Self { stamp, frame_id: frame_id.to_owned() }
    }
}

impl Default for Quaternion {
    fn default() -> Self {
        Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

impl PointField {
    /// Datatype of a 32-bit float.
    pub const FLOAT32: u8 = 7;
}
