//! A binary tree over binary descriptors that grows with them (Schlegel, Grisetti 2018): a node asks for one bit, a leaf
//! that is full is split at the bit that halves it best.

use super::pattern::{BITS, WORDS};

/// Entries beyond which a leaf is split.
const SPLIT_AT: usize = 48;
/// Entries that a leaf which no bit splits keeps: more that look the same tell nothing.
const MOST_IN_LEAF: usize = 4 * SPLIT_AT;
/// Least share of the entries on the smaller side of a split.
const LEAST_SHARE: f32 = 0.1;

/// A descriptor and whose it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) bits: [u64; WORDS],
    /// Place of the keyframe in the index.
    pub(super) slot: u32,
    /// Number of the feature in the keyframe.
    pub(super) feature: u16,
}

#[derive(Debug, Clone)]
enum Node {
    Split { bit: u16, children: [u32; 2] },
    Leaf(Vec<Entry>),
}

/// The tree.
#[derive(Debug, Clone)]
pub(super) struct Tree {
    nodes: Vec<Node>,
}

impl Tree {
    pub(super) fn new() -> Self {
        Self { nodes: vec![Node::Leaf(Vec::new())] }
    }

    /// Enters a descriptor.
    pub(super) fn insert(&mut self, entry: Entry) {
        let at = self.leaf_of(&entry.bits);
        let Node::Leaf(entries) = &mut self.nodes[at] else { return };
        if entries.len() < SPLIT_AT {
            entries.push(entry);
            return;
        }
        let Some(bit) = best_bit(entries) else {
            if entries.len() < MOST_IN_LEAF {
                entries.push(entry);
            }
            return;
        };
        let (mut set, mut unset) = (Vec::new(), Vec::new());
        for other in entries.drain(..).chain([entry]) {
            if has(&other.bits, bit) { set.push(other) } else { unset.push(other) }
        }
        let next = self.nodes.len() as u32;
        self.nodes[at] = Node::Split { bit, children: [next, next + 1] };
        self.nodes.extend([Node::Leaf(unset), Node::Leaf(set)]);
    }

    /// The leaf of a descriptor.
    fn leaf_of(&self, bits: &[u64; WORDS]) -> usize {
        let mut at = 0;
        while let Node::Split { bit, children } = &self.nodes[at] {
            at = children[usize::from(has(bits, *bit))] as usize;
        }
        at
    }

    /// Visits the leaf of a descriptor, and `most − 1` others at most that it would be in if one of its `unsure` bits were
    /// another.
    pub(super) fn visit(
        &self,
        bits: &[u64; WORDS],
        unsure: &[u64; WORDS],
        most: usize,
        visit: &mut impl FnMut(&[Entry]),
    ) {
        let mut others: [u32; MOST_LEAVES] = [0; MOST_LEAVES];
        let mut known = 0;
        let mut at = 0;
        let most = most.min(MOST_LEAVES);
        for visited in 0..most {
            loop {
                match &self.nodes[at] {
                    Node::Split { bit, children } => {
                        let is_set = has(bits, *bit);
                        if has(unsure, *bit) && known < most - 1 {
                            others[known] = children[usize::from(!is_set)];
                            known += 1;
                        }
                        at = children[usize::from(is_set)] as usize;
                    }
                    Node::Leaf(entries) => {
                        visit(entries);
                        break;
                    }
                }
            }
            match others[..known].get(visited) {
                Some(&other) => at = other as usize,
                None => break,
            }
        }
    }

    /// Takes entries out.
    pub(super) fn retain(&mut self, is_kept: impl Fn(&Entry) -> bool) {
        for node in &mut self.nodes {
            if let Node::Leaf(entries) = node {
                entries.retain(&is_kept);
            }
        }
    }

    /// Gives keyframes the places `new` has for theirs.
    pub(super) fn renumber(&mut self, new: &[u32]) {
        for node in &mut self.nodes {
            if let Node::Leaf(entries) = node {
                entries.iter_mut().for_each(|entry| entry.slot = new[entry.slot as usize]);
            }
        }
    }

    /// Bytes of memory.
    pub(super) fn bytes(&self) -> usize {
        let leaf = |node: &Node| match node {
            Node::Leaf(entries) => entries.capacity() * size_of::<Entry>(),
            Node::Split { .. } => 0,
        };
        self.nodes.capacity() * size_of::<Node>() + self.nodes.iter().map(leaf).sum::<usize>()
    }
}

/// Most leaves that are visited for one descriptor.
pub(super) const MOST_LEAVES: usize = 16;

fn has(bits: &[u64; WORDS], bit: u16) -> bool {
    bits[usize::from(bit) / 64] >> (bit % 64) & 1 == 1
}

/// The bit that is set in the share of the entries closest to a half.
fn best_bit(entries: &[Entry]) -> Option<u16> {
    let mut counts = [0usize; BITS];
    for entry in entries {
        for (word, counts) in entry.bits.iter().zip(counts.chunks_exact_mut(64)) {
            for (k, count) in counts.iter_mut().enumerate() {
                *count += (word >> k & 1) as usize;
            }
        }
    }
    let smaller = |k: usize| counts[k].min(entries.len() - counts[k]);
    let best = (0..BITS).max_by_key(|&k| (smaller(k), std::cmp::Reverse(k)))?;
    (smaller(best) as f32 >= LEAST_SHARE * entries.len() as f32).then_some(best as u16)
}

/// Bits that differ.
#[inline(always)]
pub(super) fn distance(one: &[u64; WORDS], other: &[u64; WORDS]) -> u32 {
    one.iter().zip(other).map(|(a, b)| (a ^ b).count_ones()).sum()
}
