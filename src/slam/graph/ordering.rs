//! A fill-reducing order of elimination: approximate minimum degree (Amestoy, Davis, Duff 1996) on keyframes.
//!
//! The remaining graph is kept as a quotient graph: an eliminated keyframe becomes an *element*, which represents all
//! edges between the keyframes that it was connected to. The keyframes of an element are exactly the structure of a
//! column of the factor; only the degrees by which the next one is chosen are bounds.

use std::collections::BTreeSet;

/// An eliminated keyframe, and the remaining ones it was connected to at that point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Column {
    /// Its index.
    pub pivot: usize,
    /// The rows of its column of the factor below the diagonal, in no particular order.
    pub rows: Vec<usize>,
}

/// The order of elimination of the nodes of a graph, given by the neighbours of each, with the structure of the factor.
/// Among nodes of equal degree the first is taken. `None` where the factor has more than `most_blocks` blocks.
pub(super) fn minimum_degree(neighbours: &[Vec<usize>], most_blocks: usize) -> Option<Vec<Column>> {
    let mut quotient = Quotient::new(neighbours);
    let mut order = Vec::with_capacity(neighbours.len());
    let mut blocks = 0;
    while let Some((_, pivot)) = quotient.queue.pop_first() {
        let rows = quotient.eliminate(pivot);
        blocks += 1 + rows.len();
        if blocks > most_blocks {
            return None;
        }
        order.push(Column { pivot, rows });
    }
    Some(order)
}

struct Quotient {
    /// Neighbours of a node that are not represented by an element.
    direct: Vec<Vec<usize>>,
    /// Elements that a node belongs to.
    elements: Vec<Vec<usize>>,
    /// Nodes of an element, by its pivot; when one of them is eliminated, the element is absorbed.
    members: Vec<Vec<usize>>,
    is_element: Vec<bool>,
    degree: Vec<usize>,
    /// (degree, node) of the remaining nodes.
    queue: BTreeSet<(usize, usize)>,
    /// Pivot + 1 of the elimination in which a node was last a row, or an element last counted.
    row_of: Vec<usize>,
    counted_in: Vec<usize>,
    /// Nodes of an element that are not rows of the current elimination.
    outside: Vec<usize>,
}

impl Quotient {
    fn new(neighbours: &[Vec<usize>]) -> Self {
        let number = neighbours.len();
        let degree: Vec<usize> = neighbours.iter().map(Vec::len).collect();
        Self {
            direct: neighbours.to_vec(),
            elements: vec![Vec::new(); number],
            members: vec![Vec::new(); number],
            is_element: vec![false; number],
            queue: degree.iter().copied().zip(0..).collect(),
            degree,
            row_of: vec![0; number],
            counted_in: vec![0; number],
            outside: vec![0; number],
        }
    }

    /// Turns a node into an element and returns its rows.
    fn eliminate(&mut self, pivot: usize) -> Vec<usize> {
        let mark = pivot + 1;
        let rows = self.rows_of(pivot, mark);
        self.count_outside(&rows, mark);
        for &row in &rows {
            let (row_of, is_element, outside) = (&self.row_of, &self.is_element, &self.outside);
            // The new element represents the edges among its rows, and elements that lie within it.
            self.direct[row].retain(|&other| row_of[other] != mark && other != pivot);
            self.elements[row].retain(|&e| is_element[e] && outside[e] > 0);
            let through_elements: usize = self.elements[row].iter().map(|&e| outside[e]).sum();
            let among_rows = rows.len() - 1;
            let bound = self.direct[row].len() + among_rows + through_elements;
            let degree = bound.min(self.degree[row] + among_rows).min(self.queue.len() - 1);
            self.elements[row].push(pivot);
            self.queue.remove(&(self.degree[row], row));
            self.queue.insert((degree, row));
            self.degree[row] = degree;
        }
        self.members[pivot].clone_from(&rows);
        self.is_element[pivot] = true;
        rows
    }

