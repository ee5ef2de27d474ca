//! Which keyframes are estimated together, and which of them stay where they are.

use nalgebra::Vector3;

use crate::slam::window::Window;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::view::Sight;

/// Points that two keyframes must see both for the one to hold the other in place.
pub(super) const FEWEST_COMMON: usize = 20;
/// Keyframes that are held in place where no older one sees the same things.
const NUM_HELD: usize = 2;
/// Keyframes whose points are looked for one by one in another, the nearest: seven times those that are held, so that
/// nearly all of those that see most are among them, and a long run costs no more than a short one.
const NUM_NEAREST: usize = 60;

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
        let of_epoch = self.of_epoch_up_to(newest);
        let is_first = of_epoch.len() <= self.params.num_first;
        let num_free =
            if is_first { of_epoch.len() } else { self.params.num_free.min(of_epoch.len()) };
        let (older, free) = of_epoch.split_at(of_epoch.len() - num_free);
        let fixed = self.covisible(older, &free[free.len().saturating_sub(2)..]);
        Chosen::new(fixed, free, older.is_empty(), is_first)
    }

    /// The keyframes up to one that are of its epoch.
    pub(super) fn of_epoch_up_to(&self, newest: usize) -> Vec<usize> {
        let epoch = self.keyframes[newest].epoch;
        (0..=newest).filter(|&k| self.keyframes[k].epoch == epoch).collect()
    }

    /// Of the older keyframes those that see most of what the newest see.
    pub(super) fn covisible(&self, older: &[usize], newest: &[usize]) -> Vec<usize> {
        self.most_common(&self.nearest(older, newest), newest)
    }

    /// The same, all looked at closely.
    fn most_common(&self, older: &[usize], newest: &[usize]) -> Vec<usize> {
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

    /// Of some keyframes, by their places in the list, those that stand and look nearest to where others do, in the order
    /// in which they are given; all where they are few.
    pub(super) fn nearest(&self, of: &[usize], to: &[usize]) -> Vec<usize> {
        if of.len() <= NUM_NEAREST {
            return of.to_vec();
        }
        let targets: Vec<Stand> = to.iter().map(|&to| Stand::of(&self.keyframes[to])).collect();
        let apart = |of: usize| {
            let stand = Stand::of(&self.keyframes[of]);
            targets.iter().map(|target| stand.apart(target)).sum::<f64>()
        };
        let mut places: Vec<(f64, usize)> =
            of.iter().enumerate().map(|(place, &of)| (apart(of), place)).collect();
        let by_distance = |one: &(f64, usize), other: &(f64, usize)| {
            one.0.total_cmp(&other.0).then(one.1.cmp(&other.1))
        };
        places.select_nth_unstable_by(NUM_NEAREST, by_distance);
        places.truncate(NUM_NEAREST);
        places.sort_unstable_by_key(|(_, place)| *place);
        places.into_iter().map(|(_, place)| of[place]).collect()
    }
}

/// Where a keyframe stands and what it looks at, in the map.
struct Stand {
    at: Vector3<f64>,
    /// In the middle of its image, as far off as its depth is in the mean.
    seen: Vector3<f64>,
}

impl Stand {
    fn of(keyframe: &WindowKeyframe) -> Self {
        let map_from_camera = keyframe.camera_from_map.inverse();
        let at = map_from_camera.translation;
        // A keyframe's unit is its mean depth.
        let seen = at + map_from_camera.rotation * (keyframe.unit * Vector3::z());
        Self { at, seen }
    }

    /// The larger, the less they see in common.
    fn apart(&self, other: &Self) -> f64 {
        (self.at - other.at).norm_squared() + (self.seen - other.seen).norm_squared()
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

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::image::buffer::Image;
    use crate::slam::test_scene::{CAMERA, Random};
    use crate::slam::window::keyframe::WindowPoint;
    use crate::slam::window::params::WindowParams;

    const RADIUS: f64 = 3.0;

    /// A window of keyframes of a camera that wanders about the middle of a round room and turns, 30 to a turn.
    fn wandering(keyframes: usize) -> Window {
        let mut random = Random::new(9);
        let blank = [Image::filled(CAMERA.width, CAMERA.height, 100)];
        let mut window = Window::new(CAMERA, WindowParams::default());
        let hosts = (0..keyframes).map(|k| {
            let angle = std::f64::consts::TAU * k as f64 / 30.0;
            let mut twist = Vector6::from_fn(|_, _| 0.05 * random.normal());
            twist[4] += angle;
            let mut map_from_camera = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, twist[4], 0.0));
            map_from_camera.translation = Vector3::from_fn(|_, _| 0.4 * random.normal());
            let grid =
                (0..15).flat_map(|row| (0..20).map(move |column| (8 + 16 * column, 8 + 16 * row)));
            let points = grid.map(|pixel: (u16, u16)| {
                let mut point = WindowPoint::new(pixel, 1.0, &blank, &CAMERA, &window.params);
                let [x, y] = point.ray.map(f64::from);
                let ray = map_from_camera.rotation * Vector3::new(x, y, 1.0);
                // Where the ray meets the wall: |at + z ray| = radius.
                let (at, squared) = (map_from_camera.translation, ray.norm_squared());
                let half = at.dot(&ray) / squared;
                let rest = (at.norm_squared() - RADIUS * RADIUS) / squared;
                point.inverse_depth = 1.0 / (-half + (half * half - rest).sqrt());
                point
            });
            WindowKeyframe {
                keyframe_id: k as u64,
                epoch: 0,
                images: Vec::new(),
                camera_from_map: map_from_camera.inverse(),
                unit: RADIUS,
                points: points.collect(),
                is_host: true,
            }
        });
        let hosts: Vec<WindowKeyframe> = hosts.collect();
        window.keyframes = hosts;
        window
    }

    #[test]
    fn few_keyframes_are_all_looked_at_and_of_many_those_that_see_most() {
        let window = wandering(600);
        let few: Vec<usize> = (100..100 + NUM_NEAREST).collect();
        assert_eq!(window.nearest(&few, &[599]), few);
        let many: Vec<usize> = (0..590).collect();
        let nearest = window.nearest(&many, &[598, 599]);
        assert_eq!(nearest.len(), NUM_NEAREST);
        assert!(nearest.is_sorted());
        let (mut same, mut all) = (0, 0);
        for newest in (500..600).step_by(5) {
            let (older, newest): (Vec<usize>, _) =
                ((0..newest - 7).collect(), [newest - 1, newest]);
            let best = window.most_common(&older, &newest);
            let found = window.covisible(&older, &newest);
            all += best.len();
            same += best.iter().filter(|of| found.contains(of)).count();
        }
        assert_eq!(all, 20 * window.params.num_fixed);
        assert!(10 * same >= 9 * all, "{same} of {all}");
    }
}
