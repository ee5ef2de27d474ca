//! The map from above: every point of the cloud and the camera's path through it.

use nalgebra::Vector3;

use crate::service::results::Results;
use crate::service::results::colour::{Picture, Rgb, rainbow};
use crate::service::results::report::axis::round_step;
use crate::service::results::report::html::png_address;
use crate::service::results::report::number_text::{grouped, without_zeros};
use crate::service::results::report::views::Views;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::evaluation::statistics::percentiles;
use crate::slam::fusion::SurfacePoint;
use crate::slam::trajectory::StampedPose;

/// Width of the picture, pixels: sharp on a page at twice the density of its layout.
const WIDTH: usize = 1600;

/// Largest height, as a share of the width.
const MAX_HEIGHT_RATIO: f64 = 0.7;

/// Share of the points at either end that the picture leaves out: outliers would shrink the rest.
const CUT_SHARE: f64 = 0.01;

/// Margin around the content, as a share of it.
const MARGIN_RATIO: f64 = 0.02;

/// Points on a pixel that make it nearly as bright as possible.
const POINTS_FOR_BRIGHT: f64 = 6.0;

/// Part of the rainbow that is used: its ends are as dark as the background.
const LOWEST_COLOUR: f64 = 0.14;
const HIGHEST_COLOUR: f64 = 0.92;

const GROUND: Rgb = [16, 20, 27];
const WAY: Rgb = [255, 255, 255];

/// Smallest share of the picture's width for its scale bar; the largest is two and a half times as much.
const MIN_BAR_SHARE: f64 = 0.14;

/// The map from above.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPicture {
    /// Points and path.
    pub picture: Picture,
    /// Length across the picture's width, map units.
    pub width: f64,
    /// Height between the ends of the colour scale, map units.
    pub height_range: f64,
}

/// The section; empty without points.
pub fn map_section(results: &Results<'_>, up: Option<Vector3<f64>>) -> String {
    let map = map_picture(&results.surface, &results.trajectory, up);
    let Some(map) = map else { return String::new() };
    let Some(png) = map.picture.png() else { return String::new() };
    let unit = if results.record.depth_scale == DepthScale::Given { "m" } else { "map units" };
    let metres = results.evaluation.as_ref().filter(|_| unit != "m").map(|of| of.alignment.scale);
    let about_up = match up {
        Some(_) => "up is estimated from how the camera was held and from horizontal surfaces",
        None => "the up direction is unknown: the view is along the path's shortest extent",
    };
    format!(
        "<section><h2>Map from above</h2><figure><div class=\"map\"><img alt=\"map from above\" src=\"{}\">{}</div>\
         <figcaption>{} points, coloured by height: <span class=\"scale near-far\"></span> low to high, {} {unit} apart. \
         The camera's path is white; {about_up}.</figcaption></figure></section>",
        png_address(&png),
        scale_bar(map.width, unit, metres),
        grouped(results.surface.len() as u64),
        significant(map.height_range)
    )
}

/// A scale bar for a picture of this width, with its length, also in metres where the map unit is known.
fn scale_bar(width: f64, unit: &str, metres_per_unit: Option<f64>) -> String {
    let length = round_step(MIN_BAR_SHARE * width);
    let metres = metres_per_unit.map(|scale| format!(" = {} m", significant(length * scale)));
    let unit = if length == 1.0 { unit.trim_end_matches('s') } else { unit };
    format!(
        "<div class=\"scale-bar\" style=\"width:{:.2}%\"><span>{} {unit}{}</span></div>",
        100.0 * length / width,
        significant(length),
        metres.unwrap_or_default()
    )
}

/// A number with two significant digits, in full.
fn significant(number: f64) -> String {
    let decimals = 1.0 - number.abs().max(f64::MIN_POSITIVE).log10().floor();
    without_zeros(&format!("{number:.*}", decimals.clamp(0.0, 12.0) as usize)).to_owned()
}

/// Points and path from above, coloured by height (blue low, red high); `None` without points.
pub fn map_picture(
    cloud: &[SurfacePoint],
    path: &[StampedPose],
    up: Option<Vector3<f64>>,
) -> Option<MapPicture> {
    let views = Views::of(path, up);
    let position = |point: &SurfacePoint| Vector3::from(point.position.map(f64::from));
    let flat: Vec<[f64; 3]> = cloud
        .iter()
        .map(position)
        .filter(|p| p.iter().all(|c| c.is_finite()))
        .map(|p| {
            let ([x, y], [_, height]) = (views.seen_from_above(&p), views.seen_from_side(&p));
            [x, y, height]
        })
        .collect();
    let path: Vec<[f64; 2]> = path
        .iter()
        .map(|pose| views.seen_from_above(&pose.world_from_camera.translation))
        .collect();
    let mut ranges = [[0.0; 2]; 3];
    for (axis, range) in ranges.iter_mut().enumerate() {
        let ends = percentiles(flat.iter().map(|p| p[axis]), [CUT_SHARE, 1.0 - CUT_SHARE]);
        *range = ends.filter(|[low, high]| high > low)?;
    }
    for (axis, range) in ranges.iter_mut().take(2).enumerate() {
        for point in &path {
            *range = [range[0].min(point[axis]), range[1].max(point[axis])];
        }
        let margin = MARGIN_RATIO * (range[1] - range[0]);
        *range = [range[0] - margin, range[1] + margin];
    }
    let [_, _, [low, high]] = ranges;
    let (picture, width) = draw(&flat, &path, &ranges);
    Some(MapPicture { picture, width, height_range: high - low })
}

