//! The plan of a sparse Cholesky factorisation: which keyframes are eliminated together, in which dense matrix.
//!
//! Columns of the factor with (nearly) the same structure are eliminated together in a dense *front* (the multifrontal
//! method: Duff, Reid 1983; Liu 1992). Its lower right part is added to the front of its parent. The plan is made once
//! per graph and used in every iteration.

use crate::slam::graph::ordering::{Column, minimum_degree};

/// Share of zeros that a front may contain in excess of separate fronts for its columns: larger products cost less than
/// the operations saved. Shares by the number of keyframes that are eliminated in it.
const MAX_ZEROS: [(usize, f64); 3] = [(2, 0.6), (6, 0.2), (usize::MAX, 0.05)];

/// A part of the matrix that is added to a front: the block of nodes (row, column) or its transpose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry {
    /// Index of the block in the matrix.
    pub block: usize,
    /// Row in the front, in nodes; row ≥ column.
    pub row: usize,
    /// Column in the front, in nodes.
    pub column: usize,
    /// Whether the block is stored for (column, row).
    pub is_transposed: bool,
}

/// A dense matrix in which some nodes are eliminated.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Front {
    /// Nodes: first those that are eliminated here, then those they are connected to, in order of elimination.
    pub nodes: Vec<usize>,
    /// Number of those that are eliminated.
    pub num_pivots: usize,
    /// The blocks of the matrix that are added here.
    pub entries: Vec<Entry>,
    /// Fronts whose lower right part is added here, with the positions of their nodes.
    pub children: Vec<Child>,
}

/// A front that is added to another.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Child {
    /// Its index.
    pub front: usize,
    /// For each node that was not eliminated in it: its position here.
    pub places: Vec<usize>,
}

/// Fronts ordered so that children precede their parents.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Plan {
    /// The fronts.
    pub fronts: Vec<Front>,
    /// Number of nodes.
    pub num_nodes: usize,
}

impl Plan {
    /// The plan for a symmetric matrix of `num_nodes` diagonal blocks and a block for each of `pairs` (row, column),
    /// which are distinct; `None` where the factor has more than `most_blocks` blocks.
    pub fn new(num_nodes: usize, pairs: &[(usize, usize)], most_blocks: usize) -> Option<Self> {
        let mut neighbours = vec![Vec::new(); num_nodes];
        for &(row, column) in pairs {
            neighbours[row].push(column);
            neighbours[column].push(row);
        }
        let groups = amalgamate(minimum_degree(&neighbours, most_blocks)?);
        let mut plan = Self { fronts: arrange(groups, num_nodes), num_nodes };
        plan.place_entries(pairs);
        Some(plan)
    }

    /// Peak number of blocks in memory: the columns of all fronts, and the lower right parts that wait for their
    /// parents.
    pub fn most_blocks(&self) -> usize {
        let rest = |front: &Front| (front.nodes.len() - front.num_pivots).pow(2);
        let (mut waiting, mut most) = (0, 0);
        for front in &self.fronts {
            waiting += rest(front);
            most = most.max(waiting);
            let of_children = front.children.iter().map(|child| rest(&self.fronts[child.front]));
            waiting -= of_children.sum::<usize>();
        }
        let columns = self.fronts.iter().map(|front| front.nodes.len() * front.num_pivots);
        columns.sum::<usize>() + most
    }

    /// Finds the front of each block: the one that eliminates the first of its nodes.
    fn place_entries(&mut self, pairs: &[(usize, usize)]) {
        let mut front_of = vec![0; self.num_nodes];
        let mut position = vec![0; self.num_nodes];
        let mut next = 0;
        for (number, front) in self.fronts.iter().enumerate() {
            for &node in &front.nodes[..front.num_pivots] {
                (front_of[node], position[node]) = (number, next);
                next += 1;
            }
        }
        let diagonal = (0..self.num_nodes).map(|node| (node, node));
        for (block, (row, column)) in diagonal.chain(pairs.iter().copied()).enumerate() {
            let is_transposed = position[row] < position[column];
            let (late, early) = if is_transposed { (column, row) } else { (row, column) };
            let front = &mut self.fronts[front_of[early]];
            let place = |node| place_in(&front.nodes, &position, node);
            let (row, column) = (place(late), place(early));
            front.entries.push(Entry { block, row, column, is_transposed });
        }
    }
}

