//! The problem of a pose graph: keyframes with their similarities, and measurements between pairs of them.

use crate::slam::geometry::sim3::{Matrix7, Sim3};
use crate::slam::graph::robust::RobustKernel;

/// Maximum number of keyframes of a graph: a week of mapping at ten keyframes a minute.
pub const MAX_VERTICES: usize = 100_000;
/// Maximum number of constraints of a graph: twenty per keyframe.
pub const MAX_CONSTRAINTS: usize = 2_000_000;
/// Share of its diagonal (which is scaled to 1) by which an information matrix may differ from its transpose, and be
/// negative in a direction: the error of rounding to six digits.
const INFORMATION_ROUNDING: f64 = 1e-5;

/// Index of a vertex, in order of insertion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct VertexId(pub(super) usize);

impl VertexId {
    /// Its position in the order of insertion.
    pub fn index(self) -> usize {
        self.0
    }
}

/// A keyframe of the graph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vertex {
    /// Its similarity in the map.
    pub map_from_keyframe: Sim3,
    /// Whether the similarity is held fixed.
    pub is_fixed: bool,
}

/// A measurement of the similarity between two keyframes (Engel, Schöps, Cremers 2014, §3.6).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Constraint {
    /// Keyframe i.
    pub i: VertexId,
    /// Keyframe j.
    pub j: VertexId,
    /// The similarity as measured.
    pub j_from_i: Sim3,
    /// Inverse covariance of the left increment (translation, rotation, log scale) of `j_from_i`; 0 in a direction that
    /// was not measured.
    pub information: Matrix7,
    /// Loss applied to its error.
    pub kernel: RobustKernel,
}

/// Why a graph rejects a vertex or a constraint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum GraphError {
    /// The vertex is not a valid similarity.
    #[error("the pose of vertex {0} is not finite or its scale is not positive")]
    InvalidVertex(usize),
    /// The graph already has the maximum number of vertices or constraints.
    #[error("a pose graph has at most {MAX_VERTICES} vertices and {MAX_CONSTRAINTS} constraints")]
    TooLarge,
    /// A constraint names a vertex that the graph does not have, or one vertex twice.
    #[error("constraint {0} is not between two vertices of the graph")]
    InvalidEnds(usize),
    /// The measurement is not a valid similarity.
    #[error("the measurement of constraint {0} is not finite or its scale is not positive")]
    InvalidMeasurement(usize),
    /// The information is not an inverse covariance.
    #[error(
        "the information of constraint {0} is not finite, symmetric and positive semi-definite"
    )]
    InvalidInformation(usize),
    /// The kernel's threshold is invalid.
    #[error("the robust kernel of constraint {0} needs a positive, finite threshold")]
    InvalidKernel(usize),
}

/// Keyframes and measurements between them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PoseGraph {
    vertices: Vec<Vertex>,
    constraints: Vec<Constraint>,
}

impl PoseGraph {
    /// A graph without vertices.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a keyframe at `map_from_keyframe`; a fixed one stays there.
    pub fn add_vertex(
        &mut self,
        map_from_keyframe: Sim3,
        is_fixed: bool,
    ) -> Result<VertexId, GraphError> {
        let id = self.vertices.len();
        if id >= MAX_VERTICES {
            return Err(GraphError::TooLarge);
        }
        if !map_from_keyframe.is_valid() {
            return Err(GraphError::InvalidVertex(id));
        }
        self.vertices.push(Vertex { map_from_keyframe, is_fixed });
        Ok(VertexId(id))
    }

    /// Adds a measurement between two keyframes of the graph.
    pub fn add_constraint(&mut self, constraint: Constraint) -> Result<(), GraphError> {
        let number = self.constraints.len();
        if number >= MAX_CONSTRAINTS {
            return Err(GraphError::TooLarge);
        }
        let (i, j) = (constraint.i, constraint.j);
        if i == j || i.0.max(j.0) >= self.vertices.len() {
            return Err(GraphError::InvalidEnds(number));
        }
        if !constraint.j_from_i.is_valid() {
            return Err(GraphError::InvalidMeasurement(number));
        }
        if !is_information(&constraint.information) {
            return Err(GraphError::InvalidInformation(number));
        }
        if !constraint.kernel.is_valid() {
            return Err(GraphError::InvalidKernel(number));
        }
        // From here on only the lower triangle counts; the upper one is made equal.
        let information = (constraint.information + constraint.information.transpose()) * 0.5;
        self.constraints.push(Constraint { information, ..constraint });
        Ok(())
    }

    /// The keyframes, in order of insertion.
    pub fn vertices(&self) -> &[Vertex] {
        &self.vertices
    }

    /// The measurements, in order of insertion.
    pub fn constraints(&self) -> &[Constraint] {
        &self.constraints
    }

    /// The current similarity of a keyframe; `None` where the id belongs to another graph with more vertices.
    pub fn map_from_keyframe(&self, id: VertexId) -> Option<&Sim3> {
        self.vertices.get(id.0).map(|vertex| &vertex.map_from_keyframe)
    }

