//! Rectification: the pinhole view of a raw image, as a table computed once and applied to every frame.

use nalgebra::{Vector2, Vector3};

use crate::slam::geometry::camera_model::{CameraModel, bisected};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;

/// Half the widest field of view of a rectified image. A wider pinhole image spends almost all its pixels on the margin
/// (at 75° a pixel at the edge is 15 times as fine as one in the middle).
const WIDEST_HALF_VIEW_RAD: f64 = 75.0 * std::f64::consts::PI / 180.0;

/// Rows on which the valid region of the `z = 1` plane is measured.
const REGION_ROWS: usize = 2048;

/// Steps of the outward walk that brackets the end of the valid region along a line.
const WALK_STEPS: usize = 96;

/// Halvings that refine that end to far below a thousandth of a pixel.
const WALK_BISECTIONS: usize = 30;

/// Factor by which the view shrinks until every border pixel has data; it compensates for the spacing of the rows.
const SHRINK: f64 = 1.0 - 1e-4;

/// Maximum number of shrink steps: if more are needed, the region is not the one measured on its rows.
const MAX_SHRINKS: usize = 200;

/// Resolution of a fraction of a pixel.
const FRACTION_STEPS: f64 = 256.0;

/// Why a camera cannot be rectified.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum RectificationError {
    /// The optical axis misses the image, so no pinhole view around it exists.
    #[error(
        "the optical axis meets the raw image at ({u:.1}, {v:.1}), outside its {width}x{height} pixels"
    )]
    AxisOutside {
        /// Raw column of the optical axis.
        u: f64,
        /// Raw row of the optical axis.
        v: f64,
        /// Raw width, pixels.
        width: usize,
        /// Raw height, pixels.
        height: usize,
    },
    /// The distortion folds the image so that no rectangle of rays has data everywhere.
    #[error("the distortion coefficients leave no rectangular view with data at every pixel")]
    NoView,
}

/// A rectangle on the plane `z = 1` of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
struct View {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

impl View {
    /// The intrinsics whose outermost pixel centres lie on this rectangle.
    fn intrinsics(&self, width: usize, height: usize) -> Intrinsics {
        let fx = (width - 1) as f64 / (self.right - self.left);
        let fy = (height - 1) as f64 / (self.bottom - self.top);
        Intrinsics { fx, fy, cx: -self.left * fx, cy: -self.top * fy, width, height }
    }

