//! Finds the camera on keyframes: candidates by appearance first, then alignment.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::UnitQuaternion;

use crate::slam::alignment::align::{Aligner, Alignment, AlignmentParams};
use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::alignment::reference::{
    Reference, ReferenceParams, ReferenceScratch, finest_level, num_levels,
};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::sums::SumPyramid;
use crate::slam::kernel::SimdMode;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::mapper::appearance::Appearance;
use crate::slam::mapper::recovery::RecoveryParams;
use crate::slam::mapper::turned_views::{TurnedViews, turned_back};
use crate::slam::places::{Describer, PlaceCandidate, PlaceIndex};
use crate::slam::pose::Brightness;
use crate::slam::tracker::motion::rotations_around;
use crate::slam::tracker::verdict::{VerdictParams, is_better, quality_of};

/// Correlation of small images below which a keyframe is not tried: of 24 alignments that succeeded while the camera
/// was lost in a recording, 19 were at 0.8 or more, the others, on views turned by 22° to 57°, at 0.44 to 0.65.
const MIN_SIMILARITY: f32 = 0.3;

/// Features that an image and a keyframe must share to be aligned: other places share up to twelve; alignment decides.
const MIN_SHARED: f32 = 8.0;

/// Correlation of small images, or features shared, either of which a place needs that was found.
const FOUND_SIMILARITY: f32 = 0.5;
const FOUND_SHARED: f32 = 10.0;

/// Newest keyframes whose small images are compared: 12 µs each. The index holds all keyframes.
const MAX_COMPARED: usize = 300;

/// New keyframes that are indexed per frame: 2.5 ms each at 640×480.
pub(super) const MAX_INDEXED: usize = 10;

/// Fewest points of a keyframe that is searched: one per hundred pixels.
fn least_points(camera: &Intrinsics) -> usize {
    camera.width * camera.height / 100
}

/// Searches keyframes for the camera; owns the buffers for that.
#[derive(Debug)]
pub(super) struct Finder {
    camera: Intrinsics,
    aligner: Aligner,
    pub(super) verdict: VerdictParams,
    reference: Reference,
    scratch: ReferenceScratch,
    pyramid: SumPyramid,
    /// Appearances of keyframes, in the order of their ids.
    appearances: Vec<(u64, Option<Appearance>)>,
    /// The same keyframes, indexed by their features.
    places: PlaceIndex,
    describer: Describer,
    /// Created at the first loss that needs them: two megabytes.
    turned_views: Option<TurnedViews>,
    /// Index of a keyframe that was found but contradicted by another, or confirmed by none: the next search leaves it
    /// out, so that it does not hide others.
    pub(super) doubted: Option<usize>,
}

/// Pose of a frame on a keyframe, found from an expected pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Located {
    /// In the keyframe's unit.
    pub(super) keyframe_from_camera: SE3,
    /// Of the frame relative to the keyframe.
    pub(super) brightness: Brightness,
    /// Distance from the expected pose: translation in mean depths plus rotation in radians.
    pub(super) disagreement: f64,
    /// Whether the pose would be accepted after a loss.
    pub(super) is_sure: bool,
}

impl Finder {
    /// Creates a finder for images of `intrinsics`. Its results are only proposals, which the tracker judges by its own
    /// parameters, so the defaults suffice here; portable, so that every CPU finds the same.
    pub(super) fn new(intrinsics: &Intrinsics) -> Self {
        let Intrinsics { width, height, .. } = *intrinsics;
        let reference = ReferenceParams::default();
        let levels = num_levels(width, height);
        let alignment = AlignmentParams {
            simd: SimdMode::Portable,
            common_depth_error: 0.0,
            ..Default::default()
        };
        Self {
            camera: *intrinsics,
            aligner: Aligner::new(alignment),
            verdict: VerdictParams::default(),
            pyramid: SumPyramid::with_size(width, height, levels, finest_level(levels, &reference)),
            reference: Reference::new(reference),
            scratch: ReferenceScratch::default(),
            appearances: Vec::new(),
            places: PlaceIndex::default(),
            describer: Describer::default(),
            turned_views: None,
            doubted: None,
        }
    }

