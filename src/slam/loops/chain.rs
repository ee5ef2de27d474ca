//! Constraints between keyframes without loops: the pose of each relative to those it was estimated with.
//!
//! The estimate gives the covariance P of the errors (ξ, λ) of a pose relative to those held
//! (`slam::keyframe_pose_covariance`). With S = `map_from_keyframe` of the newer keyframe the error of the left
//! increment of `newer_from_older` is −Ad(S⁻¹) (ξ, 0) − (0, 0, λ). The n links of a keyframe together carry the
//! information of its estimate, so each has n times the covariance.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::slam::geometry::sim3::{Matrix7, Sim3};
use crate::slam::graph::marginal::Marginals;
use crate::slam::graph::pose_graph::{Constraint, PoseGraph, VertexId};
use crate::slam::graph::robust::RobustKernel;
use crate::slam::graph::{GraphParams, normalized_errors};
use crate::slam::keyframe::Keyframe;
use crate::slam::keyframe_pose_covariance::KeyframePoseCovariance;
use crate::slam::loops::Loops;
use crate::slam::loops::record::Link;

/// Standard deviations of a link (translation in mean depths, rotation in radians, ln s): the least, whatever an
/// estimate claims, and those without an estimate. The least are an eighth of a pixel at f = 250 and the uncertainty of
/// a scale that a thousand points hold; the others those of a step to the next keyframe by the tracker alone.
pub(super) const MIN_STD_DEVS: [f64; 3] = [0.0005, 0.0005, 0.001];
pub(super) const UNESTIMATED: [f64; 3] = [0.03, 0.02, 0.05];

/// The pose graph of an epoch.
pub(super) struct Chain {
    pub(super) graph: PoseGraph,
    vertices: BTreeMap<u64, VertexId>,
    /// Ids in order of the vertices.
    pub(super) ids: Vec<u64>,
    /// Number of its constraints that are not loops.
    num_links: usize,
}

impl Chain {
    /// The chain of an epoch's nodes, in order of their ids, with its loops; `None` where a value is invalid.
    pub(super) fn new(loops: &Loops, nodes: &[Keyframe], epoch: u32) -> Option<Self> {
        let of_epoch: Vec<&Keyframe> = nodes.iter().filter(|node| node.epoch == epoch).collect();
        let mut graph = PoseGraph::new();
        let mut vertices = BTreeMap::new();
        let mut ids = Vec::new();
        for (place, node) in of_epoch.iter().enumerate() {
            let vertex = graph.add_vertex(node.map_from_keyframe, place == 0).ok()?;
            vertices.insert(node.keyframe_id, vertex);
            ids.push(node.keyframe_id);
        }
        let mut chain = Self { graph, vertices, ids, num_links: 0 };
        for (place, node) in of_epoch.iter().enumerate().skip(1) {
            let of = |id: &u64| {
                let at = of_epoch[..place].binary_search_by_key(id, |node| node.keyframe_id);
                of_epoch.get(at.ok()?)
            };
            let known = loops.record.held_by.get(&node.keyframe_id).into_iter().flatten();
            let mut others: Vec<&Keyframe> = known.filter_map(of).copied().collect();
            let is_estimated = !others.is_empty();
            if !is_estimated && !loops.record.beginnings.contains(&node.keyframe_id) {
                others.push(of_epoch[place - 1]);
            }
            let known = loops.link_covariance(node.keyframe_id).filter(|_| is_estimated);
            let covariance =
                known.unwrap_or_else(|| of_deviations(UNESTIMATED)) * others.len() as f64;
            for other in others {
                let j_from_i = node.map_from_keyframe.inverse() * other.map_from_keyframe;
                chain.add(other.keyframe_id, node.keyframe_id, j_from_i, &covariance)?;
                chain.num_links += 1;
            }
        }
        for link in &loops.record.links {
            chain.add_loop(link);
        }
        Some(chain)
    }

    /// Adds a loop; one of keyframes outside the epoch is ignored.
    pub(super) fn add_loop(&mut self, link: &Link) {
        let _ = self.add(link.i, link.j, link.j_from_i, &link.covariance);
    }

    fn add(&mut self, i: u64, j: u64, j_from_i: Sim3, covariance: &Matrix7) -> Option<()> {
        let (i, j) = (*self.vertices.get(&i)?, *self.vertices.get(&j)?);
        let information = covariance.cholesky()?.inverse();
        let kernel = RobustKernel::None;
        self.graph.add_constraint(Constraint { i, j, j_from_i, information, kernel }).ok()
    }

    /// Predicts the similarity of any two keyframes from links and loops; `None` where the graph cannot be solved.
    pub(super) fn into_predictions(self) -> Option<Predictions> {
        let marginals = Marginals::new(&self.graph, &GraphParams::default()).ok()?;
        Some(Predictions { chain: self, marginals })
    }

    /// rᵀΛr of the loops, the newest last.
    pub(super) fn loop_errors(&self) -> Vec<f64> {
        normalized_errors(&self.graph).skip(self.num_links).collect()
    }
}

/// Predicted similarities between the keyframes of an epoch.
pub(super) struct Predictions {
    chain: Chain,
    marginals: Marginals,
}

impl Predictions {
    /// `j_from_i` from the current poses, and its covariance from links and loops.
    pub(super) fn of(&mut self, i: u64, j: u64) -> Option<(Sim3, Matrix7)> {
        let Chain { graph, vertices, .. } = &self.chain;
        let (i, j) = (*vertices.get(&i)?, *vertices.get(&j)?);
        let place = |of| graph.map_from_keyframe(of).copied();
        let covariance = self.marginals.relative_covariance(j, i)?;
        Some((place(j)?.inverse() * place(i)?, covariance))
    }
}

impl Loops {
    /// Stores the covariance of an estimated keyframe's pose relative to those that held it, in a map that contains the
    /// estimate.
    pub fn note_covariance(
        &mut self,
        keyframe_id: u64,
        map_from_keyframe: &Sim3,
        relative_place: &KeyframePoseCovariance,
    ) {
        if self.is_on() {
            let covariance = relative_place.of_left_increment(map_from_keyframe);
            Arc::make_mut(&mut self.record).relative_covariances.insert(keyframe_id, covariance);
        }
    }

    /// Covariance of the left increment of a keyframe's pose relative to those it was estimated with; `None` where that
    /// is not known.
    pub(super) fn link_covariance(&self, keyframe_id: u64) -> Option<Matrix7> {
        let known = self.record.relative_covariances.get(&keyframe_id)?;
        let covariance = known * self.params.drift_inflation + of_deviations(MIN_STD_DEVS);
        covariance.cholesky().map(|_| covariance)
    }
}

/// Covariance of a left increment that is carried along by a similarity to its left.
pub(super) fn along(by: &Sim3, covariance: &Matrix7) -> Matrix7 {
    let adjoint = by.adjoint();
    adjoint * covariance * adjoint.transpose()
}

/// Covariance of independent errors with these standard deviations (translation, rotation, ln s).
pub(super) fn of_deviations([translation, rotation, scale]: [f64; 3]) -> Matrix7 {
    let (t, r) = (translation * translation, rotation * rotation);
    Matrix7::from_diagonal(&[t, t, t, r, r, r, scale * scale].into())
}