    fn scaled(&self, factor: f64) -> Self {
        let (x, y) = (0.5 * (self.left + self.right), 0.5 * (self.top + self.bottom));
        let (half_x, half_y) =
            (0.5 * factor * (self.right - self.left), 0.5 * factor * (self.bottom - self.top));
        Self { left: x - half_x, right: x + half_x, top: y - half_y, bottom: y + half_y }
    }
}

/// The intrinsics of the largest pinhole view, of the raw image's size, in which every pixel has raw data with bilinear
/// support; "largest" is by area on the plane `z = 1`. fx, fy and the principal point are free; a view never extends
/// more than 75° to any side of the axis.
pub fn rectified_intrinsics(camera: &CameraModel) -> Result<Intrinsics, RectificationError> {
    let raw = *camera.intrinsics();
    if camera.distortion().is_pinhole() {
        return Ok(raw);
    }
    let axis = camera.project(&Vector3::z()).ok_or(RectificationError::NoView)?;
    if !has_data(&raw, &axis) {
        let Intrinsics { width, height, .. } = raw;
        return Err(RectificationError::AxisOutside { u: axis.x, v: axis.y, width, height });
    }
    let mut view = largest_view(camera).ok_or(RectificationError::NoView)?;
    for _ in 0..MAX_SHRINKS {
        let intrinsics = view.intrinsics(raw.width, raw.height);
        if border_has_data(camera, &intrinsics) && intrinsics.is_valid() {
            return Ok(intrinsics);
        }
        view = view.scaled(SHRINK);
    }
    Err(RectificationError::NoView)
}

/// Whether a raw position has all four neighbours for bilinear interpolation.
fn has_data(raw: &Intrinsics, pixel: &Vector2<f64>) -> bool {
    (0.0..=(raw.width - 1) as f64).contains(&pixel.x)
        && (0.0..=(raw.height - 1) as f64).contains(&pixel.y)
}

/// The raw position that sees a ray; `None` if there is no data.
fn seen(camera: &CameraModel, ray: &Vector3<f64>) -> Option<Vector2<f64>> {
    camera.project(ray).filter(|pixel| has_data(camera.intrinsics(), pixel))
}

/// The raw position that a rectified pixel sees; `None` if there is no data.
fn raw_pixel(camera: &CameraModel, rectified: &Intrinsics, u: f64, v: f64) -> Option<Vector2<f64>> {
    seen(camera, &rectified.ray(u, v))
}

/// Whether every pixel on the border of the view has data. The region with data is connected and has no holes, so
/// everything inside the border has data too.
fn border_has_data(camera: &CameraModel, rectified: &Intrinsics) -> bool {
    let (right, bottom) = (rectified.width - 1, rectified.height - 1);
    let seen = |u: usize, v: usize| raw_pixel(camera, rectified, u as f64, v as f64).is_some();
    (0..=right).all(|u| seen(u, 0) && seen(u, bottom))
        && (0..=bottom).all(|v| seen(0, v) && seen(right, v))
}

/// The largest rectangle of rays around the optical axis inside the region with data.
///
/// Every such rectangle is a run of rows, each inside the region from the rectangle's left to its right. So the region
/// is measured row by row, outward from the axis, and all runs of rows above and below the axis are tried; the
/// narrowest row of a run bounds it.
fn largest_view(camera: &CameraModel) -> Option<View> {
    let widest = WIDEST_HALF_VIEW_RAD.tan();
    let seen = |x: f64, y: f64| seen(camera, &Vector3::new(x, y, 1.0)).is_some();
    let top = -extent(widest, |step| seen(0.0, -step));
    let bottom = extent(widest, |step| seen(0.0, step));
    let rows_in = |end: f64| {
        let mut narrowest = View { left: -widest, right: widest, top: 0.0, bottom: 0.0 };
        (0..=REGION_ROWS / 2)
            .map(|i| {
                let y = end * i as f64 / (REGION_ROWS / 2) as f64;
                narrowest.left = narrowest.left.max(-extent(widest, |step| seen(-step, y)));
                narrowest.right = narrowest.right.min(extent(widest, |step| seen(step, y)));
                (y, narrowest.left, narrowest.right)
            })
            .collect::<Vec<_>>()
    };
    let (above, below) = (rows_in(top), rows_in(bottom));
    let mut best: Option<(f64, View)> = None;
    for &(top, left_above, right_above) in &above {
        for &(bottom, left_below, right_below) in &below {
            let (left, right) = (left_above.max(left_below), right_above.min(right_below));
            let area = (right - left) * (bottom - top);
            if area > best.map_or(0.0, |(largest, _)| largest) {
                best = Some((area, View { left, right, top, bottom }));
            }
        }
    }
    best.map(|(_, view)| view)
}

/// The distance from 0 over which `holds` stays true, at most `end`.
fn extent(end: f64, holds: impl Fn(f64) -> bool) -> f64 {
    let at = |i: usize| end * i as f64 / WALK_STEPS as f64;
    let Some(fails) = (0..=WALK_STEPS).find(|&i| !holds(at(i))) else { return end };
    if fails == 0 {
        return 0.0;
    }
    bisected([at(fails - 1), at(fails)], WALK_BISECTIONS, holds)[0]
}

/// The position in the raw image that each rectified pixel reads.
#[derive(Debug, Clone)]
struct RemapTable {
    /// Index of the upper left of the four raw neighbours.
    offsets: Vec<u32>,
    /// Fraction of a pixel to the right (low byte) and down (high byte), in 256ths.
    fractions: Vec<u16>,
}

/// A camera's rectification: the rectified intrinsics and the raw position of each pixel.
#[derive(Debug, Clone)]
pub struct Rectification {
    intrinsics: Intrinsics,
    /// `None` if raw images are already pinhole images.
    table: Option<RemapTable>,
}

impl Rectification {
    /// Prepares the rectification of a camera's images (tens of milliseconds).
    pub fn new(camera: &CameraModel) -> Result<Self, RectificationError> {
        let intrinsics = rectified_intrinsics(camera)?;
        if camera.distortion().is_pinhole() {
            return Ok(Self { intrinsics, table: None });
        }
        let Intrinsics { width, height, .. } = intrinsics;
        let mut table = RemapTable {
            offsets: Vec::with_capacity(width * height),
            fractions: Vec::with_capacity(width * height),
        };
        for v in 0..height {
            for u in 0..width {
                let pixel = raw_pixel(camera, &intrinsics, u as f64, v as f64)
                    .ok_or(RectificationError::NoView)?;
                let (column, right) = split(pixel.x, width);
                let (row, down) = split(pixel.y, height);
                table.offsets.push((row * width + column) as u32);
                table.fractions.push(u16::from_le_bytes([right, down]));
            }
        }
        Ok(Self { intrinsics, table: Some(table) })
    }

