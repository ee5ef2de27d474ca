//! The effect of depth variance on the weights of a keyframe's points, for three motions of the camera.

use nalgebra::Vector6;

use crate::service::results::colour::{Picture, Rgb, heat, rainbow};
use crate::service::results::lettering::{text_size, write_text};
use crate::service::results::pictures::{background, middle_range};
use crate::slam::alignment::reference::{Reference, ReferenceParams, ReferenceScratch, num_levels};
use crate::slam::alignment::weights::{PointWeight, point_weights};
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid};
use crate::slam::keyframe::{Keyframe, MAX_KEYFRAME_POINTS};
use crate::slam::tracker::TrackerParams;

/// Pixels between panels and around them.
const GAP: usize = 8;

/// Pixels of a caption's dots, and of its line with the space around it.
const DOT: usize = 2;
const CAPTION_HEIGHT: usize = 30;

/// Size of the colour scale below a panel.
const SCALE: [usize; 2] = [120, 12];

const GROUND: Rgb = [255, 255, 255];
const INK: Rgb = [28, 34, 48];

/// The keyframe with its inverse depth, then the weights 1/σ_r² of its points for a pure rotation, a translation along
/// z and one along x, each as a share of the weight without depth variance (Engel, Schöps, Cremers 2014, fig. 4). On
/// the finest tracked level, with the weighting and the typical translation of `params`; the rotation moves the image
/// as far. `None` where frames cannot be aligned to the keyframe.
pub fn weight_picture(keyframe: &Keyframe, params: &TrackerParams) -> Option<Picture> {
    let level = params.reference.finest_level;
    // Every point that the tracker could select.
    let all = ReferenceParams {
        point_budget: [MAX_KEYFRAME_POINTS; MAX_LEVELS],
        ..params.reference.clone()
    };
    let mut reference = Reference::new(all);
    reference.prepare_into(keyframe, &mut ReferenceScratch::default());
    if reference.level(level).is_empty() {
        return None;
    }
    let (width, height) = (keyframe.intrinsics.width, keyframe.intrinsics.height);
    let mut pyramid = SumPyramid::with_size(width, height, num_levels(width, height), level);
    pyramid.fill(&keyframe.image);
    let weights = |axis: usize, size: f64| {
        let mut twist = Vector6::zeros();
        twist[axis] = size;
        point_weights(&reference, &pyramid, level, &SE3::exp(&twist), &params.alignment)
    };
    let rotation = f64::from(params.reference.selection.typical_translation);
    let translation = rotation / reference.mean_inverse_depth();
    let still = weights(0, 0.0);
    let [far, near] = middle_range(still.iter().map(|point| f64::from(point.inverse_depth)))?;
    let depth_share =
        |point: &PointWeight| (f64::from(point.inverse_depth) - far) / (near - far).max(1e-9);
    let ground = halved(background(keyframe), level);
    let panel = |caption, points: &[PointWeight]| Panel {
        caption,
        picture: painted(&ground, points, |point| heat(f64::from(point.weight))),
        ends: ["0", "1"],
        colour: heat,
    };
    Some(side_by_side(&[
        Panel {
            caption: "inverse depth",
            picture: painted(&ground, &still, |point| rainbow(depth_share(point))),
            ends: ["far", "near"],
            colour: rainbow,
        },
        panel("weight, rotation", &weights(4, rotation)),
        panel("weight, along z", &weights(2, translation)),
        panel("weight, along x", &weights(0, translation)),
    ]))
}

