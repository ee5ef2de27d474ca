//! A binary tree over binary descriptors that grows with them (Schlegel, Grisetti 2018): a node tests one bit, a full
//! leaf is split at the bit that halves it best.

use super::pattern::{BITS, WORDS};

/// Number of entries beyond which a leaf is split.
const SPLIT_AT: usize = 48;
/// Maximum number of entries of a leaf that no bit splits: more identical ones add nothing.
const MAX_IN_LEAF: usize = 4 * SPLIT_AT;
/// Least share of the entries on the smaller side of a split.
const MIN_SHARE: f32 = 0.1;

/// A descriptor and its owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) bits: [u64; WORDS],
    /// Index of the keyframe's slot.
    pub(super) slot: u32,
    /// Index of the feature in the keyframe.
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

impl Default for Tree {
    fn default() -> Self {
        Self { nodes: vec![Node::Leaf(Vec::new())] }
    }
}

impl Tree {
    /// Inserts a descriptor.
    pub(super) fn insert(&mut self, entry: Entry) {
        let at = self.leaf_of(&entry.bits);
        let Node::Leaf(entries) = &mut self.nodes[at] else { return };
        if entries.len() < SPLIT_AT {
            entries.push(entry);
            return;
        }
        let Some(bit) = best_bit(entries) else {
            if entries.len() < MAX_IN_LEAF {
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

    /// Visits the leaf of a descriptor, and at most `most − 1` others in which it would be if one of its `unsure` bits
    /// were flipped.
    pub(super) fn visit(
        &self,
        bits: &[u64; WORDS],
        unsure: &[u64; WORDS],
        most: usize,
        visit: &mut impl FnMut(&[Entry]),
    ) {
        let mut others: [u32; MAX_LEAVES] = [0; MAX_LEAVES];
        let mut known = 0;
        let mut at = 0;
        let most = most.min(MAX_LEAVES);
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

    /// Removes entries, and joins leaves that together are small.
    pub(super) fn retain(&mut self, is_kept: impl Fn(&Entry) -> bool) {
        // Children have higher indices than their parents.
        for at in (0..self.nodes.len()).rev() {
            match &mut self.nodes[at] {
                Node::Leaf(entries) => {
                    entries.retain(&is_kept);
                    entries.shrink_to_fit();
                }
                Node::Split { children, .. } => {
                    let children = *children;
                    if let Some(joined) = self.joined(children) {
                        self.nodes[at] = Node::Leaf(joined);
                    }
                }
            }
        }
        self.pack();
    }

    /// The entries of two leaves that together fill at most half a leaf.
    fn joined(&mut self, [one, other]: [u32; 2]) -> Option<Vec<Entry>> {
        let [Node::Leaf(unset), Node::Leaf(set)] =
            self.nodes.get_disjoint_mut([one as usize, other as usize]).ok()?
        else {
            return None;
        };
        (2 * (unset.len() + set.len()) <= SPLIT_AT).then(|| {
            let mut joined = std::mem::take(unset);
            joined.append(set);
            joined
        })
    }

    /// Drops unreachable nodes.
    fn pack(&mut self) {
        let mut old = std::mem::take(&mut self.nodes);
        let mut order = vec![0usize];
        let mut next = 0;
        while let Some(&at) = order.get(next) {
            let node = std::mem::replace(&mut old[at], Node::Leaf(Vec::new()));
            self.nodes.push(match node {
                Node::Split { bit, children } => {
                    let first = order.len() as u32;
                    order.extend(children.map(|child| child as usize));
                    Node::Split { bit, children: [first, first + 1] }
                }
                leaf => leaf,
            });
            next += 1;
        }
    }

    /// Replaces the slot of each keyframe by its value in `new`.
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

/// Maximum number of leaves that are visited for one descriptor.
pub(super) const MAX_LEAVES: usize = 16;

fn has(bits: &[u64; WORDS], bit: u16) -> bool {
    bits[usize::from(bit) / 64] >> (bit % 64) & 1 == 1
}

/// The bit that is set in a share of the entries closest to one half.
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
    (smaller(best) as f32 >= MIN_SHARE * entries.len() as f32).then_some(best as u16)
}

/// Number of bits that differ.
#[inline(always)]
pub(super) fn distance(one: &[u64; WORDS], other: &[u64; WORDS]) -> u32 {
    one.iter().zip(other).map(|(a, b)| (a ^ b).count_ones()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::Random;

    fn random_bits(random: &mut Random) -> [u64; WORDS] {
        std::array::from_fn(|_| {
            (0..64).fold(0, |word, _| word << 1 | u64::from(random.uniform() < 0.5))
        })
    }

    fn found(tree: &Tree, bits: &[u64; WORDS], unsure: &[u64; WORDS], most: usize) -> Vec<u32> {
        let mut slots = Vec::new();
        tree.visit(bits, unsure, most, &mut |entries| slots.extend(entries.iter().map(|e| e.slot)));
        slots
    }

    #[test]
    fn an_inserted_descriptor_is_found_among_few() {
        let mut random = Random::new(1);
        let mut tree = Tree::default();
        let all: Vec<_> = (0..5_000).map(|_| random_bits(&mut random)).collect();
        for (slot, bits) in (0..).zip(&all) {
            tree.insert(Entry { bits: *bits, slot, feature: 0 });
        }
        for (slot, bits) in (0..).zip(&all) {
            let among = found(&tree, bits, &[0; WORDS], 1);
            assert!(
                among.contains(&slot) && among.len() <= SPLIT_AT,
                "{slot} among {}",
                among.len()
            );
        }
    }

    #[test]
    fn a_flipped_bit_is_found_if_it_was_unsure() {
        let mut random = Random::new(2);
        let mut tree = Tree::default();
        let all: Vec<_> = (0..5_000).map(|_| random_bits(&mut random)).collect();
        for (slot, bits) in (0..).zip(&all) {
            tree.insert(Entry { bits: *bits, slot, feature: 0 });
        }
        let Node::Split { bit, .. } = tree.nodes[0] else { panic!("a leaf of 5000") };
        let mut turned = all[0];
        turned[usize::from(bit) / 64] ^= 1 << (bit % 64);
        let unsure = std::array::from_fn(|k| all[0][k] ^ turned[k]);
        assert!(!found(&tree, &turned, &[0; WORDS], 4).contains(&0));
        assert!(found(&tree, &turned, &unsure, 2).contains(&0));
        assert!(!found(&tree, &turned, &unsure, 1).contains(&0));
        let leaf = found(&tree, &turned, &[u64::MAX; WORDS], 1).len();
        assert!(
            found(&tree, &turned, &[u64::MAX; WORDS], 99).len() <= MAX_LEAVES * SPLIT_AT.max(leaf)
        );
    }

    #[test]
    fn identical_descriptors_are_kept_only_a_few_times() {
        let mut tree = Tree::default();
        (0..1_000).for_each(|slot| tree.insert(Entry { bits: [7; WORDS], slot, feature: 0 }));
        assert_eq!(found(&tree, &[7; WORDS], &[0; WORDS], 1).len(), MAX_IN_LEAF);
        tree.retain(|entry| entry.slot == 3);
        assert_eq!(found(&tree, &[7; WORDS], &[0; WORDS], 1), [3]);
    }

    #[test]
    fn removal_keeps_the_others_and_joins_leaves() {
        let mut random = Random::new(3);
        let mut tree = Tree::default();
        let all: Vec<_> = (0..5_000).map(|_| random_bits(&mut random)).collect();
        for (slot, bits) in (0..).zip(&all) {
            tree.insert(Entry { bits: *bits, slot, feature: 0 });
        }
        let nodes = tree.nodes.len();
        tree.retain(|entry| entry.slot % 50 == 0);
        assert!(8 * tree.nodes.len() < nodes, "{nodes} nodes became {}", tree.nodes.len());
        for (slot, bits) in (0..).zip(&all) {
            assert_eq!(
                found(&tree, bits, &[0; WORDS], 1).contains(&slot),
                slot % 50 == 0,
                "{slot}"
            );
        }
        tree.retain(|_| false);
        assert_eq!(tree.nodes.len(), 1);
    }
}