    /// Intrinsics of the rectified images; raw images have the same size.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Whether raw images are already pinhole images, so that rectifying is a copy.
    pub fn is_identity(&self) -> bool {
        self.table.is_none()
    }

    /// Writes the rectified version of the grey image `raw`, bilinear, to within half a grey level of rounding. Returns
    /// false and writes nothing unless both have the camera's number of pixels.
    pub fn rectify_into(&self, raw: &[u8], rectified: &mut [u8]) -> bool {
        let count = self.intrinsics.width * self.intrinsics.height;
        if raw.len() != count || rectified.len() != count {
            return false;
        }
        match &self.table {
            None => rectified.copy_from_slice(raw),
            Some(table) => table.interpolate(raw, self.intrinsics.width, rectified),
        }
        true
    }

    /// The rectified depth image (z in metres, 0 where unknown) of a raw one, nearest neighbour: depths across an edge
    /// are never mixed. z itself does not change, as the optical axis stays the same. `None` unless `raw` has the
    /// camera's size.
    pub fn rectify_depth(&self, raw: &Image<f32>) -> Option<Image<f32>> {
        let Intrinsics { width, height, .. } = self.intrinsics;
        if (raw.width(), raw.height()) != (width, height) {
            return None;
        }
        let Some(table) = &self.table else { return Some(raw.clone()) };
        let nearest = |(&offset, &fraction): (&u32, &u16)| {
            let [right, down] = fraction.to_le_bytes();
            let index =
                offset as usize + usize::from(right >= 128) + width * usize::from(down >= 128);
            raw.pixels()[index]
        };
        let pixels = table.offsets.iter().zip(&table.fractions).map(nearest).collect();
        Image::try_from_pixels(width, height, pixels)
    }
}

/// Splits a position inside `[0, size − 1]` into its lower neighbour, which is never the last pixel, and the fraction
/// towards the next one in 256ths.
fn split(position: f64, size: usize) -> (usize, u8) {
    let steps = (position * FRACTION_STEPS).round() as usize;
    let last = size - 2;
    let lower = steps / FRACTION_STEPS as usize;
    // The outermost pixel itself is read 1/256 px inside.
    if lower > last { (last, u8::MAX) } else { (lower, (steps % FRACTION_STEPS as usize) as u8) }
}

impl RemapTable {
    /// Bilinear interpolation of `raw` (rows of `width`) at every entry.
    ///
    /// The left and right neighbours share one u32, 16 bits each: first blended downwards, which fits 16 bits
    /// (255·256), then to the right. `a·(256 − w) + b·w` is written as `256·a + (b − a)·w`: a negative difference
    /// wraps, and the sum is exact again.
    fn interpolate(&self, raw: &[u8], width: usize, out: &mut [u8]) {
        const HALF: u32 = 1 << 15;
        const SPREAD: u32 = 0x00ff_00ff;
        let pair = |bytes: &[u8]| {
            let both = u32::from(u16::from_le_bytes([bytes[0], bytes[1]]));
            (both | both << 8) & SPREAD
        };
        let blend =
            |a: u32, b: u32, w: u32| (a << 8).wrapping_add(b.wrapping_sub(a).wrapping_mul(w));
        let entries = self.offsets.iter().zip(&self.fractions);
        for (out, (&offset, &fraction)) in out.iter_mut().zip(entries) {
            // One bounds check for all four neighbours.
            let near = &raw[offset as usize..][..width + 2];
            let [right, down] = fraction.to_le_bytes().map(u32::from);
            let columns = blend(pair(near), pair(&near[width..]), down);
            *out = (blend(columns & 0xffff, columns >> 16, right).wrapping_add(HALF) >> 16) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::camera_model::Distortion;

    fn cameras() -> Vec<CameraModel> {
        let vga = |fx, fy, cx, cy| Intrinsics { fx, fy, cx, cy, width: 640, height: 480 };
        let euroc = Intrinsics {
            fx: 458.654,
            fy: 457.296,
            cx: 367.215,
            cy: 248.375,
            width: 752,
            height: 480,
        };
        let fr1 = [0.262383, -0.953104, -0.005358, 0.002628, 1.163314];
        let kinect = [0.4916, -2.6889, 0.0007, -0.00005, 1.5655, 0.3677, -2.5116, 1.4951];
        [
            (vga(517.306408, 516.469215, 318.64304, 255.313989), Distortion::RadTan5(fr1)),
            (euroc, Distortion::RadTan4([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-5])),
            (vga(605.0, 604.0, 330.0, 231.0), Distortion::RadTan8(kinect)),
            (
                vga(300.0, 302.0, 300.0, 250.0),
                Distortion::Equidistant([0.003, 0.0007, -0.002, 0.0002]),
            ),
            (vga(525.0, 525.0, 320.0, 240.0), Distortion::RadTan4([0.3, 0.1, 0.0, 0.0])),
        ]
        .into_iter()
        .map(|(intrinsics, lens)| CameraModel::new(intrinsics, lens).expect("valid"))
        .collect()
    }

    #[test]
    fn every_rectified_pixel_has_data_and_a_larger_view_does_not() {
        for camera in cameras() {
            let rectified = rectified_intrinsics(&camera).expect("a view");
            let Intrinsics { width, height, .. } = rectified;
            for v in 0..height {
                for u in 0..width {
                    let pixel = raw_pixel(&camera, &rectified, u as f64, v as f64).expect("seen");
                    assert!(pixel.x >= 0.0 && pixel.x <= (width - 1) as f64, "{u} {v} {pixel}");
                    assert!(pixel.y >= 0.0 && pixel.y <= (height - 1) as f64, "{u} {v} {pixel}");
                }
            }
            let view = View {
                left: -rectified.cx / rectified.fx,
                right: ((width - 1) as f64 - rectified.cx) / rectified.fx,
                top: -rectified.cy / rectified.fy,
                bottom: ((height - 1) as f64 - rectified.cy) / rectified.fy,
            };
            let grown = view.scaled(1.01).intrinsics(width, height);
            assert!(!border_has_data(&camera, &grown), "{camera:?} could be wider");
        }
    }

    /// On a coarse grid over all four sides no rectangle is larger.
    #[test]
    fn the_view_is_the_largest_of_all_rectangles() {
        for camera in cameras() {
            let found = rectified_intrinsics(&camera).expect("a view");
            let area = |k: &Intrinsics| 1.0 / (k.fx * k.fy);
            let Intrinsics { width, height, .. } = found;
            let view = View {
                left: -found.cx / found.fx,
                right: ((width - 1) as f64 - found.cx) / found.fx,
                top: -found.cy / found.fy,
                bottom: ((height - 1) as f64 - found.cy) / found.fy,
            };
            let sides = (-4..=4).map(|i| 1.0 + 0.02 * f64::from(i)).collect::<Vec<_>>();
            for &left in &sides {
                for &right in &sides {
                    for &top in &sides {
                        for &bottom in &sides {
                            let other = View {
                                left: view.left * left,
                                right: view.right * right,
                                top: view.top * top,
                                bottom: view.bottom * bottom,
                            }
                            .intrinsics(width, height);
                            let larger = area(&other) > area(&found) * 1.005;
                            assert!(!larger || !border_has_data(&camera, &other), "{other:?}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_pinhole_image_is_copied() {
        let raw = Intrinsics { fx: 20.0, fy: 21.0, cx: 15.0, cy: 16.0, width: 32, height: 33 };
        let camera = CameraModel::new(raw, Distortion::RadTan4([0.0; 4])).expect("valid");
        let identity = Rectification::new(&camera).expect("a view");
        assert!(identity.is_identity());
        assert_eq!(identity.intrinsics(), &raw);
        let image: Vec<u8> = (0..32 * 33).map(|i| (i * 7 % 251) as u8).collect();
        let mut out = vec![0; image.len()];
        assert!(identity.rectify_into(&image, &mut out));
        assert_eq!(image, out);
        assert!(!identity.rectify_into(&image[1..], &mut out));
    }

    /// A smooth scene rendered through each lens comes back as its pinhole rendering.
    #[test]
    fn a_scene_seen_through_the_lens_becomes_its_pinhole_image() {
        let scene = |ray: &Vector3<f64>| {
            let (x, y) = (ray.x / ray.norm(), ray.y / ray.norm());
            127.0 + 60.0 * (9.0 * x + 0.3).sin() + 50.0 * (8.0 * y).cos()
        };
        for camera in cameras() {
            let rectification = Rectification::new(&camera).expect("a view");
            let k = *rectification.intrinsics();
            let mut raw = vec![0u8; k.width * k.height];
            for (i, out) in raw.iter_mut().enumerate() {
                let pixel = Vector2::new((i % k.width) as f64, (i / k.width) as f64);
                let ray = camera.unproject(&pixel);
                *out = ray.map_or(0, |ray| scene(&ray).round() as u8);
            }
            let mut rectified = vec![0u8; raw.len()];
            assert!(rectification.rectify_into(&raw, &mut rectified));
            let depth_pixels = raw.iter().map(|&grey| f32::from(grey)).collect();
            let depth = Image::try_from_pixels(k.width, k.height, depth_pixels).expect("size");
            let depth = rectification.rectify_depth(&depth).expect("same size");
            for (i, &grey) in rectified.iter().enumerate() {
                let (u, v) = ((i % k.width) as f64, (i / k.width) as f64);
                let ray = k.ray(u, v);
                // Two roundings of half a level, plus the curvature of the scene.
                assert!((f64::from(grey) - scene(&ray)).abs() < 1.6, "{u} {v}");
                // Half a pixel diagonal times the steepest slope of the scene.
                assert!((f64::from(depth.pixels()[i]) - scene(&ray)).abs() < 4.0, "{u} {v}");
            }
        }
    }

    #[test]
    fn the_outermost_positions_stay_inside() {
        assert_eq!(split(0.0, 640), (0, 0));
        assert_eq!(split(639.0, 640), (638, 255));
        assert_eq!(split(638.9999, 640), (638, 255));
        assert_eq!(split(12.5, 640), (12, 128));
    }

    #[test]
    fn an_axis_outside_the_image_is_an_error() {
        let raw = Intrinsics { fx: 500.0, fy: 500.0, cx: -5.0, cy: 240.0, width: 640, height: 480 };
        let camera =
            CameraModel::new(raw, Distortion::RadTan4([0.1, 0.0, 0.0, 0.0])).expect("valid");
        let error = Rectification::new(&camera).expect_err("no axis");
        assert!(matches!(error, RectificationError::AxisOutside { .. }));
    }
}