/// The picture, and the length across its width.
fn draw(points: &[[f64; 3]], path: &[[f64; 2]], ranges: &[[f64; 2]; 3]) -> (Picture, f64) {
    let [x, y, z] = ranges;
    let (x_width, y_width) = (x[1] - x[0], y[1] - y[0]);
    let tallest = MAX_HEIGHT_RATIO * WIDTH as f64;
    let pixels_per_unit = (WIDTH as f64 / x_width).min(tallest / y_width);
    let height = ((y_width * pixels_per_unit).ceil() as usize).clamp(1, tallest as usize);
    let x_offset = 0.5 * (WIDTH as f64 - x_width * pixels_per_unit);
    let pixel = |px: f64, py: f64| {
        let (u, v) = (x_offset + (px - x[0]) * pixels_per_unit, (y[1] - py) * pixels_per_unit);
        let inside = u >= 0.0 && v >= 0.0 && u < WIDTH as f64 && v < height as f64;
        inside.then(|| v as usize * WIDTH + u as usize)
    };
    let mut counts = vec![(0u32, 0.0f64); WIDTH * height];
    for &[px, py, pz] in points {
        // Two pixels wide and high: single pixels fade where a page shows the picture smaller.
        let half = 0.5 / pixels_per_unit;
        for (dx, dy) in [(-half, -half), (-half, half), (half, -half), (half, half)] {
            if let Some(i) = pixel(px + dx, py + dy) {
                counts[i].0 += 1;
                counts[i].1 += pz;
            }
        }
    }
    let colour = |&(count, sum): &(u32, f64)| {
        if count == 0 {
            return GROUND;
        }
        let share = (sum / f64::from(count) - z[0]) / (z[1] - z[0]);
        // A single point is visible; more make it brighter.
        let bright = 1.0 - 0.65 * (-f64::from(count) / POINTS_FOR_BRIGHT).exp();
        let full =
            rainbow(LOWEST_COLOUR + (HIGHEST_COLOUR - LOWEST_COLOUR) * share.clamp(0.0, 1.0));
        std::array::from_fn(|c| {
            (f64::from(GROUND[c]) * (1.0 - bright) + f64::from(full[c]) * bright) as u8
        })
    };
    let mut picture = Picture { width: WIDTH, height, pixels: counts.iter().map(colour).collect() };
    for step in path.windows(2) {
        draw_step(&mut picture, step, pixels_per_unit, &pixel);
    }
    (picture, WIDTH as f64 / pixels_per_unit)
}

/// Draws a white stroke three pixels wide from one position to the next.
fn draw_step(
    picture: &mut Picture,
    step: &[[f64; 2]],
    pixels_per_unit: f64,
    pixel: &dyn Fn(f64, f64) -> Option<usize>,
) {
    let [from, to] = [step[0], step[1]];
    let length = (to[0] - from[0]).hypot(to[1] - from[1]) * pixels_per_unit;
    let strokes = (length.ceil() as usize).clamp(1, WIDTH * 2);
    for i in 0..=strokes {
        let share = i as f64 / strokes as f64;
        let at = [0, 1].map(|c| from[c] + share * (to[c] - from[c]));
        let one = 1.0 / pixels_per_unit;
        for (dx, dy) in [(0.0, 0.0), (one, 0.0), (-one, 0.0), (0.0, one), (0.0, -one)] {
            if let Some(i) = pixel(at[0] + dx, at[1] + dy) {
                picture.pixels[i] = WAY;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;

    fn point(x: f32, y: f32, z: f32) -> SurfacePoint {
        SurfacePoint { position: [x, y, z], ..SurfacePoint::default() }
    }

    #[test]
    fn points_and_path_are_visible_and_outliers_do_not_shrink_them() {
        let mut cloud: Vec<SurfacePoint> = (0..5000)
            .map(|i| point((i % 100) as f32, (i / 500) as f32, (i / 100) as f32))
            .collect();
        cloud.extend([point(1e9, 0.0, 0.0), point(f32::NAN, 0.0, 0.0)]);
        let path = [0.0, 50.0].map(|x| StampedPose {
            nanos: 0,
            world_from_camera: SE3 { translation: [x, 0.0, 10.0].into(), ..SE3::identity() },
        });
        let map = map_picture(&cloud, &path, None).unwrap();
        assert!((90.0..140.0).contains(&map.width), "{}", map.width);
        let picture = map.picture;
        let seen = picture.pixels.iter().filter(|&&p| p != GROUND && p != WAY).count();
        assert!(seen > 3000, "{seen} of 5000 points are seen");
        assert!(picture.pixels.iter().filter(|&&p| p == WAY).count() > 700);
        assert_eq!(map_picture(&[], &path, None), None);
        assert_eq!(map_picture(&cloud[..1], &[], None), None);
    }

    #[test]
    fn the_scale_bar_has_a_round_length_and_metres_where_known() {
        let bar = scale_bar(6.2, "map units", Some(0.43));
        assert!(bar.contains("width:16.13%") && bar.contains(">1 map unit = 0.43 m<"), "{bar}");
        let bar = scale_bar(1300.0, "m", None);
        assert!(bar.contains("width:15.38%") && bar.contains(">200 m<"), "{bar}");
        assert!(scale_bar(0.03, "map units", None).contains(">0.005 map units<"));
    }
}