    /// The similarities of all vertices, for the solver.
    pub(super) fn places_mut(&mut self) -> impl Iterator<Item = &mut Sim3> {
        self.vertices.iter_mut().map(|vertex| &mut vertex.map_from_keyframe)
    }
}

/// Whether a matrix is finite, symmetric and positive semi-definite, up to rounding. Metres, radians and logarithms
/// have no common size: each direction is scaled by its own diagonal element, so that units do not matter.
fn is_information(matrix: &Matrix7) -> bool {
    let diagonal = matrix.diagonal();
    // The sum of squares must be finite, too: products of the entries are formed.
    if !(matrix.norm_squared().is_finite() && diagonal.min() >= 0.0) {
        return false;
    }
    let mut scaled = *matrix;
    for (k, &element) in diagonal.iter().enumerate() {
        // A direction that was not measured has zeros only, and stays so.
        let factor = if element > 0.0 { 1.0 / element.sqrt() } else { 1.0 };
        scaled.row_mut(k).scale_mut(factor);
        scaled.column_mut(k).scale_mut(factor);
        let is_unknown = element == 0.0;
        if is_unknown && (matrix.row(k).amax() > 0.0 || matrix.column(k).amax() > 0.0) {
            return false;
        }
    }
    (scaled - scaled.transpose()).amax() <= INFORMATION_ROUNDING
        && scaled.symmetric_eigenvalues().min() >= -INFORMATION_ROUNDING
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_parts_are_refused() {
        let mut graph = PoseGraph::new();
        let place = Sim3::identity();
        let bad = Sim3 { scale: f64::NAN, ..place };
        assert_eq!(graph.add_vertex(bad, false), Err(GraphError::InvalidVertex(0)));
        assert!(graph.add_vertex(Sim3 { scale: -1.0, ..place }, false).is_err());
        let i = graph.add_vertex(place, true).unwrap();
        let j = graph.add_vertex(place, false).unwrap();
        let kernel = RobustKernel::None;
        let good = Constraint { i, j, j_from_i: place, information: Matrix7::identity(), kernel };
        let mut asymmetric = Matrix7::identity();
        asymmetric[(0, 1)] = 0.5;
        let mut indefinite = Matrix7::identity();
        indefinite[(6, 6)] = -0.1;
        let mut unknown_scale = Matrix7::identity();
        unknown_scale[(6, 6)] = 0.0;
        for (constraint, error) in [
            (Constraint { j: i, ..good }, GraphError::InvalidEnds(0)),
            (Constraint { j: VertexId(2), ..good }, GraphError::InvalidEnds(0)),
            (Constraint { j_from_i: bad, ..good }, GraphError::InvalidMeasurement(0)),
            (Constraint { information: asymmetric, ..good }, GraphError::InvalidInformation(0)),
            (Constraint { information: indefinite, ..good }, GraphError::InvalidInformation(0)),
            (
                Constraint { information: Matrix7::repeat(f64::NAN), ..good },
                GraphError::InvalidInformation(0),
            ),
            (
                Constraint { information: Matrix7::identity() * 1e200, ..good },
                GraphError::InvalidInformation(0),
            ),
            (
                Constraint { kernel: RobustKernel::Huber { threshold: 0.0 }, ..good },
                GraphError::InvalidKernel(0),
            ),
        ] {
            assert_eq!(graph.add_constraint(constraint), Err(error));
        }
        assert!(graph.constraints().is_empty());
        for information in [Matrix7::identity(), unknown_scale, Matrix7::zeros()] {
            assert_eq!(graph.add_constraint(Constraint { information, ..good }), Ok(()));
        }
    }

    /// Rotations and translations with correlation `correlation`, rounded, the translations in units of `unit`.
    fn correlated(correlation: f64, unit: f64) -> Matrix7 {
        let mut information = Matrix7::identity();
        information[(0, 4)] = correlation;
        information[(4, 0)] = correlation;
        for k in 0..3 {
            information.row_mut(k).scale_mut(unit);
            information.column_mut(k).scale_mut(unit);
        }
        information
    }

    #[test]
    fn the_check_of_an_information_does_not_depend_on_units() {
        for unit in [1e-6, 1e-3, 1.0, 1e3, 1e6] {
            assert!(is_information(&correlated(0.9, unit)), "{unit}");
            assert!(is_information(&correlated(1.0 + 1e-6, unit)), "rounded, {unit}");
            assert!(!is_information(&correlated(1.1, unit)), "{unit}");
            let mut negative = correlated(0.0, unit);
            negative[(5, 5)] = -1e-6;
            assert!(!is_information(&negative), "{unit}");
            let mut tied = correlated(0.0, unit);
            (tied[(6, 6)], tied[(6, 0)], tied[(0, 6)]) = (0.0, 1e-6 * unit, 1e-6 * unit);
            assert!(!is_information(&tied), "{unit}");
            let mut asymmetric = correlated(0.5, unit);
            asymmetric[(0, 4)] *= 1.01;
            assert!(!is_information(&asymmetric), "{unit}");
        }
    }
}
