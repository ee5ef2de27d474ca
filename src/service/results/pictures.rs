//! Pictures of a keyframe's depth map: inverse depth, variance, density.

use crate::service::results::colour::{Picture, Rgb, heat, rainbow};
use crate::slam::evaluation::statistics::percentiles;
use crate::slam::keyframe::{DepthPoint, Keyframe};

/// Brightness of the image behind a depth map: dark enough for colours to stand out.
const BACKGROUND_GAIN: f64 = 0.45;

/// Share of the points at either end that the scale leaves out: outliers.
const CLIPPED_SHARE: f64 = 0.02;

/// σ/d at the lower and upper end of the variance scale, which is logarithmic.
pub const RELATIVE_STD_DEV_RANGE: [f64; 2] = [0.003, 0.3];

/// Side of the blocks whose density is shown, pixels.
const DENSITY_BLOCK: usize = 16;

/// Inverse depth in colour (red near, blue far) over the darkened image, with the values at the ends of the scale.
/// Points with σ/d above `max_relative_std_dev` are left out.
pub fn inverse_depth_picture(
    keyframe: &Keyframe,
    max_relative_std_dev: f64,
) -> (Picture, Option<[f64; 2]>) {
    let shown = keyframe.points.iter().filter(|point| is_known(point, max_relative_std_dev));
    let points: Vec<&DepthPoint> = shown.collect();
    let mut picture = background(keyframe);
    let range = middle_range(points.iter().map(|p| f64::from(p.inverse_depth)));
    let Some([far, near]) = range else { return (picture, None) };
    let width = (near - far).max(f64::MIN_POSITIVE);
    for point in points {
        let share = (f64::from(point.inverse_depth) - far) / width;
        paint(&mut picture, point, rainbow(share));
    }
    (picture, Some([far, near]))
}

/// Lower and upper end of the values without the outliers at either end; `None` where there are no values.
pub fn middle_range(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    percentiles(values, [CLIPPED_SHARE, 1.0 - CLIPPED_SHARE])
}

/// σ/d of every point in colour (bright: uncertain), logarithmic over [`RELATIVE_STD_DEV_RANGE`].
pub fn variance_picture(keyframe: &Keyframe) -> Picture {
    let mut picture = background(keyframe);
    let [low, high] = RELATIVE_STD_DEV_RANGE;
    for point in keyframe.points.iter().filter(|p| p.inverse_depth > 0.0) {
        let share = (relative_std_dev(point) / low).ln() / (high / low).ln();
        paint(&mut picture, point, heat(share));
    }
    picture
}

/// Share of pixels with depth, per block.
pub fn density_picture(keyframe: &Keyframe) -> Picture {
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let columns = width.div_ceil(DENSITY_BLOCK);
    let mut counts = vec![0u32; columns * height.div_ceil(DENSITY_BLOCK)];
    let block = |u: usize, v: usize| v / DENSITY_BLOCK * columns + u / DENSITY_BLOCK;
    for point in &keyframe.points {
        let (u, v) = (usize::from(point.u), usize::from(point.v));
        if u < width && v < height {
            counts[block(u, v)] += 1;
        }
    }
    let full = (DENSITY_BLOCK * DENSITY_BLOCK) as f64;
    let colour = |i: usize| heat(f64::from(counts[block(i % width, i / width)]) / full);
    Picture { width, height, pixels: (0..width * height).map(colour).collect() }
}

/// Whether a point's σ/d is at most `max_relative_std_dev`.
pub fn is_known(point: &DepthPoint, max_relative_std_dev: f64) -> bool {
    point.inverse_depth > 0.0 && relative_std_dev(point) <= max_relative_std_dev
}

fn relative_std_dev(point: &DepthPoint) -> f64 {
    f64::from(point.variance).sqrt() / f64::from(point.inverse_depth)
}

/// The keyframe's image, darkened; black where it has none.
pub fn background(keyframe: &Keyframe) -> Picture {
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let dark = |grey: &u8| [(f64::from(*grey) * BACKGROUND_GAIN) as u8; 3];
    let mut pixels: Vec<Rgb> = keyframe.image.iter().map(dark).collect();
    pixels.resize(width * height, [0; 3]);
    Picture { width, height, pixels }
}

fn paint(picture: &mut Picture, point: &DepthPoint, colour: Rgb) {
    picture.paint(usize::from(point.u), usize::from(point.v), colour);
}
