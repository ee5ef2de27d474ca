//! How many candidates survive the alignment of the loop search, judged by ground truth.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::graph::constraint::{ConstraintParams, ConstraintSolver, Refusal, Start};
use semidense::slam::keyframe::Keyframe;
use semidense::slam::places::PlaceCandidate;

use crate::footage::{Footage, Overlap};
use crate::judge::{FEW, OTHER, SAME};

/// A measured pair.
struct Verdict {
    score: f32,
    /// Whether the keyframes see enough of each other; `None` in between.
    is_same: Option<bool>,
    /// Whether the measurement is correct, or why there is none.
    measured: Result<bool, Refusal>,
}

/// Prints recall among the keyframes at least `gap` before the query, after aligning the first and the first few
/// candidates.
pub fn verify(
    footage: &Footage,
    overlaps: &[Vec<Overlap>],
    candidates: &[Vec<PlaceCandidate>],
    gap: usize,
    depth_error: f64,
) {
    let solver = ConstraintSolver::new(ConstraintParams::default());
    let (mut revisits, mut measured) = (0usize, Vec::new());
    let mut refusals = BTreeMap::<String, usize>::new();
    for (i, row) in overlaps.iter().enumerate() {
        let before = i.saturating_sub(gap);
        let is_revisit = (0..before).any(|j| row[j].least >= SAME);
        revisits += usize::from(is_revisit);
        let Some(keyframe) = footage.keyframe(i, depth_error) else { continue };
        let view = solver.view(&keyframe);
        let mut verdicts = Vec::new();
        for candidate in candidates[i].iter().take(FEW) {
            let j = candidate.keyframe_id as usize;
            let Some(other) = footage.keyframe(j, depth_error) else { continue };
            let rotation = candidate.rotation(&footage.camera);
            let found = solver.measure(&view, &solver.view(&other), Start::Rotation(rotation));
            let found = found.map(|found| is_true(&keyframe, &other, &found.j_from_i));
            let is_same = match row[j] {
                Overlap { least, .. } if least >= SAME => Some(true),
                Overlap { most, .. } if most <= OTHER => Some(false),
                _ => None,
            };
            if let (Err(why), Some(true)) = (&found, is_same) {
                let why = format!("{why:?}");
                let name = why.split('(').next().unwrap_or_default().to_owned();
                *refusals.entry(name).or_default() += 1;
            }
            verdicts.push(Verdict { score: candidate.score, is_same, measured: found });
        }
        measured.push((is_revisit, verdicts));
    }
    println!("  aligned with depth that errs by {depth_error}:");
    for most in [1, FEW] {
        report(&measured, revisits, most);
    }
    println!("    refused of pairs that see the same: {refusals:?}");
}

/// Whether a measured similarity agrees with the truth: metres and degrees.
fn is_true(i: &Keyframe, j: &Keyframe, j_from_i: &Sim3) -> bool {
    const FALSE_M: f64 = 0.2;
    const FALSE_DEG: f64 = 8.0;
    let (world_from_i, world_from_j) = (i.world_from_keyframe, j.world_from_keyframe);
    let truth = world_from_j.inverse() * world_from_i;
    let moved: Vector3<f64> = j_from_i.rigid.translation - truth.rigid.translation;
    let turned = j_from_i.rigid.rotation.angle_to(&truth.rigid.rotation).to_degrees();
    moved.norm() * world_from_j.scale <= FALSE_M && turned <= FALSE_DEG
}

/// Prints the outcome for the first `most` candidates. For each keyframe the first accepted pair counts.
fn report(measured: &[(bool, Vec<Verdict>)], revisits: usize, most: usize) {
    let pairs = || measured.iter().flat_map(|(_, of)| of.iter().take(most));
    let count = |is: &dyn Fn(&Verdict) -> bool| pairs().filter(|of| is(of)).count();
    let accepted = count(&|of| of.measured.is_ok());
    let wrong = count(&|of| of.measured == Ok(false));
    let same = count(&|of| of.is_same == Some(true));
    let same_accepted = count(&|of| of.is_same == Some(true) && of.measured == Ok(true));
    let others = count(&|of| of.is_same == Some(false));
    let others_accepted = count(&|of| of.is_same == Some(false) && of.measured.is_ok());
    let worst_false = pairs().filter(|of| of.measured == Ok(false)).map(|of| of.score);
    let worst_false = worst_false.fold(f32::NEG_INFINITY, f32::max);
    let recalled = |least: f32| {
        let first = |of: &[Verdict]| {
            let found = of.iter().take(most).find(|of| of.measured.is_ok() && of.score > least);
            found.is_some_and(|of| of.measured == Ok(true))
        };
        measured.iter().filter(|(is_revisit, of)| *is_revisit && first(of)).count()
    };
    /// Minimum score of the loop search.
    const LIKELY: f32 = 20.0;
    let share = |count: usize| 100.0 * count as f64 / revisits.max(1) as f64;
    println!(
        "    {most} each: {} aligned, {accepted} accepted, {wrong} false; see the same {same_accepted} of {same}, nothing in common {others_accepted} of {others}; recall {:.0} % of {revisits}, {:.0} % from {LIKELY} features, at 100 % precision {:.0} % (above {worst_false:.0})",
        pairs().count(),
        share(recalled(f32::NEG_INFINITY)),
        share(recalled(LIKELY - 0.5)),
        share(recalled(worst_false))
    );
}
