//! A keyframe's depth in eight bytes per point, unprojected by the page's GPU: u, v, inverse depth,
//! brightness, relative deviation.

use std::sync::Arc;

use semidense::service::results::report::scene::{POINT_BYTES, deviation_code, even_order};
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use serde_json::{Value, json};

/// A keyframe packed for pages.
#[derive(Debug, Clone)]
pub struct Packed {
    /// Id of the keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Camera, size and scale of the encoded numbers.
    pub header: Value,
    /// The points, in an order of which any prefix is an even sample.
    pub points: Arc<[u8]>,
}

impl Packed {
    /// Packs a keyframe.
    pub fn of(keyframe: &Keyframe) -> Self {
        let usable =
            |point: &&DepthPoint| point.inverse_depth > 0.0 && point.inverse_depth.is_finite();
        let points: Vec<&DepthPoint> = keyframe.points.iter().filter(usable).collect();
        let nearest = points.iter().fold(0.0_f32, |most, point| most.max(point.inverse_depth));
        let step = f64::from(nearest) / f64::from(u16::MAX);
        let mut bytes = Vec::with_capacity(points.len() * POINT_BYTES);
        for index in even_order(points.len()) {
            let point = points[index];
            let inverse_depth = f64::from(point.inverse_depth);
            let relative = f64::from(point.variance).sqrt() / inverse_depth;
            // At least 1: 0 denotes no depth.
            let code = (inverse_depth / step).round().clamp(1.0, f64::from(u16::MAX)) as u16;
            for number in [point.u, point.v, code] {
                bytes.extend_from_slice(&number.to_le_bytes());
            }
            bytes.extend_from_slice(&[
                point.intensity.clamp(0.0, 255.0) as u8,
                deviation_code(relative),
            ]);
        }
        let k = &keyframe.intrinsics;
        let header = json!({
            "kind": "keyframe",
            "id": keyframe.keyframe_id,
            "epoch": keyframe.epoch,
            "revision": keyframe.revision,
            "t": keyframe.capture_nanos as f64 * 1e-9,
            "k": [k.fx, k.fy, k.cx, k.cy],
            "size": [k.width, k.height],
            "depthStep": step,
        });
        Self {
            keyframe_id: keyframe.keyframe_id,
            revision: keyframe.revision,
            header,
            points: bytes.into(),
        }
    }

    /// The number of points.
    pub fn num_points(&self) -> usize {
        self.points.len() / POINT_BYTES
    }

    /// An even sample of at most `most` points.
    pub fn thinned(&self, most: usize) -> Self {
        Self {
            points: self.points[..most.min(self.num_points()) * POINT_BYTES].into(),
            ..self.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::slam::geometry::intrinsics::Intrinsics;
    use semidense::slam::geometry::sim3::Sim3;

    fn keyframe(inverse_depths: &[f32]) -> Keyframe {
        let points = inverse_depths.iter().enumerate().map(|(i, &inverse_depth)| DepthPoint {
            u: i as u16,
            v: 3,
            inverse_depth,
            variance: 1e-4,
            intensity: 300.0,
        });
        let k = Intrinsics::pinhole(640, 480, 500.0);
        Keyframe::at(Sim3::identity(), k, points.collect(), vec![0; 640 * 480])
    }

    #[test]
    fn inverse_depth_is_accurate_to_a_part_in_65535_of_the_nearest() {
        let packed = Packed::of(&keyframe(&[0.5, 2.0, f32::NAN, 0.0, -1.0, 1e-9]));
        assert_eq!(packed.num_points(), 3, "what is no depth is left out");
        let step = packed.header["depthStep"].as_f64().unwrap();
        for point in packed.points.chunks_exact(POINT_BYTES) {
            let number = |at: usize| u16::from_le_bytes([point[at], point[at + 1]]);
            let truth = [0.5, 2.0, 0.0, 0.0, 0.0, 1e-9][usize::from(number(0))];
            assert!((f64::from(number(4)) * step - truth).abs() <= step, "{point:?}");
            assert_eq!((number(2), point[6]), (3, 255));
        }
        assert_eq!((packed.thinned(2).num_points(), packed.thinned(9).num_points()), (2, 3));
        assert_eq!(Packed::of(&keyframe(&[])).num_points(), 0);
    }
}