    /// Finds a keyframe, of any epoch, that shows what `pixels` show, and the camera's pose on it. Each call tries the
    /// keyframe that shares most features or the one whose small image is most similar, alternating with `searched`,
    /// then cycles through the other candidates.
    pub(super) fn find(
        &mut self,
        keyframes: &mut [Keyframe],
        active: Option<usize>,
        searched: &mut usize,
        pixels: &[u8],
        params: &RecoveryParams,
    ) -> Option<(usize, SE3)> {
        let camera = self.camera;
        let seen = Appearance::of(pixels, camera.width, camera.height)?;
        self.index_new(keyframes, MAX_INDEXED);
        let mut alike = self.rank_by_appearance(keyframes, active, &seen).into_iter();
        let most = params.num_keyframes;
        let mut sharing = self.rank_by_features(keyframes, active, pixels, most).into_iter();
        let doubted = self.doubted.take();
        let mut candidates: Vec<(usize, SE3)> = Vec::new();
        for _ in 0..params.num_keyframes {
            let both = [sharing.next(), alike.next().map(|index| (index, SE3::identity()))];
            for (index, expected) in both.into_iter().flatten() {
                let is_known = candidates.iter().any(|(known, _)| *known == index);
                if !is_known && Some(index) != doubted {
                    candidates.push((index, expected));
                }
            }
        }
        candidates.truncate(params.num_keyframes);
        if candidates.is_empty() {
            return None;
        }
        let first = match params.keyframes_per_frame {
            // Alone, an attempt cycles through all of them.
            1 => {
                *searched += 1;
                candidates[(*searched - 1) % candidates.len()]
            }
            _ => candidates[*searched % candidates.len().min(2)],
        };
        let others = &candidates[1..];
        self.pyramid.fill(pixels);
        let rotation_rad = params.rotation_deg.to_radians();
        for attempt in 0..params.keyframes_per_frame.min(candidates.len()) {
            let (index, expected) = match attempt {
                0 => first,
                _ => {
                    *searched += 1;
                    others[(*searched - 1) % others.len()]
                }
            };
            if let Some(found) = self.find_near(&keyframes[index], &expected, rotation_rad) {
                return Some((index, found));
            }
        }
        None
    }

    /// Eligible keyframes, those that share most features with `pixels` first, and the rotation of the camera against
    /// each if nothing is near.
    fn rank_by_features(
        &mut self,
        keyframes: &[Keyframe],
        active: Option<usize>,
        pixels: &[u8],
        most: usize,
    ) -> Vec<(usize, SE3)> {
        let camera = self.camera;
        let Some(seen) = self.describer.describe(pixels, camera.width, camera.height) else {
            return Vec::new();
        };
        let index_of: BTreeMap<u64, usize> = eligible(keyframes, active, &camera)
            .map(|index| (keyframes[index].keyframe_id, index))
            .collect();
        let found = self.places.candidates(&seen, most, |id| !index_of.contains_key(&id));
        let found = found.into_iter().filter(|candidate| candidate.score >= MIN_SHARED);
        let turned = |candidate: PlaceCandidate| {
            let rotation = candidate.rotation(&camera);
            (index_of[&candidate.keyframe_id], SE3 { rotation, ..SE3::identity() })
        };
        found.map(turned).collect()
    }

    /// Eligible keyframes, those most similar to `seen` first, the newest of equals.
    fn rank_by_appearance(
        &self,
        keyframes: &[Keyframe],
        active: Option<usize>,
        seen: &Appearance,
    ) -> Vec<usize> {
        let mut rated: Vec<(f32, usize)> = eligible(keyframes, active, &self.camera)
            .take(MAX_COMPARED)
            .filter_map(|index| Some((self.appearance(&keyframes[index])?.similarity(seen), index)))
            .filter(|(similarity, _)| *similarity > MIN_SIMILARITY)
            .collect();
        rated.sort_by(|one, other| other.0.total_cmp(&one.0));
        rated.into_iter().map(|(_, index)| index).collect()
    }