    /// The nodes that the pivot is connected to, directly or through elements, which the new element absorbs.
    fn rows_of(&mut self, pivot: usize, mark: usize) -> Vec<usize> {
        self.row_of[pivot] = mark;
        let mut rows = Vec::new();
        let mut take = |node: usize, row_of: &mut [usize]| {
            if row_of[node] != mark {
                row_of[node] = mark;
                rows.push(node);
            }
        };
        for node in std::mem::take(&mut self.direct[pivot]) {
            take(node, &mut self.row_of);
        }
        for element in std::mem::take(&mut self.elements[pivot]) {
            self.is_element[element] = false;
            for node in std::mem::take(&mut self.members[element]) {
                take(node, &mut self.row_of);
            }
        }
        rows
    }

    /// For every element that shares a row: how many of its nodes are not rows.
    fn count_outside(&mut self, rows: &[usize], mark: usize) {
        for &row in rows {
            for &element in &self.elements[row] {
                if self.counted_in[element] != mark {
                    self.counted_in[element] = mark;
                    self.outside[element] = self.members[element].len();
                }
                self.outside[element] = self.outside[element].saturating_sub(1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::Random;

    /// The structure of the factor by definition.
    fn eliminate_plainly(neighbours: &[Vec<usize>], order: &[Column]) -> Vec<Vec<usize>> {
        let mut left: Vec<BTreeSet<usize>> =
            neighbours.iter().map(|n| n.iter().copied().collect()).collect();
        let mut columns = Vec::new();
        for Column { pivot, .. } in order {
            let rows: Vec<usize> = std::mem::take(&mut left[*pivot]).into_iter().collect();
            for &row in &rows {
                left[row].extend(rows.iter().filter(|&&other| other != row));
                left[row].remove(pivot);
            }
            columns.push(rows);
        }
        columns
    }

    fn random_graph(number: usize, edges: usize, seed: u64) -> Vec<Vec<usize>> {
        let mut random = Random::new(seed);
        let mut sets = vec![BTreeSet::new(); number];
        for _ in 0..edges {
            let mut node = || ((random.uniform() * number as f64) as usize).min(number - 1);
            let (a, b) = (node(), node());
            if a != b {
                sets[a].insert(b);
                sets[b].insert(a);
            }
        }
        sets.into_iter().map(|set| set.into_iter().collect()).collect()
    }

    #[test]
    fn structure_is_that_of_elimination_in_this_order() {
        for seed in 0..20 {
            let neighbours = random_graph(40, 20 + 5 * seed as usize, seed);
            let order = minimum_degree(&neighbours, usize::MAX).unwrap();
            let mut pivots: Vec<usize> = order.iter().map(|column| column.pivot).collect();
            let plain = eliminate_plainly(&neighbours, &order);
            for (column, expected) in order.iter().zip(plain) {
                let mut rows = column.rows.clone();
                rows.sort_unstable();
                assert_eq!(rows, expected, "seed {seed}, pivot {}", column.pivot);
            }
            pivots.sort_unstable();
            assert_eq!(pivots, (0..40).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_chain_and_a_star_have_no_fill_and_a_grid_little() {
        let fill = |neighbours: &[Vec<usize>]| -> usize {
            let order = minimum_degree(neighbours, usize::MAX).unwrap();
            order.iter().map(|column| column.rows.len()).sum()
        };
        let chain: Vec<Vec<usize>> = (0..50usize)
            .map(|k| [k.wrapping_sub(1), k + 1].into_iter().filter(|&n| n < 50).collect())
            .collect();
        assert_eq!(fill(&chain), 49);
        assert!(minimum_degree(&chain, 99).is_some() && minimum_degree(&chain, 98).is_none());
        let star: Vec<Vec<usize>> =
            (0..50).map(|k| if k == 0 { (1..50).collect() } else { vec![0] }).collect();
        assert_eq!(fill(&star), 49);
        const SIDE: usize = 20;
        let grid: Vec<Vec<usize>> = (0..SIDE * SIDE)
            .map(|k| {
                let (x, y) = (k % SIDE, k / SIDE);
                let mut near = Vec::new();
                (x > 0).then(|| near.push(k - 1));
                (x + 1 < SIDE).then(|| near.push(k + 1));
                (y > 0).then(|| near.push(k - SIDE));
                (y + 1 < SIDE).then(|| near.push(k + SIDE));
                near
            })
            .collect();
        // Row by row it is about 20 for each of 400 nodes: require less than half of that.
        assert!(fill(&grid) < 3800, "{}", fill(&grid));
    }
}
