//! A start beside pixels that a mask hides.

use super::tests::two_views;
use super::*;
use crate::slam::image::NO_DATA;
use crate::slam::test_scene::CAMERA;
use crate::slam::two_frame::system::System;

/// First hidden row.
const ROW: usize = CAMERA.height * 2 / 3;

fn with_hidden_rows(mut pixels: Vec<u8>) -> Vec<u8> {
    pixels[ROW * CAMERA.width..].fill(NO_DATA);
    pixels
}

#[test]
fn hidden_pixels_are_in_no_patch_and_points_behind_them_are_not_visible() {
    let (first, second, moved) = two_views(0.0);
    let mut initializer = TwoFrameInitializer::new(CAMERA, TwoFrameParams::default()).unwrap();
    assert!(initializer.begin(&with_hidden_rows(first.clone())));
    for (level, blocks) in initializer.points.patches.iter().enumerate() {
        assert!(blocks.iter().flat_map(|block| block.weight).all(f32::is_finite), "{level}");
        let used = blocks.iter().flat_map(|block| block.v.iter().zip(&block.weight));
        let lowest = used.filter(|(_, weight)| **weight > 0.0).map(|(v, _)| *v);
        let lowest = lowest.fold(0.0, f32::max);
        // The pattern reaches 2 pixels and its gradients 1.
        assert!(lowest > 0.0 && lowest <= (ROW >> level) as f32 - 4.0 + 1.0, "{level}: {lowest}");
    }
    // Points of the whole first frame, most of whose lower third is hidden in the second.
    assert!(initializer.begin(&first));
    let state = State {
        current_from_first: moved.inverse(),
        brightness: Brightness::default(),
        gain_slopes: None,
        inverse_depths: vec![0.4; initializer.points.pixels.len()],
    };
    let mut visible = |second: &[u8]| {
        initializer.pyramid.fill(second);
        let (images, intrinsics) = (initializer.pyramid.levels(), &initializer.intrinsics);
        let mut system = System::default();
        system.evaluate(&input(images, intrinsics, &initializer.points).level(0), &state);
        assert!(system.energy.is_finite());
        assert!(system.hessian.iter().all(|entry| entry.is_finite()));
        system.num_visible as f64
    };
    let share = visible(&with_hidden_rows(second.clone())) / visible(&second);
    assert!((0.3..0.8).contains(&share), "{share}");
}