    /// Finds a keyframe that shows what `pixels` show from a camera turned far against it, and the camera's pose on it.
    /// Cycles through the keyframes: `compared` counts them across calls.
    pub(super) fn find_turned(
        &mut self,
        keyframes: &mut [Keyframe],
        active: Option<usize>,
        compared: &mut usize,
        pixels: &[u8],
        params: &RecoveryParams,
    ) -> Option<(usize, SE3)> {
        /// Keyframes that are compared per frame: about a millisecond each.
        const MAX_COMPARED: usize = 24;
        /// Search around a rotation that was found: half a step between rotations.
        const ROTATION_DEG: f64 = 4.5;
        /// Largest rotation of the pose from there, degrees: a step of each rotation, plus the effect of near points.
        /// An alignment that moves further fits something else.
        const MAX_ERROR_DEG: f64 = 15.0;
        let most = params.keyframes_per_frame.min(params.num_keyframes);
        if most == 0 {
            return None;
        }
        let camera = self.camera;
        let seen = Appearance::of(pixels, camera.width, camera.height)?;
        self.index_new(keyframes, MAX_INDEXED);
        let eligible: Vec<usize> = eligible(keyframes, active, &camera)
            .filter(|index| Some(*index) != self.doubted)
            .filter(|&index| self.appearance(&keyframes[index]).is_some())
            .collect();
        let count = eligible.len().min(MAX_COMPARED);
        let candidates: Vec<usize> =
            (0..count).map(|k| eligible[(*compared + k) % eligible.len()]).collect();
        *compared += count;
        if self.turned_views.as_ref().is_none_or(|views| !views.is_for(&camera)) {
            self.turned_views = Some(TurnedViews::new(&camera));
        }
        let details: Vec<&[f32]> = candidates
            .iter()
            .filter_map(|&index| Some(self.appearance(&keyframes[index])?.details()))
            .collect();
        let views = self.turned_views.as_ref()?.compare(seen.details(), &details);
        let pairs = candidates.into_iter().zip(views);
        let mut rated: Vec<_> = pairs.filter_map(|(index, view)| Some((index, view?))).collect();
        rated.sort_by(|one, other| other.1.score.total_cmp(&one.1.score));
        self.pyramid.fill(pixels);
        for (index, view) in rated.into_iter().take(most) {
            let expected = SE3 { rotation: view.rotation, ..SE3::identity() };
            let found = self.find_near(&keyframes[index], &expected, ROTATION_DEG.to_radians());
            let is_there = |found: &SE3| {
                found.rotation.angle_to(&expected.rotation) <= MAX_ERROR_DEG.to_radians()
            };
            if let Some(found) = found.filter(is_there) {
                return Some((index, found));
            }
        }
        None
    }

    /// The appearance of a keyframe, if it is stored.
    fn appearance(&self, keyframe: &Keyframe) -> Option<&Appearance> {
        let id = keyframe.keyframe_id;
        let known = self.appearances.binary_search_by_key(&id, |(of, _)| *of).ok()?;
        self.appearances[known].1.as_ref()
    }

    /// Indexes at most `most` new keyframes, and describes those without a description.
    pub(super) fn index_new(&mut self, keyframes: &mut [Keyframe], most: usize) {
        let known = self.appearances.last().map(|(id, _)| *id);
        self.forget_all_but(keyframes);
        let new = keyframes.iter_mut().filter(|keyframe| Some(keyframe.keyframe_id) > known);
        for keyframe in new.take(most) {
            let Intrinsics { width, height, .. } = keyframe.intrinsics;
            let appearance = Appearance::of(&keyframe.image, width, height);
            self.appearances.push((keyframe.keyframe_id, appearance));
            if keyframe.description.is_none() {
                let description = self.describer.describe(&keyframe.image, width, height);
                keyframe.description = description.map(Arc::new);
            }
            if let Some(description) = &keyframe.description {
                self.places.insert(keyframe.keyframe_id, description);
            }
        }
    }

    /// Removes keyframes that keep only their poses: they are not searched.
    fn forget_all_but(&mut self, keyframes: &[Keyframe]) {
        let mut held = keyframes.iter().filter(|of| of.has_depth()).map(|of| of.keyframe_id);
        let mut next = held.next();
        let places = &mut self.places;
        self.appearances.retain(|(id, _)| {
            while next.is_some_and(|held| held < *id) {
                next = held.next();
            }
            let is_held = next == Some(*id);
            if !is_held {
                places.remove(*id);
            }
            is_held
        });
    }

    /// Whether a frame shows some of what a keyframe shows. At wrong places that fitted otherwise, and that a second
    /// keyframe confirmed, it shared five and eight features, and the small images correlated by 0.31 and 0.33; at 60
    /// right ones ten features and more, or small images correlated by 0.5 and more. `rotation` is the one found,
    /// `keyframe_from_camera`.
    pub(super) fn resembles(
        &mut self,
        keyframe: &Keyframe,
        rotation: &UnitQuaternion<f64>,
        pixels: &[u8],
    ) -> bool {
        let Intrinsics { width, height, .. } = self.camera;
        let is_alike = |seen: Appearance| {
            let seen = turned_back(&seen, &self.camera, rotation);
            self.appearance(keyframe).is_some_and(|of| of.similarity(&seen) >= FOUND_SIMILARITY)
        };
        if Appearance::of(pixels, width, height).is_some_and(is_alike) {
            return true;
        }
        let Some(seen) = self.describer.describe(pixels, width, height) else { return false };
        let found = self.places.candidates(&seen, 1, |id| id != keyframe.keyframe_id);
        found.first().is_some_and(|place| place.score >= FOUND_SHARED)
    }

