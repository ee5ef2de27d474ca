//! Applies a loop: the pose graph of the epoch is solved with it, or two epochs become one.

use std::sync::Arc;

use nalgebra::Vector3;

use crate::slam::geometry::sim3::Sim3;
use crate::slam::graph::{GraphParams, optimise};
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::KeyframePoseCovariance;
use crate::slam::loops::chain::{Chain, along};
use crate::slam::loops::record::Link;
use crate::slam::loops::search::LARGEST_CHI2;
use crate::slam::loops::{Job, Loops, SearchOutcome};
use crate::slam::map::EpochJoin;

/// The change of the map by a loop.
#[derive(Debug, Clone, PartialEq)]
pub struct Closure {
    /// The epoch to be moved, not necessarily the active one.
    pub epoch: u32,
    /// Motion of each keyframe, in order of their ids: its pose is multiplied by this from the left.
    pub moves: Vec<(u64, Sim3)>,
    /// An epoch that becomes part of another.
    pub join: Option<EpochJoin>,
}

impl Closure {
    /// The motion of a keyframe: its own, or for a later one of the epoch that of the last before it.
    pub fn of(&self, keyframe_id: u64, epoch: u32) -> Option<&Sim3> {
        if epoch != self.epoch {
            return None;
        }
        let place = self.moves.partition_point(|(id, _)| *id <= keyframe_id);
        self.moves.get(place.checked_sub(1)?).map(|(_, by)| by)
    }
}

impl Loops {
    /// Adds a confirmed loop as a constraint, unless it contradicts the earlier ones.
    pub(super) fn close(&mut self, job: &Job, confirmed: &[Link]) -> SearchOutcome {
        Arc::make_mut(&mut self.record).links.extend(confirmed);
        self.settle(job, confirmed.len())
    }

    /// Solves for the effect of the newest loops on the map, and drops them if they contradict it.
    pub(super) fn settle(&mut self, job: &Job, num_newest: usize) -> SearchOutcome {
        let outcome = self.solve(job, num_newest);
        if outcome == SearchOutcome::Inconsistent {
            let before = self.record.links.len().saturating_sub(num_newest);
            Arc::make_mut(&mut self.record).links.truncate(before);
        }
        outcome
    }

    /// The newest loops are a pair, or those that join two epochs.
    fn solve(&mut self, job: &Job, num_newest: usize) -> SearchOutcome {
        let links = &self.record.links;
        let first = links.len().checked_sub(num_newest).and_then(|at| links.get(at));
        let Some(first) = first.copied() else { return SearchOutcome::Inconsistent };
        let (Some(i), Some(j)) = (job.node(first.i), job.node(first.j)) else {
            return SearchOutcome::Inconsistent;
        };
        // Since the search, where the result could not be applied at once.
        if [i, j].iter().any(|of| of.map_state == MapState::Rejected) {
            return SearchOutcome::Inconsistent;
        }
        match i.epoch == j.epoch {
            true => self.solve_graph(job, i.epoch, num_newest),
            false => self.join(job, &first, [i, j]),
        }
    }

    fn join(&mut self, job: &Job, link: &Link, [i, j]: [&Keyframe; 2]) -> SearchOutcome {
        let is_newer = i.epoch > j.epoch;
        let (newer, older) = if is_newer { (i, j) } else { (j, i) };
        let j_from_i = link.j_from_i;
        let older_from_newer = if is_newer { j_from_i } else { j_from_i.inverse() };
        let into_from_epoch =
            older.map_from_keyframe * older_from_newer * newer.map_from_keyframe.inverse();
        let (epoch, into) = (newer.epoch, older.epoch);
        let covariance = join_covariance(link, older, newer, &into_from_epoch);
        let beginning = job.nodes.iter().find(|node| node.epoch == epoch);
        Arc::make_mut(&mut self.record).beginnings.extend(beginning.map(|node| node.keyframe_id));
        let join = Some(EpochJoin { epoch, into, into_from_epoch, covariance });
        self.closure = Some(Closure { epoch, moves: Vec::new(), join });
        SearchOutcome::Joined
    }

