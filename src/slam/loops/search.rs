//! Decides whether two keyframes see the same place: measured, checked against the possible drift of the map, and
//! confirmed by another pair.

use crate::slam::geometry::sim3::{Matrix7, Sim3, Twist7};
use crate::slam::graph::constraint::{ConstraintParams, ConstraintSolver, Refusal, Start};
use crate::slam::loops::chain::{Chain, MIN_STD_DEVS, UNESTIMATED, along, of_deviations};
use crate::slam::loops::record::Link;
use crate::slam::loops::{Job, Loops, Pair, Plan, SearchOutcome, Stage, confirmations};

/// χ²₇ at 99 %, up to which two measurements agree.
pub(super) const LARGEST_CHI2: f64 = 18.5;

impl Loops {
    /// Measures the candidates of a keyframe, and plans the confirmation of the first plausible one.
    pub(super) fn search(&mut self, job: &Job) -> (u32, SearchOutcome) {
        let solver = ConstraintSolver::new(ConstraintParams::default());
        let mut refusal = None;
        let (mut compared, mut against_drift) = (0, None);
        let (Some(of), Some(node)) = (job.keyframe(job.plan.of), job.node(job.plan.of)) else {
            return (0, SearchOutcome::Refused(Refusal::TooFewPoints));
        };
        let chain = Chain::new(self, &job.nodes, node.epoch);
        let mut predictions = chain.and_then(Chain::into_predictions);
        let mut view = None;
        for pair in &job.plan.pairs {
            let (Some(other), Some(at)) = (job.keyframe(pair.j), job.node(pair.j)) else {
                continue;
            };
            // Two epochs may have any relative pose.
            let is_one_epoch = at.epoch == node.epoch;
            let predicted = predictions.as_mut().and_then(|of| of.of(pair.i, pair.j));
            let predicted = predicted.filter(|_| is_one_epoch);
            let least = predicted.as_ref().map_or(0.0, |(at, by)| least_chi2(at, by));
            if least > LARGEST_CHI2 {
                against_drift.get_or_insert(SearchOutcome::AgainstDrift(least));
                continue;
            }
            compared += 1;
            let view = view.get_or_insert_with(|| solver.view(of));
            let start = Start::Rotation(pair.j_from_i.rigid.rotation);
            let measurement = match solver.measure(view, &solver.view(other), start) {
                Ok(measurement) => measurement,
                Err(why) => {
                    refusal.get_or_insert(why);
                    continue;
                }
            };
            let link = Link::of(pair.i, pair.j, &measurement);
            self.measured = Some((link.i, link.j, measurement.j_from_i));
            let chi2 = match &predicted {
                Some((expected, by)) => chi2(expected, &link.j_from_i, &(by + link.covariance)),
                None if is_one_epoch => f64::NAN,
                None => 0.0,
            };
            if !(chi2 <= LARGEST_CHI2) {
                against_drift.get_or_insert(SearchOutcome::AgainstDrift(chi2));
                continue;
            }
            let pairs = confirming(job, &link);
            let (of, likeness) = (pair.i, job.plan.likeness);
            self.plan = Some(Plan { of, stage: Stage::Confirm(Box::new(link)), pairs, likeness });
            return (compared, SearchOutcome::Proposed);
        }
        let refused = SearchOutcome::Refused(refusal.unwrap_or(Refusal::NoOverlap));
        (compared, against_drift.unwrap_or(refused))
    }

    /// Measures pairs next to a loop; one must confirm it, two for a loop between epochs.
    pub(super) fn confirm(&mut self, job: &Job, link: &Link) -> (u32, SearchOutcome) {
        let solver = ConstraintSolver::new(ConstraintParams::default());
        let (Some(i), Some(j)) = (job.node(link.i), job.node(link.j)) else {
            return (0, SearchOutcome::Unconfirmed);
        };
        let wanted = confirmations(i.epoch == j.epoch);
        let mut compared = 0;
        let mut confirmations = Vec::new();
        for pair in &job.plan.pairs {
            let (Some(one), Some(other)) = (job.keyframe(pair.i), job.keyframe(pair.j)) else {
                continue;
            };
            compared += 1;
            let views = [solver.view(one), solver.view(other)];
            let measured = solver.measure(&views[0], &views[1], Start::Similarity(pair.j_from_i));
            let Ok(measurement) = measured else { continue };
            let confirmation = Link::of(pair.i, pair.j, &measurement);
            if self.agrees(job, link, &confirmation) {
                confirmations.push(confirmation);
            }
            if confirmations.len() == wanted {
                confirmations.insert(0, *link);
                return (compared, self.close(job, &confirmations));
            }
        }
        (compared, SearchOutcome::Unconfirmed)
    }

