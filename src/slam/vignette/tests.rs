//! Rendered images of a turning camera behind lenses with known vignettes.

use nalgebra::UnitQuaternion;

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::NO_DATA;
use crate::slam::test_scene::{CAMERA, Scene};

/// Light at a squared distance of a lens that loses half of it in the corners.
fn lens(squared: f64) -> f64 {
    1.0 - 0.3 * squared - 0.2 * squared * squared
}

/// The scene `place` images after the first, from a camera that looks around, and behind the lens if it has one. The
/// exposure changes slowly.
fn seen(place: u32, speed: f64, light: fn(f64) -> f64) -> Vec<u8> {
    let time = speed * f64::from(place);
    let turn = Vector3::new(0.2 * (0.9 * time).sin(), 0.3 * time.sin(), 0.1 * (0.7 * time).sin());
    let translation = Vector3::new(0.0, 0.05 * time, 0.1 * time.sin());
    let pose = SE3 { rotation: UnitQuaternion::from_scaled_axis(turn), translation };
    let exposure = 0.7 + 0.1 * (0.2 * f64::from(place)).sin();
    let squared = squared_distance(&CAMERA, farthest_corner(&CAMERA));
    let pixels = Scene::new(1).render(&CAMERA, &pose).noisy(2.0, u64::from(place));
    let darkened = |(index, grey): (usize, &u8)| {
        let (u, v) = (index % CAMERA.width, index / CAMERA.width);
        (exposure * light(squared(u as f64, v as f64)) * f64::from(*grey)).round().max(1.0) as u8
    };
    pixels.iter().enumerate().map(darkened).collect()
}

/// The image after which it is undone, and the light in the corners.
fn found(vignette: &mut Vignette, speed: f64, light: fn(f64) -> f64) -> Option<(u32, f64)> {
    const MOST: u32 = 120;
    (0..MOST).find_map(|place| Some((place, vignette.follow(&seen(place, speed, light))?)))
}

#[test]
fn a_vignette_is_found_and_undone() {
    let mut vignette = Vignette::new(&CAMERA);
    let mut early = seen(0, 0.1, lens);
    vignette.undo(&mut early);
    assert!(early == seen(0, 0.1, lens) && vignette.light_in_corners().is_none());
    let (place, light) = found(&mut vignette, 0.1, lens).unwrap();
    assert!((light - 0.5).abs() < 0.04, "{light} after {place}");
    assert_eq!(vignette.light_in_corners(), Some(light));
    // It is decided once.
    assert_eq!(vignette.follow(&seen(0, 0.1, |_| 1.0)), None);
    for place in [0, 20] {
        let even = seen(place, 0.1, |_| 1.0);
        let raw = seen(place, 0.1, lens);
        let mut undone = raw.clone();
        vignette.undo(&mut undone);
        let ratio = |pixels: &[u8], squared_range: std::ops::Range<f64>| {
            let squared = squared_distance(&CAMERA, farthest_corner(&CAMERA));
            let is_in = |index: usize| {
                let (u, v) = ((index % CAMERA.width) as f64, (index / CAMERA.width) as f64);
                squared_range.contains(&squared(u, v))
            };
            let inside = (0..pixels.len()).filter(|&index| is_in(index));
            let sums = inside.fold([0.0, 0.0], |[of, to], index| {
                [of + f64::from(pixels[index]), to + f64::from(even[index])]
            });
            sums[0] / sums[1]
        };
        for begin in [0.0, 0.3, 0.6, 0.8] {
            let range = begin..begin + 0.2;
            let (before, now) = (ratio(&raw, range.clone()), ratio(&undone, range));
            assert!((now - 1.0).abs() < 0.03, "{begin}: {before} {now}");
        }
    }
}

#[test]
fn a_lens_that_loses_little_is_left_alone() {
    for light in [(|_| 1.0) as fn(f64) -> f64, |squared| 1.0 - 0.1 * squared] {
        let mut vignette = Vignette::new(&CAMERA);
        assert_eq!(found(&mut vignette, 0.1, light), None);
        assert!(matches!(vignette.stage, Stage::Even));
        let image = seen(3, 0.1, light);
        let mut undone = image.clone();
        vignette.undo(&mut undone);
        assert!(undone == image);
    }
}

#[test]
fn without_motion_nothing_is_decided() {
    let mut vignette = Vignette::new(&CAMERA);
    assert_eq!(found(&mut vignette, 0.0, lens), None);
    assert!(matches!(vignette.stage, Stage::Estimated(_)));
}

#[test]
fn repeated_images_and_steps_of_the_exposure_do_not_matter() {
    let mut vignette = Vignette::new(&CAMERA);
    let of = |place: u32| {
        let mut pixels = seen(place / 2, 0.1, lens);
        if place / 2 % 2 == 1 {
            pixels.iter_mut().for_each(|grey| *grey = (0.8 * f64::from(*grey)).round() as u8);
        }
        pixels
    };
    let light = (0..200).find_map(|place| vignette.follow(&of(place))).unwrap();
    assert!((light - 0.5).abs() < 0.04, "{light}");
}

#[test]
fn a_level_has_the_distances_of_the_image() {
    let camera = Intrinsics { fy: 0.8 * CAMERA.fy, ..CAMERA };
    let level = camera.at_level(2);
    let corner = farthest_corner(&camera);
    let (of_image, of_level) =
        (squared_distance(&camera, corner), squared_distance(&level, corner));
    // Pixel 5 of the level covers pixels 20 to 23.
    assert!((of_image(21.5, 41.5) - of_level(5.0, 10.0)).abs() < 1e-9);
    let right = camera.width as f64 - 1.0;
    assert!((of_image(right, camera.height as f64 - 1.0) - 1.0).abs() < 0.02);
}

#[test]
fn images_on_both_sides_of_a_jump_are_not_compared() {
    let mut vignette = Vignette::new(&CAMERA);
    let compared = |vignette: &Vignette| match &vignette.stage {
        Stage::Estimated(estimate) => estimate.information.trace(),
        _ => f64::NAN,
    };
    let before = compared(&vignette);
    vignette.follow(&seen(0, 0.1, lens));
    vignette.restart();
    vignette.follow(&seen(1, 0.1, lens));
    assert_eq!(compared(&vignette), before);
    vignette.follow(&seen(2, 0.1, lens));
    assert!(compared(&vignette) > before);
}

#[test]
fn any_image_is_taken() {
    let mut vignette = Vignette::new(&CAMERA);
    for place in 0..20 {
        let size = CAMERA.width * CAMERA.height;
        for pixels in [vec![NO_DATA; size], vec![255; size], vec![200; 7], vec![], vec![100; size]]
        {
            assert_eq!(vignette.follow(&pixels), None, "{place}");
        }
    }
    let factors = factors(&CAMERA, &Vector3::new(-9.0, 0.0, 0.0));
    vignette.stage = Stage::Undone { factors, light: 0.1 };
    // No data stays without, and nothing overflows.
    let mut pixels = vec![NO_DATA; CAMERA.width * CAMERA.height];
    pixels[1..3].fill(255);
    pixels[3] = 10;
    vignette.undo(&mut pixels);
    assert_eq!(pixels[..5], [NO_DATA, 255, 255, 40, NO_DATA]);
    vignette.undo(&mut [1; 9]);
}
