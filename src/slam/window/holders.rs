//! What holds the keyframes of an estimate in place.
//!
//! The errors of the keyframes that hold others move these along. Only older ones count: a pass estimates a keyframe
//! against newer ones too, which were themselves estimated against it, and the same errors would be counted again with
//! every pass.

use crate::slam::window::members::MIN_COMMON;

/// A keyframe that held another in place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Holder {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Its share of the comparisons by which older keyframes held the other; all shares add up to 1.
    pub share: f64,
}

/// Comparisons of two members of an estimate that are inliers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Comparisons {
    pub members: [usize; 2],
    pub inliers: usize,
}

/// For each member, the fixed ones with smaller ids that hold it: those compared with the free ones that it is connected
/// to. Empty for fixed members, and where there are none.
pub(super) fn holders(
    ids: &[u64],
    is_free: &[bool],
    comparisons: &[Comparisons],
) -> Vec<Vec<Holder>> {
    let connections = connections(ids.len(), comparisons);
    let group = groups(is_free, &connections);
    let mut counts = vec![vec![0; ids.len()]; ids.len()];
    for &Comparisons { members: [one, other], inliers } in &connections {
        match (is_free[one], is_free[other]) {
            (true, false) => counts[group[one]][other] += inliers,
            (false, true) => counts[group[other]][one] += inliers,
            _ => {}
        }
    }
    let of_member = |member: usize| {
        let of_group = ids.iter().zip(&counts[group[member]]);
        let older = of_group.filter(|&(&id, &count)| count > 0 && id < ids[member]);
        let sum = older.clone().map(|(_, &count)| count).sum::<usize>() as f64;
        let holder = |(&keyframe_id, &count)| Holder { keyframe_id, share: count as f64 / sum };
        if is_free[member] { older.map(holder).collect() } else { Vec::new() }
    };
    (0..ids.len()).map(of_member).collect()
}

/// Those of two members in both directions together, where they are enough for one to hold the other.
fn connections(num_members: usize, comparisons: &[Comparisons]) -> Vec<Comparisons> {
    let mut inliers = vec![vec![0; num_members]; num_members];
    for of in comparisons {
        let [one, other] = of.members;
        inliers[one.min(other)][one.max(other)] += of.inliers;
    }
    let pairs =
        (0..num_members).flat_map(|one| (one + 1..num_members).map(move |other| [one, other]));
    let of_pair =
        |members: [usize; 2]| Comparisons { members, inliers: inliers[members[0]][members[1]] };
    pairs.map(of_pair).filter(|of| of.inliers >= MIN_COMMON).collect()
}

/// For each member, the first of the free ones that it is connected to.
fn groups(is_free: &[bool], connections: &[Comparisons]) -> Vec<usize> {
    let mut group: Vec<usize> = (0..is_free.len()).collect();
    let is_free = |of: &&Comparisons| of.members.iter().all(|&of| is_free[of]);
    loop {
        let mut is_settled = true;
        for &Comparisons { members: [one, other], .. } in connections.iter().filter(is_free) {
            let first = group[one].min(group[other]);
            is_settled &= group[one] == first && group[other] == first;
            (group[one], group[other]) = (first, first);
        }
        if is_settled {
            return group;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Holders of each member as (id, share), from (one, other, inliers).
    fn held(
        ids: &[u64],
        fixed: &[usize],
        compared: &[(usize, usize, usize)],
    ) -> Vec<Vec<(u64, f64)>> {
        let is_free: Vec<bool> = (0..ids.len()).map(|member| !fixed.contains(&member)).collect();
        let comparisons = compared
            .iter()
            .map(|&(one, other, inliers)| Comparisons { members: [one, other], inliers });
        let found = holders(ids, &is_free, &comparisons.collect::<Vec<_>>());
        let pairs = |of: &Vec<Holder>| of.iter().map(|of| (of.keyframe_id, of.share)).collect();
        found.iter().map(pairs).collect()
    }

    #[test]
    fn shares_are_those_of_the_comparisons_with_all_that_is_connected() {
        // 3 is compared with 2 alone, in both directions; 1 sees nothing of the free ones.
        let compared = [(0, 2, 50), (2, 0, 10), (1, 3, 19), (2, 3, 10), (3, 2, 10), (1, 2, 20)];
        let found = held(&[10, 11, 12, 13], &[0, 1], &compared);
        let expected = vec![(10, 0.75), (11, 0.25)];
        assert_eq!(found, [vec![], vec![], expected.clone(), expected]);
    }

    #[test]
    fn what_is_not_connected_has_separate_holders() {
        let compared = [(0, 2, 20), (1, 3, 30), (3, 4, 20), (2, 3, 19)];
        let found = held(&[10, 11, 12, 13, 14], &[0, 1], &compared);
        let by = |id: u64| vec![(id, 1.0)];
        assert_eq!(found, [vec![], vec![], by(10), by(11), by(11)]);
    }

    #[test]
    fn newer_keyframes_hold_none_and_leave_the_rest_to_the_older() {
        let compared = [(0, 1, 20), (1, 2, 60), (1, 3, 20), (3, 2, 20)];
        let found = held(&[10, 11, 13, 12], &[0, 2], &compared);
        assert_eq!(found, [vec![], vec![(10, 1.0)], vec![], vec![(10, 1.0)]]);
        // 11 and 12 are held by 13 alone.
        let found = held(&[10, 11, 13, 12], &[0, 2], &compared[1..]);
        assert_eq!(found, vec![Vec::new(); 4]);
    }
}