/// Position of a node in a front's list, which is in order of elimination.
fn place_in(nodes: &[usize], position: &[usize], node: usize) -> usize {
    let found = nodes.binary_search_by_key(&position[node], |&other| position[other]);
    found.expect("what a node is connected to lies in its front")
}

/// Nodes that are eliminated together.
#[derive(Debug, Clone, Default)]
struct Group {
    pivots: Vec<usize>,
    rows: Vec<usize>,
    /// Blocks of the factor, and how many of them are zero.
    blocks: usize,
    zeros: usize,
    parent: Option<usize>,
}

/// Merges columns into the next one up the elimination tree where that adds few zeros. A merged group is left without
/// pivots.
fn amalgamate(columns: Vec<Column>) -> Vec<Group> {
    let mut step_of = vec![0; columns.len()];
    for (step, column) in columns.iter().enumerate() {
        step_of[column.pivot] = step;
    }
    let mut groups: Vec<Group> = Vec::with_capacity(columns.len());
    for Column { pivot, rows } in columns {
        let parent = rows.iter().map(|&row| step_of[row]).min();
        let blocks = 1 + rows.len();
        groups.push(Group { pivots: vec![pivot], rows, blocks, zeros: 0, parent });
    }
    for step in 0..groups.len() {
        let Some(parent) = groups[step].parent else { continue };
        let (child, into) = (&groups[step], &groups[parent]);
        let (few, many) = (child.pivots.len(), into.pivots.len());
        let added_rows = (many + into.rows.len()).saturating_sub(child.rows.len());
        let added = few * added_rows;
        let zeros = child.zeros + into.zeros + added;
        let blocks = child.blocks + into.blocks + added;
        let bound = MAX_ZEROS.iter().find(|(most, _)| few + many <= *most).map_or(0.0, |b| b.1);
        if zeros as f64 <= bound * blocks as f64 {
            let child = std::mem::take(&mut groups[step]);
            let into = &mut groups[parent];
            // Its rows are among the parent's pivots and rows.
            into.pivots.splice(0..0, child.pivots);
            (into.blocks, into.zeros) = (blocks, zeros);
            groups[step].parent = Some(parent);
        }
    }
    groups
}

/// Fronts of the groups in postorder, so that few lower right parts wait at a time.
fn arrange(groups: Vec<Group>, num_nodes: usize) -> Vec<Front> {
    let mut group_of = vec![0; num_nodes];
    for (number, group) in groups.iter().enumerate() {
        group.pivots.iter().for_each(|&node| group_of[node] = number);
    }
    // The parent is the group into which the first of the rows was merged.
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); groups.len()];
    let mut roots = Vec::new();
    let resolve = |mut group: usize| {
        while groups[group].pivots.is_empty() {
            group = groups[group].parent.expect("what was put into another has it as its parent");
        }
        group
    };
    for (number, group) in groups.iter().enumerate().filter(|(_, group)| !group.pivots.is_empty()) {
        match group.parent {
            Some(parent) => children[resolve(parent)].push(number),
            None => roots.push(number),
        }
    }
    let mut order = Vec::new();
    // A stack of (group, whether its children have been pushed): the tree of a long chain is deep.
    let mut stack: Vec<(usize, bool)> = roots.into_iter().rev().map(|root| (root, false)).collect();
    while let Some((group, is_open)) = stack.pop() {
        if is_open {
            order.push(group);
        } else {
            stack.push((group, true));
            stack.extend(children[group].iter().rev().map(|&child| (child, false)));
        }
    }
    let mut position = vec![0; num_nodes];
    let pivots = order.iter().flat_map(|&group| &groups[group].pivots);
    pivots.enumerate().for_each(|(at, &node)| position[node] = at);
    let mut front_of_group = vec![0; groups.len()];
    let mut fronts: Vec<Front> = Vec::with_capacity(order.len());
    for group in order {
        let mut nodes = groups[group].pivots.clone();
        let num_pivots = nodes.len();
        let mut rows = groups[group].rows.clone();
        rows.sort_unstable_by_key(|&node| position[node]);
        nodes.extend(rows);
        let places = |front: usize| {
            let of: &Front = &fronts[front];
            let rows = of.nodes[of.num_pivots..].iter();
            rows.map(|&node| place_in(&nodes, &position, node)).collect()
        };
        let of = children[group].iter().map(|&child| front_of_group[child]);
        let children = of.map(|front| Child { front, places: places(front) }).collect();
        front_of_group[group] = fronts.len();
        fronts.push(Front { nodes, num_pivots, entries: Vec::new(), children });
    }
    fronts
}