    /// Whether two neighbouring pairs agree about the map.
    fn agrees(&self, job: &Job, link: &Link, confirmation: &Link) -> bool {
        let place = |id| job.node(id).map(|node| node.map_from_keyframe);
        let (Some(i), Some(j), Some(near_i), Some(near_j)) =
            (place(link.i), place(link.j), place(confirmation.i), place(confirmation.j))
        else {
            return false;
        };
        // near_j_from_near_i through the loop and the links next to it.
        let (near_j_from_j, i_from_near_i) = (near_j.inverse() * j, i.inverse() * near_i);
        let expected = near_j_from_j * link.j_from_i * i_from_near_i;
        // The first keyframe of an epoch has no error.
        let is_first = |id: u64| {
            let first = job.nodes.first().map(|node| node.keyframe_id);
            self.epoch_starts.contains(&id) || first == Some(id)
        };
        let of_link = |id| match self.link_covariance(id) {
            Some(covariance) => covariance,
            None if is_first(id) => of_deviations(MIN_STD_DEVS),
            None => of_deviations(UNESTIMATED),
        };
        let (of_near_i, of_near_j) = (of_link(confirmation.i), of_link(confirmation.j));
        let covariance = confirmation.covariance
            + along(&near_j_from_j, &link.covariance)
            + of_near_j
            + along(&expected, &of_near_i);
        chi2(&expected, &confirmation.j_from_i, &covariance) <= LARGEST_CHI2
    }
}

/// Least χ² of any measurement between two keyframes that would be accepted: it would place them near each other, so
/// the map would have drifted along the line between them. Beyond the limit nothing need be measured.
fn least_chi2(expected: &Sim3, covariance: &Matrix7) -> f64 {
    /// Largest distance of an accepted measurement, in units of a keyframe: one mean depth, which is its initial unit.
    const REACH: f64 = 1.5;
    /// Standard deviation of a measurement, of translation in units and of ln s: five times the usual one, and half of
    /// what is accepted.
    const LARGEST_DEVIATION: f64 = 0.05;
    let distance = expected.rigid.translation.norm();
    if distance <= REACH {
        return 0.0;
    }
    let mut along = Twist7::zeros();
    along.fixed_rows_mut::<3>(0).copy_from(&(expected.rigid.translation / distance));
    along[6] = distance;
    let of_measurement = LARGEST_DEVIATION.powi(2) * along.norm_squared();
    (distance - REACH).powi(2) / (along.dot(&(covariance * along)) + of_measurement)
}

/// Squared distance of a similarity from the expected one, normalised by the covariance of the left increment.
fn chi2(expected: &Sim3, found: &Sim3, covariance: &Matrix7) -> f64 {
    let difference = (*found * expected.inverse()).log();
    let whitening = covariance.cholesky();
    whitening.map_or(f64::NAN, |whitening| difference.dot(&whitening.solve(&difference)))
}

/// Pairs of a neighbour of one keyframe with a neighbour of the other: they share no image with the loop.
fn confirming(job: &Job, link: &Link) -> Vec<Pair> {
    // Of a thinned map most keyframes have lost their depth.
    let beside = |id: u64| {
        let place = job.nodes.binary_search_by_key(&id, |node| node.keyframe_id).unwrap_or(0);
        let epoch = job.nodes.get(place).map(|node| node.epoch);
        let is_beside = |at: &usize| job.is_usable[*at] && Some(job.nodes[*at].epoch) == epoch;
        let before = (0..place).rev().find(is_beside);
        let after = (place + 1..job.nodes.len()).find(is_beside);
        [before, after].map(|at| Some(&job.nodes[at?]))
    };
    let places = [link.i, link.j].map(|id| job.node(id).map(|node| node.map_from_keyframe));
    let [Some(i), Some(j)] = places else { return Vec::new() };
    let (near_i, near_j) = (beside(link.i), beside(link.j));
    let mut pairs = Vec::new();
    for (one, other) in near_i
        .iter()
        .flatten()
        .flat_map(|one| near_j.iter().flatten().map(move |other| (one, other)))
    {
        let j_from_i = other.map_from_keyframe.inverse()
            * j
            * link.j_from_i
            * i.inverse()
            * one.map_from_keyframe;
        pairs.push(Pair { i: one.keyframe_id, j: other.keyframe_id, j_from_i });
    }
    // Pairs with the most similar views first: the smallest rotation and distance between them.
    let apart = |pair: &Pair| pair.j_from_i.log().norm();
    pairs.sort_by(|one, other| apart(one).total_cmp(&apart(other)));
    pairs
}