    fn solve_graph(&mut self, job: &Job, epoch: u32, num_newest: usize) -> SearchOutcome {
        /// χ²₇ that one of ten thousand true loops exceeds: together with the other constraints one must be false.
        const CONTRADICTED_CHI2: f64 = 29.9;
        let Some(mut chain) = Chain::new(self, &job.nodes, epoch) else {
            return SearchOutcome::Inconsistent;
        };
        let errors = chain.loop_errors();
        if errors.iter().rev().take(num_newest).all(|&error| error <= LARGEST_CHI2) {
            return SearchOutcome::AlreadyConsistent;
        }
        let before: Vec<Sim3> =
            chain.graph.vertices().iter().map(|v| v.map_from_keyframe).collect();
        let solved = optimise(&mut chain.graph, &GraphParams::default());
        let is_solved = solved.is_ok_and(|outcome| outcome.is_converged);
        if !is_solved || !chain.loop_errors().iter().all(|&error| error <= CONTRADICTED_CHI2) {
            return SearchOutcome::Inconsistent;
        }
        let after = chain.graph.vertices().iter().map(|v| v.map_from_keyframe);
        let by = after.zip(before).map(|(is, was)| is * was.inverse());
        let moves = chain.ids.iter().copied().zip(by).collect();
        self.closure = Some(Closure { epoch, moves, join: None });
        SearchOutcome::Closed
    }
}

/// Covariance of the left increment of `into_from_epoch`, which a link between two keyframes gives: that of the link,
/// and those of the keyframes in their epochs.
fn join_covariance(
    link: &Link,
    older: &Keyframe,
    newer: &Keyframe,
    into_from_epoch: &Sim3,
) -> KeyframePoseCovariance {
    // Of the left increment of a keyframe's similarity: its errors at the origin.
    let of_keyframe = |of: &Keyframe| of.uncertain_pose().covariance_at(&Vector3::zeros());
    let older_from_j = match link.j == older.keyframe_id {
        true => Sim3::identity(),
        false => link.j_from_i.inverse(),
    };
    KeyframePoseCovariance::bounded(
        &(of_keyframe(older)
            + along(&(older.map_from_keyframe * older_from_j), &link.covariance)
            + along(into_from_epoch, &of_keyframe(newer))),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Twist7;
    use crate::slam::test_scene::Scene;

    /// Small enough for products of errors to vanish.
    const STEP: f64 = 1e-6;

    fn similarity(salt: f64) -> Sim3 {
        Sim3::exp(&Twist7::from_fn(|row, _| 0.4 * (salt + 1.7 * row as f64).sin()))
    }

    fn errors(salt: f64) -> Twist7 {
        Twist7::from_fn(|row, _| (salt + 1.3 * row as f64).sin())
    }

    /// A keyframe with this error of its pose and unit, and the covariance of that error alone.
    fn keyframe(epoch: u32, exact: &Sim3, error: &Twist7) -> Keyframe {
        let pose = SE3::exp(&(error.fixed_rows::<6>(0) * STEP));
        let map_from_keyframe =
            Sim3::new(pose * exact.rigid, exact.scale * (error[6] * STEP).exp());
        let place_covariance = KeyframePoseCovariance::bounded(&(error * error.transpose()));
        let id = u64::from(epoch);
        let keyframe = Scene::new(1).keyframe(id, SE3::identity(), 1.0);
        Keyframe { epoch, map_from_keyframe, place_covariance, ..keyframe }
    }

    #[test]
    fn a_join_errs_as_its_link_and_both_keyframes_do() {
        for newer_is_i in [true, false] {
            let [older, newer, join] = [0.3, 1.1, 2.0].map(similarity);
            let j_from_i = match newer_is_i {
                true => older.inverse() * join * newer,
                false => newer.inverse() * join.inverse() * older,
            };
            for part in 0..3 {
                let [of_older, of_newer, of_link] =
                    [0, 1, 2].map(|of| errors(0.7) * f64::from(u8::from(of == part)));
                let (older, newer) =
                    (keyframe(0, &older, &of_older), keyframe(1, &newer, &of_newer));
                let [i, j] = if newer_is_i { [1, 0] } else { [0, 1] };
                let j_from_i = Sim3::exp(&(of_link * STEP)) * j_from_i;
                let link = Link { i, j, j_from_i, covariance: of_link * of_link.transpose() };
                let older_from_newer = if newer_is_i { j_from_i } else { j_from_i.inverse() };
                let found =
                    older.map_from_keyframe * older_from_newer * newer.map_from_keyframe.inverse();
                let error = (found * join.inverse()).log() / STEP;
                let expected = error * error.transpose();
                let covariance = join_covariance(&link, &older, &newer, &join).matrix();
                let off = (covariance - expected).norm();
                assert!(error.norm() > 0.1 && off < 1e-4 * expected.norm(), "{part}: {off}");
            }
        }
    }
}
