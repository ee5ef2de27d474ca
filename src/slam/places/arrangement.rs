//! Counts the feature matches that agree on one arrangement: rotated, scaled and shifted together.

use super::description::FeaturePlace;
use super::pattern::{ORIENTATIONS, angle_rad};
use super::scales::SCALE_STEP;

/// A feature of a keyframe that resembles one of the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Match {
    pub(super) slot: u32,
    /// Index of the image's feature.
    pub(super) ours: u16,
    /// Index of the keyframe's feature.
    pub(super) theirs: u16,
    pub(super) distance: u16,
}

/// Maximum number of matches that propose an arrangement, the best first.
const MAX_PROPOSALS: usize = 40;
/// Largest offset of a match from an arrangement, shares of the image's width: allows for depth seen from the side.
const MAX_SHIFT: f32 = 0.1;
/// Steps of orientation and of scale by which a match may differ.
const MAX_TURN: i32 = 3;
const MAX_ZOOM: i32 = 2;

/// Mapping of an image's features to a keyframe's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Arrangement {
    /// Number of matches that agree on it.
    pub(super) agreeing: u32,
    /// In-plane rotation of the image against the keyframe's, radians: a direction in the keyframe's image plus this is
    /// the same in the image.
    pub(super) turn_rad: f32,
    /// A pixel of the image, the mean of the features that agree.
    pub(super) ours: [f32; 2],
    /// The corresponding pixel of the keyframe.
    pub(super) theirs: [f32; 2],
}

/// The arrangement that most matches agree on, of one keyframe and each for another of our features, the best first;
/// `None` without matches.
pub(super) fn arrange(pairs: &[(FeaturePlace, FeaturePlace)], width: f32) -> Option<Arrangement> {
    let proposals = pairs.iter().take(MAX_PROPOSALS);
    let rated = proposals.map(|proposal| {
        let agrees = agreement(proposal, width);
        (pairs.iter().filter(|pair| agrees(pair)).count(), proposal)
    });
    // Of equals the first.
    let (_, best) = rated.reduce(|one, other| if other.0 > one.0 { other } else { one })?;
    let agrees = agreement(best, width);
    let agreeing: Vec<_> = pairs.iter().filter(|pair| agrees(pair)).collect();
    let count = agreeing.len() as f32;
    let [mut ours, mut theirs, mut direction] = [[0.0f32; 2]; 3];
    for pair in &agreeing {
        let (sin, cos) = angle_rad(turn(pair).rem_euclid(ORIENTATIONS as i32) as usize).sin_cos();
        let values = [at(&pair.0), at(&pair.1), [cos as f32, sin as f32]];
        for (sum, value) in [&mut ours, &mut theirs, &mut direction].into_iter().zip(values) {
            (sum[0], sum[1]) = (sum[0] + value[0], sum[1] + value[1]);
        }
    }
    Some(Arrangement {
        agreeing: agreeing.len() as u32,
        turn_rad: direction[1].atan2(direction[0]),
        ours: ours.map(|sum| sum / count),
        theirs: theirs.map(|sum| sum / count),
    })
}

type Pair = (FeaturePlace, FeaturePlace);

fn turn((ours, theirs): &Pair) -> i32 {
    i32::from(ours.orientation) - i32::from(theirs.orientation)
}

fn zoom((ours, theirs): &Pair) -> i32 {
    i32::from(ours.scale) - i32::from(theirs.scale)
}

fn at(place: &FeaturePlace) -> [f32; 2] {
    [f32::from(place.u), f32::from(place.v)]
}

/// Whether a match agrees with the arrangement proposed by another.
fn agreement(proposal: &Pair, width: f32) -> impl Fn(&Pair) -> bool {
    let limit = (MAX_SHIFT * width) * (MAX_SHIFT * width);
    let half = ORIENTATIONS as i32 / 2;
    let (turned, zoomed) = (turn(proposal), zoom(proposal));
    let (sin, cos) = angle_rad(turned.rem_euclid(ORIENTATIONS as i32) as usize).sin_cos();
    let scale = SCALE_STEP.powi(zoomed);
    let (sin, cos) = (sin as f32 * scale, cos as f32 * scale);
    let ([u, v], [x, y]) = (at(&proposal.0), at(&proposal.1));
    move |pair| {
        let turn = (turn(pair) - turned + half).rem_euclid(ORIENTATIONS as i32) - half;
        let ([u2, v2], [x2, y2]) = (at(&pair.0), at(&pair.1));
        let (x, y) = (x2 - x, y2 - y);
        let (u, v) = (u + cos * x - sin * y - u2, v + sin * x + cos * y - v2);
        turn.abs() <= MAX_TURN && (zoom(pair) - zoomed).abs() <= MAX_ZOOM && u * u + v * v <= limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::Random;

    /// Features of a keyframe, and the same rotated by 90°, twice as large, and moved.
    fn pairs(count: usize) -> Vec<(FeaturePlace, FeaturePlace)> {
        let mut random = Random::new(5);
        let mut below = |limit: f64| (limit * random.uniform()) as u16;
        (0..count)
            .map(|_| {
                let (u, v) = (below(200.0), below(200.0));
                let (orientation, scale) = (below(32.0) as u8, 3);
                let theirs = FeaturePlace { u, v, orientation, scale };
                let turned = (orientation + ORIENTATIONS as u8 / 4) % ORIENTATIONS as u8;
                // Three steps of 1.25 are 1.95.
                let ours =
                    FeaturePlace { u: 500 - 2 * v, v: 50 + 2 * u, orientation: turned, scale: 6 };
                (ours, theirs)
            })
            .collect()
    }

    #[test]
    fn features_rotated_and_enlarged_together_agree() {
        let found = arrange(&pairs(30), 640.0).unwrap();
        assert_eq!(found.agreeing, 30);
        assert!((found.turn_rad - std::f32::consts::FRAC_PI_2).abs() < 1e-4, "{found:?}");
        let [u, v] = found.theirs;
        let error = [500.0 - 2.0 * v - found.ours[0], 50.0 + 2.0 * u - found.ours[1]];
        assert!(error.iter().all(|error| error.abs() < 0.1), "{found:?}");
        assert_eq!(arrange(&[], 640.0), None);
    }

    #[test]
    fn features_elsewhere_or_rotated_otherwise_do_not_agree() {
        let change = |of: &dyn Fn(usize, &mut FeaturePlace)| {
            let mut pairs = pairs(30);
            (0..10).for_each(|k| of(k, &mut pairs[k].0));
            arrange(&pairs, 640.0).unwrap().agreeing
        };
        assert_eq!(change(&|_, place| place.orientation = (place.orientation + 9) % 32), 20);
        assert_eq!(change(&|_, place| place.scale = 2), 20);
        assert_eq!(change(&|k, place| place.u += 150 * (k as u16 + 1)), 20);
    }
}
