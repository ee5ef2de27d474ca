//! Points of the active keyframe that will be estimated jointly once they are mature in the interval filter, alongside
//! the Gaussian map that frames are tracked on.

use crate::slam::depth::candidate::CandidateParams;
use crate::slam::depth::gradient_image::GradientImage;
use crate::slam::depth::immature::{IntervalParams, TraceFrame};
use crate::slam::depth::interval::IntervalFilter;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::DepthPoint;
use crate::slam::map::Correction;
use crate::slam::window::candidates::MaturePoints;

/// Most keyframes whose points are kept until they are taken: some are left during an estimate. Where none are taken,
/// as during a start or while the window is out, the oldest are dropped; their points then come from their depth.
const MAX_LISTS: usize = 16;

/// Candidates of the active keyframe, in the unit of its depth buffer, and the mature points of keyframes that were
/// left.
#[derive(Debug, Default)]
pub(super) struct Maturing {
    filter: IntervalFilter,
    /// Whether they were traced in a frame.
    is_traced: bool,
    /// Mature points of keyframes that were left, until the window takes them.
    pub(super) left: Vec<MaturePoints>,
}

impl Maturing {
    /// Chooses the pixels of a new active keyframe.
    pub(super) fn restart(&mut self, image: &GradientImage, params: &CandidateParams) {
        self.filter.restart(image, params);
        self.is_traced = false;
    }

    /// Forgets the candidates of the active keyframe.
    pub(super) fn clear(&mut self) {
        self.filter.clear();
        self.is_traced = false;
    }

    /// Traces the candidates in a frame.
    pub(super) fn trace(&mut self, frame: &TraceFrame<'_>, params: &IntervalParams) {
        if !self.filter.points().is_empty() {
            self.filter.trace(frame, params);
            self.is_traced = true;
        }
    }

    /// Keeps the mature points of the keyframe that is being left; `unit` is the unit of its depth buffer in the
    /// keyframe's. A keyframe on which no frame was tracked leaves no list: its depth is all that is known of it.
    pub(super) fn keep_points(
        &mut self,
        keyframe_id: u64,
        image: &GradientImage,
        unit: f64,
        params: &IntervalParams,
    ) {
        if self.is_traced {
            let inverse_unit = (1.0 / unit) as f32;
            let points = self.filter.mature(params).map(|of| DepthPoint {
                u: of.u,
                v: of.v,
                inverse_depth: of.inverse_depth * inverse_unit,
                variance: of.variance * (inverse_unit * inverse_unit),
                intensity: f32::from(image.intensity.at(usize::from(of.u), usize::from(of.v))),
            });
            let points = points.collect();
            self.left.retain(|left| left.keyframe_id != keyframe_id);
            let surplus = (self.left.len() + 1).saturating_sub(MAX_LISTS);
            self.left.drain(..surplus);
            self.left.push(MaturePoints { keyframe_id, points });
        }
        self.clear();
    }

    /// Multiplies the inverse depths of the active keyframe's points by `factor`.
    pub(super) fn rescale(&mut self, factor: f32) {
        self.filter.rescale(factor);
    }

    /// The same with a separate factor for every pixel `(u, v)`.
    pub(super) fn rescale_by(&mut self, factor_at: impl Fn(usize, usize) -> f32) {
        self.filter.rescale_by(factor_at);
    }