/// A picture with its caption and the meaning of its colours.
struct Panel {
    caption: &'static str,
    picture: Picture,
    ends: [&'static str; 2],
    colour: fn(f64) -> Rgb,
}

fn painted(
    ground: &Picture,
    points: &[PointWeight],
    colour: impl Fn(&PointWeight) -> Rgb,
) -> Picture {
    let mut picture = ground.clone();
    for point in points {
        picture.paint(point.column, point.row, colour(point));
    }
    picture
}

/// Every 2ˡ-th pixel of every 2ˡ-th row.
fn halved(picture: Picture, level: usize) -> Picture {
    let (width, height) = (picture.width >> level, picture.height >> level);
    let pixel = |i: usize| {
        let (column, row) = ((i % width) << level, (i / width) << level);
        picture.pixels[row * picture.width + column]
    };
    Picture { width, height, pixels: (0..width * height).map(pixel).collect() }
}

fn side_by_side(panels: &[Panel]) -> Picture {
    let widest = panels.iter().map(|panel| panel.picture.width).max().unwrap_or(0);
    let highest = panels.iter().map(|panel| panel.picture.height).max().unwrap_or(0);
    let width = panels.len() * (widest + GAP) + GAP;
    let height = highest + 2 * CAPTION_HEIGHT;
    let mut page = Picture { width, height, pixels: vec![GROUND; width * height] };
    let middle = |height: usize| CAPTION_HEIGHT.saturating_sub(height) / 2;
    for (index, panel) in panels.iter().enumerate() {
        let left = index * (widest + GAP) + GAP;
        let [_, text_height] = text_size(panel.caption, DOT);
        write_text(&mut page, [left, middle(text_height)], DOT, INK, panel.caption);
        for (row, pixels) in panel.picture.pixels.chunks(panel.picture.width).enumerate() {
            let start = (CAPTION_HEIGHT + row) * width + left;
            page.pixels[start..start + pixels.len()].copy_from_slice(pixels);
        }
        let below = CAPTION_HEIGHT + highest;
        let [low, high] = panel.ends;
        let scale = left + text_size(low, DOT)[0] + GAP;
        write_text(&mut page, [left, below + middle(text_height)], DOT, INK, low);
        draw_scale(&mut page, [scale, below + middle(SCALE[1])], panel.colour);
        let right = scale + SCALE[0] + GAP;
        write_text(&mut page, [right, below + middle(text_height)], DOT, INK, high);
    }
    page
}

fn draw_scale(page: &mut Picture, [left, top]: [usize; 2], colour: fn(f64) -> Rgb) {
    for x in 0..SCALE[0] {
        let colour = colour(x as f64 / (SCALE[0] - 1) as f64);
        (0..SCALE[1]).for_each(|y| page.paint(left + x, top + y, colour));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::alignment::scene::{small_camera, small_plane};

    #[test]
    fn a_rotation_keeps_every_weight_and_a_translation_does_not() {
        let keyframe = small_plane().keyframe(&small_camera(), 1, 0.1);
        let params = TrackerParams::default();
        let picture = weight_picture(&keyframe, &params).unwrap();
        assert_eq!(
            (picture.width, picture.height),
            (4 * (160 + GAP) + GAP, 120 + 2 * CAPTION_HEIGHT)
        );
        // Colours of a panel's points: pixels that are not grey.
        let coloured = |panel: usize| -> Vec<Rgb> {
            let left = GAP + panel * (160 + GAP);
            let rows = picture.pixels.chunks(picture.width).skip(CAPTION_HEIGHT).take(120);
            let pixels = rows.flat_map(|row| &row[left..left + 160]).copied();
            pixels.filter(|[r, g, b]| r != g || g != b).collect()
        };
        let full = heat(1.0);
        let [depth, rotation, along_z, along_x] = [0, 1, 2, 3].map(coloured);
        assert!(depth.len() > 5000 && rotation.len() > 4000);
        assert!(rotation.iter().all(|&colour| colour == full));
        for translation in [along_z, along_x] {
            let less = translation.iter().filter(|&&colour| colour != full).count();
            assert!(less > translation.len() / 4, "{less} of {}", translation.len());
        }
        let empty = Keyframe { points: Vec::new(), ..keyframe };
        assert_eq!(weight_picture(&empty, &params), None);
    }
}
