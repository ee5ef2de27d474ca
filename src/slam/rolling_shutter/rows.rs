//! When each row was exposed, and the image resampled for the motion until then.

use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::NO_DATA;
use crate::slam::image_motion::ImageMotion;

/// One pixel, in the steps of a place.
const ONE: i32 = 1 << 16;

/// Largest coordinate of a place, pixels, beyond any image; the difference of two is still a place.
const MAX_PLACE: f32 = 16_000.0;

/// Least component of a turned ray along the optical axis: what is beside the camera or behind it is out of view.
const MIN_DEPTH: f32 = 0.1;

/// Pixels between two places that are computed; the displacement bends by less than a hundredth of a pixel on the way.
const SEGMENT: usize = 16;

/// Times of the rows of a rectified image, relative to the middle row of the raw one.
#[derive(Debug)]
pub struct RowTimes {
    rectified: Intrinsics,
    /// Seconds from row to row of the raw image.
    row_s: f32,
    /// For each row and each of the nodes on it: the row of the raw image, from its middle.
    raw_rows: Vec<f32>,
    /// The columns at which places are computed.
    nodes: Vec<usize>,
}

impl RowTimes {
    /// For the rectified images of `camera`, whose rows are read out within `readout_s`.
    pub fn new(camera: &CameraModel, rectified: &Intrinsics, readout_s: f64) -> Self {
        let raw_height = camera.intrinsics().height as f64;
        let middle_row = 0.5 * (raw_height - 1.0);
        let raw_row = |u: f64, v: f64| {
            let ray = rectified.ray(u, v);
            camera.project(&ray).map_or(v, |pixel| pixel.y) - middle_row
        };
        let last = rectified.width - 1;
        let nodes = (0..last).step_by(SEGMENT).chain([last]).collect::<Vec<_>>();
        let row = |v: usize| nodes.iter().map(move |&u| raw_row(u as f64, v as f64) as f32);
        let raw_rows = (0..rectified.height).flat_map(row).collect();
        Self { rectified: *rectified, row_s: (readout_s / raw_height) as f32, raw_rows, nodes }
    }

    /// Writes to `resampled` what the image `rolling` would show if every row had been exposed with the middle one,
    /// while the image moves by `motion` a second.
    pub fn resample(&self, motion: &ImageMotion, rolling: &[u8], resampled: &mut [u8]) {
        let Intrinsics { width, height, .. } = self.rectified;
        let sampler = Sampler { pixels: rolling, width, height };
        let nodes = &self.nodes;
        let rows = resampled.chunks_exact_mut(width).zip(self.raw_rows.chunks_exact(nodes.len()));
        for (v, (out, raw_rows)) in rows.enumerate() {
            let seen = |node: usize| self.seen_at(motion, [nodes[node], v], raw_rows[node]);
            let mut from = seen(0);
            for node in 1..nodes.len() {
                let (begin, end) = (nodes[node - 1], nodes[node]);
                let to = seen(node);
                match from.zip(to) {
                    Some((from, to)) => sampler.line(from, to, &mut out[begin..end]),
                    None => out[begin..end].fill(NO_DATA),
                }
                from = to;
            }
            out[width - 1] = from.map_or(NO_DATA, |place| sampler.at(place));
        }
    }

    /// Where in the rolling image the scene of a pixel is seen, in steps of 2⁻¹⁶ pixels; `None` far out of view.
    fn seen_at(&self, motion: &ImageMotion, [u, v]: [usize; 2], raw_row: f32) -> Option<[i32; 2]> {
        let Intrinsics { fx, fy, cx, cy, .. } = self.rectified;
        let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(|value| value as f32);
        let [wx, wy, wz, zoom] = motion.map(|value| value as f32);
        let (x, y) = ((u as f32 - cx) / fx, (v as f32 - cy) / fy);
        // ω × ray, and ω × (ω × ray).
        let [dx, dy, dz] = [wy - wz * y, wz * x - wx, wx * y - wy * x];
        let [ex, ey, ez] = [wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx];
        // The pixel is seen in a row that the motion has reached, which is read at another time.
        let time_s = self.row_s * raw_row;
        let rows = fy * time_s * (dy - y * dz + zoom * y);
        let time_s = time_s + self.row_s * rows;
        let half = 0.5 * time_s * time_s;
        let depth = 1.0 + time_s * dz + half * ez;
        if depth.is_nan() || depth < MIN_DEPTH {
            return None;
        }
        let scale = (1.0 + time_s * zoom) / depth;
        let seen_u = fx * scale * (x + time_s * dx + half * ex) + cx;
        let seen_v = fy * scale * (y + time_s * dy + half * ey) + cy;
        let seen = [seen_u, seen_v];
        let is_near = seen.iter().all(|place| place.abs() < MAX_PLACE);
        is_near.then(|| seen.map(|place| (place * ONE as f32).round() as i32))
    }
}

/// Samples an image of bytes.
struct Sampler<'a> {
    pixels: &'a [u8],
    width: usize,
    height: usize,
}

impl Sampler<'_> {
    /// Samples at equal distances from `from` towards `to`, which is the place of the pixel after the last.
    #[inline]
    fn line(&self, from: [i32; 2], to: [i32; 2], out: &mut [u8]) {
        let step = [0, 1].map(|i| (to[i] - from[i]) / out.len() as i32);
        let mut place = from;
        for out in out {
            *out = self.at(place);
            place = [place[0] + step[0], place[1] + step[1]];
        }
    }

    /// Bilinear, at a place in steps of 2⁻¹⁶ pixels; no data outside and beside pixels without data.
    #[inline]
    fn at(&self, place: [i32; 2]) -> u8 {
        // To the nearest step of 2⁻⁸ pixels.
        let [u, v] = place.map(|place| (place + ONE / 512) >> 8);
        let (right, bottom) = ((self.width as i32 - 1) << 8, (self.height as i32 - 1) << 8);
        if !(0..=right).contains(&u) || !(0..=bottom).contains(&v) {
            return NO_DATA;
        }
        let (across, down) = ((u & 255) as u32, (v & 255) as u32);
        // A neighbour that has no weight need not have data, nor exist.
        let (next, below) = (usize::from(across > 0), usize::from(down > 0) * self.width);
        let upper = (v >> 8) as usize * self.width + (u >> 8) as usize;
        let lower = upper + below;
        let corners = [upper, upper + next, lower, lower + next].map(|index| self.pixels[index]);
        let [a, b, c, d] = corners.map(u32::from);
        let (above, below) = (a * (256 - across) + b * across, c * (256 - across) + d * across);
        let grey = (above * (256 - down) + below * down + (1 << 15)) >> 16;
        if a.min(b).min(c.min(d)) == u32::from(NO_DATA) { NO_DATA } else { grey as u8 }
    }
}
