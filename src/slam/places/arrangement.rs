//! How many matches of features agree on one arrangement: turned, scaled and shifted together.

use super::description::FeaturePlace;
use super::pattern::{ORIENTATIONS, angle_rad};
use super::scales::SCALE_STEP;

/// A feature of a keyframe that looks like one of the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Match {
    pub(super) slot: u32,
    /// Number of the image's feature.
    pub(super) ours: u16,
    /// Number of the keyframe's.
    pub(super) theirs: u16,
    pub(super) distance: u16,
}

/// Most matches that propose an arrangement, the best first.
const MOST_PROPOSALS: usize = 40;
/// How far a match may be from where an arrangement has it, shares of the image's width: views of depth, from aside.
const MAX_SHIFT: f32 = 0.1;
/// Steps of the orientation and of the scale that a match may differ by.
const MAX_TURN: i32 = 3;
const MAX_ZOOM: i32 = 2;

/// Most matches, of one keyframe and each of another of our features, that agree.
pub(super) fn agreeing(pairs: &[(FeaturePlace, FeaturePlace)], width: f32) -> u32 {
    let limit = (MAX_SHIFT * width) * (MAX_SHIFT * width);
    let half = ORIENTATIONS as i32 / 2;
    let turn = |(ours, theirs): &(FeaturePlace, FeaturePlace)| {
        i32::from(ours.orientation) - i32::from(theirs.orientation)
    };
    let zoom = |(ours, theirs): &(FeaturePlace, FeaturePlace)| {
        i32::from(ours.scale) - i32::from(theirs.scale)
    };
    let at = |place: &FeaturePlace| [f32::from(place.u), f32::from(place.v)];
    let mut best = 0;
    for proposal in pairs.iter().take(MOST_PROPOSALS) {
        let (turned, zoomed) = (turn(proposal), zoom(proposal));
        let (sin, cos) = angle_rad(turned.rem_euclid(ORIENTATIONS as i32) as usize).sin_cos();
        let scale = SCALE_STEP.powi(zoomed);
        let (sin, cos) = (sin as f32 * scale, cos as f32 * scale);
        let ([u, v], [x, y]) = (at(&proposal.0), at(&proposal.1));
        let agrees = |pair: &&(FeaturePlace, FeaturePlace)| {
            let turn = (turn(pair) - turned + half).rem_euclid(ORIENTATIONS as i32) - half;
            let ([u2, v2], [x2, y2]) = (at(&pair.0), at(&pair.1));
            let (x, y) = (x2 - x, y2 - y);
            let (u, v) = (u + cos * x - sin * y - u2, v + sin * x + cos * y - v2);
            turn.abs() <= MAX_TURN
                && (zoom(pair) - zoomed).abs() <= MAX_ZOOM
                && u * u + v * v <= limit
        };
        best = best.max(pairs.iter().filter(agrees).count() as u32);
    }
    best
}
