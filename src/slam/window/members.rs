//! Which keyframes are estimated together, and which of them stay where they are.

use crate::slam::window::Window;
use crate::slam::window::view::Sight;

/// Points that two keyframes must see both for the one to hold the other in place.
const FEWEST_COMMON: usize = 20;
/// Keyframes that are held in place where no older one sees the same things.
const NUM_HELD: usize = 2;

/// Who takes part.
pub(super) struct Chosen {
    /// Places in the list of keyframes.
    pub members: Vec<usize>,
    /// For each its number among the free ones.
    pub free: Vec<Option<usize>>,
    /// Whether the epoch has just begun.
    pub is_first: bool,
}

impl Window {
    /// Who takes part in the estimation of the newest keyframes.
    pub(super) fn choose_members(&self, newest: usize) -> Chosen {
        let epoch = self.keyframes[newest].epoch;
        let of_epoch: Vec<usize> =
            (0..=newest).filter(|&k| self.keyframes[k].epoch == epoch).collect();
        let is_first = of_epoch.len() <= self.params.num_first;
        let num_free =
            if is_first { of_epoch.len() } else { self.params.num_free.min(of_epoch.len()) };
        let (older, free) = of_epoch.split_at(of_epoch.len() - num_free);
        let fixed = self.covisible(older, &free[free.len().saturating_sub(2)..]);
        Chosen::new(fixed, free, older.is_empty(), is_first)
    }

    /// Of the older keyframes those that see most of what the newest see.
    pub(super) fn covisible(&self, older: &[usize], newest: &[usize]) -> Vec<usize> {
        let common = |one: usize, other: usize| {
            let (host, observer) = (&self.keyframes[one], &self.keyframes[other]);
            let sight = Sight::new(
                &(observer.camera_from_map * host.camera_from_map.inverse()),
                &self.camera,
            );
            if !sight.may_see(&host.points) {
                return 0;
            }
            let alive = host.points.iter().filter(|point| point.is_alive);
            alive.filter(|point| sight.sees(point)).count()
        };
        let mut seen: Vec<(usize, usize)> = older
            .iter()
            .map(|&of| (newest.iter().map(|&new| common(of, new) + common(new, of)).sum(), of))
            .filter(|(count, _)| *count > FEWEST_COMMON)
            .collect();
        seen.sort_unstable_by(|one, other| other.cmp(one));
        seen.truncate(self.params.num_fixed);
        seen.into_iter().map(|(_, of)| of).collect()
    }
}

impl Chosen {
    /// Those of `free` are, but for who holds the gauge: the first where nothing is older, the two oldest where no
    /// other keyframe sees the same things.
    pub(super) fn new(fixed: Vec<usize>, free: &[usize], is_oldest: bool, is_first: bool) -> Self {
        let held = match (is_oldest, fixed.is_empty()) {
            (true, _) => 1,
            (false, true) => NUM_HELD.min(free.len()),
            (false, false) => 0,
        };
        let mut members = fixed;
        members.extend(free);
        let free = &free[held..];
        members.sort_unstable();
        let mut numbers = 0..;
        let number = |member| if free.contains(member) { numbers.next() } else { None };
        let free = members.iter().map(number).collect();
        Self { members, free, is_first }
    }
}
