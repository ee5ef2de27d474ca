//! A keyframe's depth as a cloud of points in the map.

use semidense::slam::keyframe::Keyframe;

use crate::ros::axes::ros_from_world;
use crate::ros::message::{Header, PointCloud2, PointField};

/// Fields of a point, each a 32-bit float: position in the map, REP 103 axes and map units; brightness 0 to
/// 255; standard deviation along the line of sight, map units.
const FIELDS: [&str; 5] = ["x", "y", "z", "intensity", "sigma"];

/// Bytes of a field.
const FIELD_BYTES: usize = size_of::<f32>();

/// Bytes of a point.
pub const POINT_BYTES: usize = FIELDS.len() * FIELD_BYTES;

/// The points of a keyframe, placed in the map. Points without depth are left out.
pub fn keyframe_cloud(keyframe: &Keyframe, header: Header) -> PointCloud2 {
    let ros_from_keyframe = ros_from_world() * keyframe.map_from_keyframe.rigid;
    let (rotation, unit) = (ros_from_keyframe.rotation_matrix(), keyframe.map_from_keyframe.scale);
    let k = &keyframe.intrinsics;
    let mut data = Vec::with_capacity(keyframe.points.len() * POINT_BYTES);
    for point in keyframe.points.iter().filter(|point| point.inverse_depth > 0.0) {
        let depth = unit / f64::from(point.inverse_depth);
        let ray = k.ray(f64::from(point.u), f64::from(point.v));
        let place = rotation * (ray * depth) + ros_from_keyframe.translation;
        // σ of 1/z is σ/d² of z, and the ray is longer than z.
        let sigma = f64::from(point.variance.max(0.0)).sqrt() / f64::from(point.inverse_depth)
            * depth
            * ray.norm();
        let numbers = [place.x, place.y, place.z, f64::from(point.intensity), sigma];
        numbers.iter().for_each(|number| data.extend((*number as f32).to_le_bytes()));
    }
    let num_points = (data.len() / POINT_BYTES) as u32;
    let field = |(at, name): (usize, &&str)| PointField {
        name: (*name).to_owned(),
        offset: (at * FIELD_BYTES) as u32,
        datatype: PointField::FLOAT32,
        count: 1,
    };
    PointCloud2 {
        header,
        height: 1,
        width: num_points,
        fields: FIELDS.iter().enumerate().map(field).collect(),
        is_bigendian: false,
        point_step: POINT_BYTES as u32,
        row_step: data.len() as u32,
        data,
        is_dense: true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector6;
    use semidense::slam::geometry::intrinsics::Intrinsics;
    use semidense::slam::geometry::se3::SE3;
    use semidense::slam::geometry::sim3::Sim3;
    use semidense::slam::keyframe::DepthPoint;

    #[test]
    fn points_are_in_the_map_with_x_ahead() {
        let intrinsics =
            Intrinsics { fx: 100.0, fy: 100.0, cx: 50.0, cy: 40.0, width: 101, height: 81 };
        let point = |u, v, inverse_depth| DepthPoint {
            u,
            v,
            inverse_depth,
            variance: 0.0025,
            intensity: 7.0,
        };
        // Two units of the keyframe are one of the map's, one metre to the right of its origin.
        let rigid = SE3::exp(&Vector6::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.0));
        let points = vec![point(50, 40, 0.5), point(60, 40, 0.0), point(100, 40, 0.5)];
        let keyframe = Keyframe::at(Sim3::new(rigid, 2.0), intrinsics, points, Vec::new());

        let cloud = keyframe_cloud(&keyframe, Header::default());
        assert_eq!((cloud.width, cloud.point_step, cloud.data.len()), (2, 20, 40));
        let numbers: Vec<f32> = cloud
            .data
            .chunks_exact(4)
            .map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()))
            .collect();
        // Depth 2 keyframe units = 4; σ of the inverse depth 0.05 = a tenth of it.
        let expected = [[4.0, -1.0, 0.0, 7.0, 0.4], [4.0, -3.0, 0.0, 7.0, 0.4 * 1.25_f32.sqrt()]];
        for (found, expected) in numbers.iter().zip(expected.as_flattened()) {
            assert!((found - expected).abs() < 1e-5, "{numbers:?}");
        }
    }
}
