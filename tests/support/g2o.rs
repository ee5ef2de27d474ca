//! Public pose graphs in g2o format.

use std::collections::BTreeMap;
use std::path::Path;

use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::{Matrix7, Sim3};
use semidense::slam::graph::pose_graph::{Constraint, PoseGraph};
use semidense::slam::graph::robust::RobustKernel;

/// Relative tolerance, by the largest entry, for matrices that are indefinite only by rounding to six digits.
const INFORMATION_ROUNDING: f64 = 1e-5;

/// The graph of a file of `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT` lines: the first vertex is fixed, the others are
/// initialised along a breadth-first tree of constraints from it. Indefinite information (5021 constraints of cubicle)
/// is used without its cross terms of translation and rotation.
pub fn read(path: &Path) -> PoseGraph {
    let text = std::fs::read_to_string(path).unwrap();
    let (mut places, mut edges) = (BTreeMap::new(), Vec::new());
    for line in text.lines() {
        let mut words = line.split_whitespace();
        let kind = words.next();
        let values: Vec<f64> = words.map(|word| word.parse().unwrap()).collect();
        match kind {
            Some("VERTEX_SE3:QUAT") => {
                places.insert(values[0] as usize, similarity(&values[1..]));
            }
            Some("EDGE_SE3:QUAT") => {
                let (i, j) = (values[0] as usize, values[1] as usize);
                edges.push((i, j, similarity(&values[2..]), information(&values[9..])));
            }
            other => panic!("{}: {other:?}", path.display()),
        }
    }
    let mut neighbours = vec![Vec::new(); places.len()];
    for (i, j, i_from_j, _) in &edges {
        neighbours[*i].push((*j, *i_from_j));
        neighbours[*j].push((*i, i_from_j.inverse()));
    }
    let mut start = vec![None; places.len()];
    start[0] = Some(places[&0]);
    let mut waiting = std::collections::VecDeque::from([0]);
    while let Some(vertex) = waiting.pop_front() {
        let place: Sim3 = start[vertex].unwrap();
        for (other, vertex_from_other) in &neighbours[vertex] {
            if start[*other].is_none() {
                start[*other] = Some(place * *vertex_from_other);
                waiting.push_back(*other);
            }
        }
    }
    let mut graph = PoseGraph::new();
    let ids: Vec<_> = start
        .into_iter()
        .enumerate()
        .map(|(number, place)| graph.add_vertex(place.unwrap(), number == 0).unwrap())
        .collect();
    for (i, j, i_from_j, information) in edges {
        let (j_from_i, kernel) = (i_from_j.inverse(), RobustKernel::None);
        let constraint = Constraint { i: ids[i], j: ids[j], j_from_i, information, kernel };
        graph.add_constraint(constraint).unwrap();
    }
    graph
}

fn similarity(values: &[f64]) -> Sim3 {
    let [x, y, z, qx, qy, qz, qw] = values[..7] else { panic!("{values:?}") };
    Sim3::new(SE3::try_from_parts([qx, qy, qz, qw], [x, y, z]).unwrap(), 1.0)
}

/// The upper triangle, row by row, for translation and rotation; scale is unconstrained.
fn information(values: &[f64]) -> Matrix7 {
    let mut matrix = Matrix7::zeros();
    let places = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    for ((row, column), value) in places.zip(&values[..21]) {
        matrix[(row, column)] = *value;
        matrix[(column, row)] = *value;
    }
    if matrix.symmetric_eigenvalues().min() < -INFORMATION_ROUNDING * matrix.amax() {
        matrix.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
        matrix.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    }
    matrix
}
