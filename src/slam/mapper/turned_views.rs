//! Similarity of two images whose cameras are rotated far against each other, above all rolled: small images without
//! their slow variation, compared where both see the scene.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::mapper::appearance::{Appearance, COLUMNS, ROWS};

/// Pixels of a small image.
const COUNT: usize = COLUMNS * ROWS;
/// Pixels that are summed in parallel, in the same order on every CPU.
const LANES: usize = 8;
/// Marks a pixel that the camera does not see.
const OUTSIDE: u16 = u16::MAX;

/// Rotations of a camera against a keyframe, and what it sees of the keyframe's image under each if nothing is near.
#[derive(Debug)]
pub(in crate::slam) struct TurnedViews {
    camera: Intrinsics,
    /// `keyframe_from_camera`.
    rotations: Vec<UnitQuaternion<f64>>,
    /// For each of them, the camera's pixel for every pixel of a keyframe's small image.
    pixels: Vec<u16>,
}

/// The rotation under which two images are most similar.
#[derive(Debug, Clone, Copy)]
pub(in crate::slam) struct TurnedView {
    /// `keyframe_from_camera`.
    pub(in crate::slam) rotation: UnitQuaternion<f64>,
    /// Correlation, higher where the views overlap more.
    pub(in crate::slam) score: f32,
}

impl TurnedViews {
    /// Creates the views for images of `camera`.
    pub(in crate::slam) fn new(camera: &Intrinsics) -> Self {
        /// Steps of the rotation about the optical axis: all around.
        const ROLLS: u32 = 24;
        /// Steps of pan and tilt either way, and their degrees: about what a coarse alignment reaches on both sides.
        const STEPS: i32 = 4;
        const STEP_DEG: f64 = 9.0;
        /// Pixels of the keyframe's image that the camera must see: below a quarter, similarity arises by chance.
        const MIN_SEEN: usize = COUNT / 4;
        let mut views = Self { camera: *camera, rotations: Vec::new(), pixels: Vec::new() };
        let about = |axis, angle| UnitQuaternion::from_axis_angle(&axis, angle);
        let step = |k: i32| STEP_DEG.to_radians() * f64::from(k);
        for roll in (0..ROLLS).map(|k| std::f64::consts::TAU * f64::from(k) / f64::from(ROLLS)) {
            for (tilt, pan) in (-STEPS..=STEPS).flat_map(|t| (-STEPS..=STEPS).map(move |p| (t, p)))
            {
                let rotation = about(Vector3::y_axis(), step(pan))
                    * about(Vector3::x_axis(), step(tilt))
                    * about(Vector3::z_axis(), roll);
                let camera_from_keyframe = rotation.inverse().to_rotation_matrix();
                let begin = views.pixels.len();
                views
                    .pixels
                    .extend((0..COUNT).map(|pixel| seen_at(camera, &camera_from_keyframe, pixel)));
                let seen = views.pixels[begin..].iter().filter(|&&at| at != OUTSIDE).count();
                match seen >= MIN_SEEN {
                    true => views.rotations.push(rotation),
                    false => views.pixels.truncate(begin),
                }
            }
        }
        views
    }

    /// Whether the views are for this camera.
    pub(in crate::slam) fn is_for(&self, camera: &Intrinsics) -> bool {
        self.camera == *camera
    }

    /// The view in which each keyframe is most similar to the frame. Both are given by the details of their
    /// [`Appearance`].
    pub(in crate::slam) fn compare(
        &self,
        frame: &[f32],
        keyframes: &[&[f32]],
    ) -> Vec<Option<TurnedView>> {
        let mut best: Vec<Option<TurnedView>> = vec![None; keyframes.len()];
        let (mut seen, mut mask) = ([0.0f32; COUNT], [0.0f32; COUNT]);
        for (rotation, pixels) in self.rotations.iter().zip(self.pixels.chunks_exact(COUNT)) {
            for ((seen, mask), &at) in seen.iter_mut().zip(&mut mask).zip(pixels) {
                let value = frame.get(usize::from(at));
                (*seen, *mask) = value.map_or((0.0, 0.0), |&value| (value, 1.0));
            }
            let count: f32 = mask.iter().sum();
            let mean = seen.iter().sum::<f32>() / count;
            seen.iter_mut().zip(&mask).for_each(|(seen, mask)| *seen -= mean * mask);
            let [squares, ..] = sums(&seen, &seen, &mask);
            for (best, keyframe) in best.iter_mut().zip(keyframes) {
                let [common, theirs, their_squares] = sums(keyframe, &seen, &mask);
                let variances = [squares, their_squares - theirs * theirs / count];
                let Some(score) = score(common, variances, count) else { continue };
                if best.is_none_or(|best| score > best.score) {
                    *best = Some(TurnedView { rotation: *rotation, score });
                }
            }
        }
        best
    }
}

/// What `frame` shows, turned to the view of a keyframe; `rotation` is `keyframe_from_camera`.
pub(in crate::slam) fn turned_back(
    frame: &Appearance,
    camera: &Intrinsics,
    rotation: &UnitQuaternion<f64>,
) -> Appearance {
    let camera_from_keyframe = rotation.inverse().to_rotation_matrix();
    frame.resampled(|pixel| seen_at(camera, &camera_from_keyframe, pixel).into())
}

