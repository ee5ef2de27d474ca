//! Matches the poses of two trajectories: nearest stamps, no interpolation.

use crate::slam::trajectory::StampedPose;

/// Pairs (index in the estimate, index in the ground truth) in order of time: matches each pose of the trajectory with
/// fewer poses (the estimate where both have as many) with the nearest of the other, if their stamps differ by at most
/// `max_difference_nanos`; the earlier of two that are equally near. This is the rule of the package `evo`, which may
/// use one pose of the longer trajectory twice. Both trajectories are in order of their stamps.
pub fn associate(
    estimate: &[StampedPose],
    truth: &[StampedPose],
    max_difference_nanos: i64,
) -> Vec<(usize, usize)> {
    if estimate.len() <= truth.len() {
        matches(estimate, truth, max_difference_nanos).collect()
    } else {
        matches(truth, estimate, max_difference_nanos).map(|(t, e)| (e, t)).collect()
    }
}

/// Differences between the stamps of each pose of the shorter trajectory and the nearest pose of the longer one,
/// nanoseconds, the smallest first.
pub fn differences(estimate: &[StampedPose], truth: &[StampedPose]) -> Vec<u64> {
    let (short, long) =
        if estimate.len() <= truth.len() { (estimate, truth) } else { (truth, estimate) };
    let to_nearest = |pose: &StampedPose| {
        nearest(long, pose.nanos, i64::MAX).map(|j| long[j].nanos.abs_diff(pose.nanos))
    };
    let mut differences: Vec<u64> = short.iter().filter_map(to_nearest).collect();
    differences.sort_unstable();
    differences
}

fn matches<'a>(
    short: &'a [StampedPose],
    long: &'a [StampedPose],
    max_difference_nanos: i64,
) -> impl Iterator<Item = (usize, usize)> + 'a {
    short.iter().enumerate().filter_map(move |(i, pose)| {
        nearest(long, pose.nanos, max_difference_nanos).map(|j| (i, j))
    })
}

/// Index of the pose nearest to `nanos`, at most `max_difference_nanos` away; the earlier of two that are equally near.
/// `poses` are in order of their stamps.
pub fn nearest(poses: &[StampedPose], nanos: i64, max_difference_nanos: i64) -> Option<usize> {
    let after = poses.partition_point(|pose| pose.nanos < nanos);
    // The first of equal stamps stands for all of them.
    let before = after
        .checked_sub(1)
        .map(|last| poses.partition_point(|pose| pose.nanos < poses[last].nanos));
    let difference = |i: &usize| poses[*i].nanos.abs_diff(nanos);
    let best = [before, (after < poses.len()).then_some(after)]
        .into_iter()
        .flatten()
        .min_by_key(difference)?;
    (i128::from(difference(&best)) <= i128::from(max_difference_nanos)).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;

    fn stamps(millis: &[i64]) -> Vec<StampedPose> {
        let pose =
            |&m: &i64| StampedPose { nanos: m * 1_000_000, world_from_camera: SE3::identity() };
        millis.iter().map(pose).collect()
    }

    /// Pairs of stamps (ground truth, estimate); the expected ones are those of `evo` 1.38.1 for the same stamps.
    fn pairs(truth: &[i64], estimate: &[i64]) -> Vec<(i64, i64)> {
        associate(&stamps(estimate), &stamps(truth), 20_000_000)
            .iter()
            .map(|&(e, t)| (truth[t], estimate[e]))
            .collect()
    }

    #[test]
    fn pairs_are_those_of_evo() {
        let every_second = [0, 1000, 2000, 3000, 4000];
        assert_eq!(
            pairs(&every_second, &[990, 1010, 1015]),
            [(1000, 990), (1000, 1010), (1000, 1015)]
        );
        assert_eq!(pairs(&[995, 1001, 2015], &[0, 1000, 2000]), [(1001, 1000), (2015, 2000)]);
        assert_eq!(
            pairs(&[0, 1000, 2000], &[995, 1001, 2015]),
            [(1000, 995), (1000, 1001), (2000, 2015)]
        );
        assert_eq!(pairs(&[990, 1010, 3000, 4000], &[1000, 3010]), [(990, 1000), (3000, 3010)]);
        assert_eq!(pairs(&[1000, 3010], &[990, 1010, 3000, 4000]), [(1000, 990), (3010, 3000)]);
        assert_eq!(
            pairs(&[0, 1000, 1020, 3000, 4000], &[1011, 1012]),
            [(1020, 1011), (1020, 1012)]
        );
        assert_eq!(pairs(&[0, 1000, 2000, 3000], &[1021, 2030, 2050]), []);
    }

    #[test]
    fn extreme_stamps_do_not_overflow() {
        let mut poses = stamps(&[0, 0, 0]);
        poses[0].nanos = i64::MIN;
        poses[2].nanos = i64::MAX;
        assert_eq!(nearest(&poses, i64::MAX, 0), Some(2));
        assert_eq!(nearest(&poses, i64::MIN + 1, i64::MAX), Some(0));
        assert_eq!(nearest(&poses, 1, -1), None);
        assert_eq!(nearest(&[], 1, i64::MAX), None);
    }
}