    /// Corrects the points of keyframes that were left as their depth is corrected.
    pub(super) fn correct(&mut self, correction: &Correction, intrinsics: &Intrinsics) {
        for left in &mut self.left {
            let mut corrected = correction.keyframes.iter();
            if let Some(corrected) = corrected.find(|of| of.keyframe_id == left.keyframe_id) {
                corrected.depth.apply(intrinsics, &mut left.points);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::depth::epipolar::TwoView;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::image::quads::QuadImage;
    use crate::slam::map::{KeyframeCorrection, LogPlane};
    use crate::slam::pose::Brightness;
    use crate::slam::test_scene::{CAMERA, Rendering, Scene};

    /// Unit of the depth buffer, in the keyframe's.
    const UNIT: f64 = 2.0;
    const KEYFRAME: u64 = 5;

    fn at(x: f64) -> SE3 {
        SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() }
    }

    /// Candidates of the scene's first view after this many frames, and the view.
    fn traced(frames: u64) -> (Maturing, GradientImage, Rendering) {
        let scene = Scene::new(3);
        let view = scene.render(&CAMERA, &at(0.0));
        let mut image = GradientImage::with_size(CAMERA.width, CAMERA.height);
        image.fill(&view.noisy(1.0, 0));
        let mut maturing = Maturing::default();
        maturing.restart(&image, &CandidateParams::default());
        let mut quads = QuadImage::with_size(CAMERA.width, CAMERA.height);
        for k in 1..=frames {
            let x = 0.03 * k as f64;
            quads.fill(&scene.render(&CAMERA, &at(x)).noisy(1.0, k));
            let view = TwoView::new(&CAMERA, &at(-x / UNIT));
            let frame = TraceFrame { image: &quads, view, brightness: Brightness::default() };
            maturing.trace(&frame, &IntervalParams::default());
        }
        (maturing, image, view)
    }

    #[test]
    fn only_mature_points_are_left_and_in_the_keyframes_unit() {
        let params = IntervalParams::default();
        for frames in [1, 8] {
            let (mut maturing, image, view) = traced(frames);
            let of_filter = maturing.filter.points().iter();
            let mature: Vec<_> = of_filter.filter(|p| p.is_mature(&params)).cloned().collect();
            let all = maturing.filter.points().len();
            maturing.keep_points(KEYFRAME, &image, UNIT, &params);
            assert!(maturing.filter.points().is_empty());
            let [left] = &maturing.left[..] else { panic!("one keyframe was left") };
            let pixels = |points: &[DepthPoint]| -> Vec<_> {
                points.iter().map(|point| (point.u, point.v)).collect()
            };
            assert_eq!(left.keyframe_id, KEYFRAME);
            let of_mature: Vec<_> = mature.iter().map(|point| (point.u, point.v)).collect();
            assert_eq!(pixels(&left.points), of_mature);
            // The baseline of one frame matures no point, that of eight not all.
            let fewest = if frames == 1 { 0 } else { 500 };
            assert!((fewest..all).contains(&of_mature.len()), "{} of {all}", of_mature.len());
            let is_right = |point: &&DepthPoint| {
                let (u, v) = (usize::from(point.u), usize::from(point.v));
                (point.inverse_depth / view.inverse_depth.at(u, v) - 1.0).abs() < 0.1
            };
            let right = left.points.iter().filter(is_right).count();
            assert!(10 * right >= 9 * of_mature.len(), "{right} of {} right", of_mature.len());
        }
    }

    #[test]
    fn points_that_are_not_taken_are_kept_once_for_each_of_the_last_keyframes() {
        let (mut maturing, image, _) = traced(1);
        let last = MAX_LISTS as u64 + 3;
        for keyframe_id in (0..=last).flat_map(|id| [id, id]) {
            maturing.is_traced = true;
            maturing.keep_points(keyframe_id, &image, UNIT, &IntervalParams::default());
        }
        let kept: Vec<u64> = maturing.left.iter().map(|left| left.keyframe_id).collect();
        assert_eq!(kept, Vec::from_iter(4..=last));
    }

    #[test]
    fn a_keyframe_without_a_frame_leaves_no_list() {
        let (mut maturing, image, _) = traced(0);
        maturing.keep_points(KEYFRAME, &image, UNIT, &IntervalParams::default());
        assert!(maturing.left.is_empty());
    }

    #[test]
    fn points_that_were_left_are_corrected_with_their_keyframe() {
        let (mut maturing, image, _) = traced(8);
        maturing.keep_points(KEYFRAME, &image, UNIT, &IntervalParams::default());
        let before = maturing.left[0].points.clone();
        let doubled = |keyframe_id| KeyframeCorrection {
            keyframe_id,
            map_from_keyframe: Sim3::identity(),
            depth: LogPlane { offset: 2f64.ln(), ..LogPlane::default() },
            modes: None,
            place: None,
            relative_place: None,
        };
        for (keyframe_id, factor) in [(KEYFRAME + 1, 1.0), (KEYFRAME, 2.0)] {
            let keyframes = vec![doubled(keyframe_id)];
            maturing.correct(&Correction { keyframes, ..Correction::default() }, &CAMERA);
            for (now, before) in maturing.left[0].points.iter().zip(&before) {
                assert!((now.inverse_depth / (factor * before.inverse_depth) - 1.0).abs() < 1e-5);
            }
        }
    }
}