/// The camera's pixel that sees a distant point at a pixel of the keyframe.
fn seen_at(camera: &Intrinsics, camera_from_keyframe: &Rotation3<f64>, pixel: usize) -> u16 {
    /// Least cosine between a ray and the optical axis: below it a view is stretched without limit.
    const MIN_COSINE: f64 = 0.2;
    let scale_u = camera.width as f64 / COLUMNS as f64;
    let scale_v = camera.height as f64 / ROWS as f64;
    let u = ((pixel % COLUMNS) as f64 + 0.5) * scale_u - 0.5;
    let v = ((pixel / COLUMNS) as f64 + 0.5) * scale_v - 0.5;
    let ray = camera.ray(u, v);
    let ray = camera_from_keyframe * ray.normalize();
    if !(ray.z > MIN_COSINE) {
        return OUTSIDE;
    }
    let column = ((camera.fx * ray.x / ray.z + camera.cx + 0.5) / scale_u).floor();
    let row = ((camera.fy * ray.y / ray.z + camera.cy + 0.5) / scale_v).floor();
    let inside = (0.0..COLUMNS as f64).contains(&column) && (0.0..ROWS as f64).contains(&row);
    if inside { (row as usize * COLUMNS + column as usize) as u16 } else { OUTSIDE }
}

/// Sums of a keyframe's values times the frame's, of its own where the mask is 1, and of their squares.
fn sums(keyframe: &[f32], frame: &[f32; COUNT], mask: &[f32; COUNT]) -> [f32; 3] {
    let mut lanes = [[0.0f32; LANES]; 3];
    let chunks = keyframe.as_chunks::<LANES>().0.iter().zip(frame.as_chunks::<LANES>().0);
    for ((theirs, ours), mask) in chunks.zip(mask.as_chunks::<LANES>().0) {
        for k in 0..LANES {
            let masked = theirs[k] * mask[k];
            lanes[0][k] += theirs[k] * ours[k];
            lanes[1][k] += masked;
            lanes[2][k] += masked * theirs[k];
        }
    }
    lanes.map(|lane| lane.iter().sum())
}

/// Correlation in standard deviations of chance, up to a factor (Fisher's transformation); `None` where there is
/// nothing to compare.
fn score(common: f32, [ours, theirs]: [f32; 2], count: f32) -> Option<f32> {
    /// Variance of the details, grey levels², up to which an image shows nothing.
    const MIN_VARIANCE: f32 = 0.05;
    /// Limits a perfect correlation against rounding.
    const MAX_CORRELATION: f32 = 0.999;
    let least = MIN_VARIANCE * count;
    (ours > least && theirs > least).then(|| {
        (common / (ours * theirs).sqrt()).clamp(-MAX_CORRELATION, MAX_CORRELATION).atanh()
            * count.sqrt()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::test_scene::{CAMERA, Scene};

    fn seen(pose: &SE3, seed: u64) -> Appearance {
        let view = Scene::new(3).render(&CAMERA, pose);
        Appearance::of(&view.noisy(2.0, seed), CAMERA.width, CAMERA.height).unwrap()
    }

    #[test]
    fn a_rolled_and_tilted_view_is_recognised_with_its_rotation() {
        let views = TurnedViews::new(&CAMERA);
        assert!(views.is_for(&CAMERA));
        let about =
            |axis, degrees: f64| UnitQuaternion::from_axis_angle(&axis, degrees.to_radians());
        let turned = |roll, tilt| SE3 {
            rotation: about(Vector3::x_axis(), tilt) * about(Vector3::z_axis(), roll),
            ..SE3::identity()
        };
        let here = seen(&SE3::identity(), 1);
        let away = SE3 { rotation: about(Vector3::y_axis(), 100.0), ..SE3::identity() };
        let elsewhere = seen(&away, 2);
        for (roll, tilt) in [(0.0, 0.0), (110.0, 0.0), (-70.0, 15.0), (180.0, -15.0)] {
            let pose = turned(roll, tilt);
            let frame = seen(&pose, 3);
            let found = views.compare(frame.details(), &[here.details(), elsewhere.details()]);
            let [Some(known), Some(other)] = found[..] else { panic!("{found:?}") };
            let error_deg = known.rotation.angle_to(&pose.rotation).to_degrees();
            assert!(error_deg < 12.0, "{roll} {tilt}: {error_deg}");
            assert!(known.score > 1.2 * other.score, "{roll} {tilt}: {known:?} {other:?}");
        }
    }

    #[test]
    fn a_uniform_image_is_similar_to_nothing_under_any_rotation() {
        let views = TurnedViews::new(&CAMERA);
        let here = seen(&SE3::identity(), 1);
        let wall = [0.0; COUNT];
        assert!(views.compare(&wall, &[here.details()])[0].is_none());
        assert!(views.compare(here.details(), &[&wall])[0].is_none());
    }
}