    /// Aligns a frame to `keyframe` from the expected pose; `None` where it does not fit, or ends further from that
    /// pose than `max_disagreement`, translation in mean depths plus rotation in radians.
    pub(super) fn locate(
        &mut self,
        keyframe: &Keyframe,
        pixels: &[u8],
        expected: &SE3,
        max_disagreement: f64,
    ) -> Option<Located> {
        self.pyramid.fill(pixels);
        self.reference.prepare_into(keyframe, &mut self.scratch);
        let (start, brightness) = (expected.inverse(), Brightness::default());
        let (reference, pyramid) = (&self.reference, &self.pyramid);
        let found = self.aligner.align(reference, pyramid, &start, brightness, &mut |_| true);
        /// Share of inliers that agreement requires: less than a claim, since the initial pose is known.
        const MIN_INLIERS: f64 = 0.65;
        let quality = quality_of(&found);
        let is_tracked = self.verdict.judge(&found, &quality, false, 0).is_tracked();
        let is_even = self.verdict.has_likely_gain(&found);
        if !is_tracked || !is_even || quality.inlier_ratio < MIN_INLIERS {
            return None;
        }
        let error = (found.state.current_from_keyframe * *expected).log();
        let disagreement = error.fixed_rows::<3>(0).norm() + error.fixed_rows::<3>(3).norm();
        let is_sure = self.verdict.judge(&found, &quality, true, 0).is_tracked();
        let located = Located {
            keyframe_from_camera: found.state.current_from_keyframe.inverse(),
            brightness: found.state.brightness,
            disagreement,
            is_sure,
        };
        (disagreement <= max_disagreement).then_some(located)
    }

    /// Aligns the frame in the pyramid to `keyframe` from views near the expected one; returns `keyframe_from_camera`
    /// of the best where it is accepted.
    fn find_near(&mut self, keyframe: &Keyframe, expected: &SE3, rotation_rad: f64) -> Option<SE3> {
        self.reference.prepare_into(keyframe, &mut self.scratch);
        let (aligner, reference, pyramid) = (&self.aligner, &self.reference, &self.pyramid);
        let mut best: Option<(Alignment, NormalEquations)> = None;
        for keyframe_from_camera in rotations_around(expected, rotation_rad) {
            let start = keyframe_from_camera.inverse();
            let mut other = aligner.start(reference, pyramid, &start, Brightness::default());
            let level = other.level;
            aligner.solve_level(reference, pyramid, level, &mut other, &mut |_| true);
            // A small gain explains any image, and would hide the pose that may be claimed.
            if !self.verdict.is_near(&other) {
                continue;
            }
            let explained = aligner.sums_with_exact_depth(reference, pyramid, &other);
            if best.as_ref().is_none_or(|(_, by_best)| is_better(&explained, by_best)) {
                best = Some((other, explained));
            }
        }
        let (mut best, _) = best?;
        aligner.descend(reference, pyramid, &mut best, &mut |_| true);
        let verdict = self.verdict.judge(&best, &quality_of(&best), true, 0);
        let keyframe_from_camera = best.state.current_from_keyframe.inverse();
        (verdict.is_tracked() && keyframe_from_camera.is_finite()).then_some(keyframe_from_camera)
    }
}

/// Keyframes of this camera that may become active again, the newest first: those of another stay in the map when
/// capture is restarted with it. The tracker itself searches around the active one.
fn eligible(
    keyframes: &[Keyframe],
    active: Option<usize>,
    camera: &Intrinsics,
) -> impl Iterator<Item = usize> {
    let is_eligible = move |index: &usize| {
        let keyframe = &keyframes[*index];
        Some(*index) != active
            && keyframe.intrinsics == *camera
            && keyframe.map_state == MapState::Established
            && keyframe.points.len() >= least_points(&keyframe.intrinsics)
    };
    (0..keyframes.len()).rev().filter(is_eligible)
}

#[cfg(test)]
mod tests;
