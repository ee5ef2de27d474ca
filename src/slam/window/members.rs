//! Selects the keyframes that are estimated jointly, and those that stay fixed.

use nalgebra::Vector3;

use crate::slam::window::Window;
use crate::slam::window::keyframe::WindowKeyframe;
use crate::slam::window::view::ObserverView;

/// Points that two keyframes must have in common for one to hold the other in place.
pub(super) const MIN_COMMON: usize = 20;
/// Share of the points of two keyframes that the other must see for an estimate to link them: for successive keyframes
/// it is half and more; a few points at the border of an image hardly constrain a pose.
const LINKING_SHARE: f64 = 0.2;
/// Keyframes that a new one is aligned to.
const NUM_ALIGNED_TO: usize = 4;
/// Keyframes that are held in place where no older one sees the same scene.
const NUM_HELD: usize = 2;
/// Nearest keyframes whose points are searched one by one in another: seven times those that are held, so that nearly
/// all of those that see most are among them, and a long run costs no more than a short one.
const NUM_NEAREST: usize = 60;

/// The members of an estimate.
pub(super) struct Chosen {
    /// Indices in the list of keyframes.
    pub members: Vec<usize>,
    /// For each, its number among the free ones; `None` where it is fixed.
    pub free: Vec<Option<usize>>,
    /// Whether the epoch has just begun.
    pub is_first: bool,
}

impl Window {
    /// Chooses the members of an estimate of the newest keyframes.
    pub(super) fn choose_members(&self, newest: usize) -> Chosen {
        let of_epoch = self.of_epoch_up_to(newest);
        let is_first = of_epoch.len() <= self.params.num_first;
        let num_free =
            if is_first { of_epoch.len() } else { self.params.num_free.min(of_epoch.len()) };
        let (older, newest) = of_epoch.split_at(of_epoch.len() - num_free);
        let free = match is_first {
            true => newest.to_vec(),
            false => self.groups(newest).pop().unwrap_or_default(),
        };
        let others: Vec<usize> = of_epoch.iter().copied().filter(|of| !free.contains(of)).collect();
        let fixed = self.covisible(&others, &free[free.len().saturating_sub(2)..]);
        Chosen::new(fixed, &free, older.is_empty(), is_first)
    }

    /// Groups keyframes, one by one, that see the same scene: where the camera returns to what older keyframes see, the
    /// next keyframe may be created far from the one before, and nothing between them constrains their relative pose.
    /// Members are in the order of `of`, and so are the groups by their last members.
    pub(super) fn groups(&self, of: &[usize]) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for &new in of {
            let is_linked =
                |group: &Vec<usize>| group.iter().rev().any(|&member| self.is_linked(member, new));
            let (linked, apart): (Vec<_>, Vec<_>) = groups.into_iter().partition(is_linked);
            groups = apart;
            let mut joined: Vec<usize> = linked.into_iter().flatten().collect();
            joined.sort_unstable();
            joined.push(new);
            groups.push(joined);
        }
        groups
    }

    /// Whether two keyframes see enough of each other's points for an estimate to link them.
    fn is_linked(&self, one: usize, other: usize) -> bool {
        let alive = |of: usize| self.keyframes[of].points.iter().filter(|of| of.is_alive).count();
        let common = self.common(one, other) as f64;
        common > MIN_COMMON as f64 && common >= LINKING_SHARE * (alive(one) + alive(other)) as f64
    }

    /// Number of points of two keyframes that the other sees.
    fn common(&self, one: usize, other: usize) -> usize {
        self.seen_by(one, other) + self.seen_by(other, one)
    }

    /// Number of points of a keyframe that another sees and that nothing hides from it.
    fn seen_by(&self, host: usize, observer: usize) -> usize {
        let (host, observer) = (&self.keyframes[host], &self.keyframes[observer]);
        let observer_from_host = observer.camera_from_map * host.camera_from_map.inverse();
        let sight = ObserverView::new(&observer_from_host, &self.camera);
        if !sight.may_see(&host.points) {
            return 0;
        }
        let alive = host.points.iter().filter(|point| point.is_alive);
        let seen = alive.filter_map(|point| sight.project(point));
        seen.filter(|seen| !observer.surface.hides(seen, observer.unit)).count()
    }

    /// The keyframes up to `newest` that are of its epoch.
    pub(super) fn of_epoch_up_to(&self, newest: usize) -> Vec<usize> {
        let epoch = self.keyframes[newest].epoch;
        (0..=newest).filter(|&k| self.keyframes[k].epoch == epoch).collect()
    }

    /// The hosts that a new keyframe is aligned to: the newest of those most covisible with it, in order.
    pub(super) fn hosts_to_align_to(&self, index: usize) -> Vec<usize> {
        let epoch = self.keyframes[index].epoch;
        let is_host = |&k: &usize| self.keyframes[k].epoch == epoch && self.keyframes[k].is_host;
        let hosts: Vec<usize> = (0..index).filter(is_host).collect();
        let mut nearest = self.covisible(&hosts, &[index]);
        nearest.sort_unstable();
        nearest.split_off(nearest.len().saturating_sub(NUM_ALIGNED_TO))
    }

    /// The older keyframes that are most covisible with the newest.
    pub(super) fn covisible(&self, older: &[usize], newest: &[usize]) -> Vec<usize> {
        self.most_common(&self.nearest(older, newest), newest)
    }

    /// The same, where each is checked point by point.
    fn most_common(&self, older: &[usize], newest: &[usize]) -> Vec<usize> {
        let mut seen: Vec<(usize, usize)> = older
            .iter()
            .map(|&of| (newest.iter().map(|&new| self.common(of, new)).sum(), of))
            .filter(|(count, _)| *count > MIN_COMMON)
            .collect();
        seen.sort_unstable_by(|one, other| other.cmp(one));
        seen.truncate(self.params.num_fixed);
        seen.into_iter().map(|(_, of)| of).collect()
    }

    /// The keyframes among `of`, given by index, whose positions and views are nearest to those of `to`, in the given
    /// order; all where they are few.
    pub(super) fn nearest(&self, of: &[usize], to: &[usize]) -> Vec<usize> {
        if of.len() <= NUM_NEAREST {
            return of.to_vec();
        }
        let targets: Vec<Viewpoint> =
            to.iter().map(|&to| Viewpoint::of(&self.keyframes[to])).collect();
        let apart = |of: usize| {
            let stand = Viewpoint::of(&self.keyframes[of]);
            targets.iter().map(|target| stand.dissimilarity(target)).sum::<f64>()
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

/// A keyframe's position and the point that it looks at, in the map.
struct Viewpoint {
    at: Vector3<f64>,
    /// In the centre of its image, at its mean depth.
    seen: Vector3<f64>,
}

impl Viewpoint {
    fn of(keyframe: &WindowKeyframe) -> Self {
        let map_from_camera = keyframe.camera_from_map.inverse();
        let at = map_from_camera.translation;
        // A keyframe's unit is its mean depth.
        let seen = at + map_from_camera.rotation * (keyframe.unit * Vector3::z());
        Self { at, seen }
    }

    /// Larger the less they see in common.
    fn dissimilarity(&self, other: &Self) -> f64 {
        (self.at - other.at).norm_squared() + (self.seen - other.seen).norm_squared()
    }
}

impl Chosen {
    /// Frees the keyframes of `free`, except those that hold the gauge: the first where nothing is older, the two
    /// oldest where no other keyframe sees the same scene.
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
    use crate::slam::image::shared::SharedImage;
    use crate::slam::keyframe::DepthPoint;
    use crate::slam::test_scene::{CAMERA, Random};
    use crate::slam::window::keyframe::WindowPoint;
    use crate::slam::window::params::WindowParams;
    use crate::slam::window::surface::Surface;

    const RADIUS: f64 = 3.0;

    /// A window of keyframes of a camera that wanders about the centre of a round room and turns, 30 to a turn.
    fn wandering(keyframes: usize) -> Window {
        let mut random = Random::new(9);
        let pixels = vec![100; CAMERA.width * CAMERA.height].into();
        let blank = [SharedImage::try_from_pixels(CAMERA.width, CAMERA.height, pixels).unwrap()];
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
                agreed: Vec::new(),
                surface: Surface::default(),
            }
        });
        let hosts: Vec<WindowKeyframe> = hosts.collect();
        window.keyframes = hosts;
        window
    }

    #[test]
    fn few_keyframes_are_all_checked_and_of_many_those_that_see_most() {
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

    /// A camera that turned and returned to `places` of its keyframes: these are repeated, in order, after the 45th.
    fn seen_again(places: &[usize]) -> Window {
        let mut window = wandering(50);
        let again: Vec<WindowKeyframe> =
            places.iter().map(|&place| window.keyframes[place].clone()).collect();
        window.keyframes.splice(45..45, again);
        for (of, id) in window.keyframes.iter_mut().zip(0..) {
            of.keyframe_id = id;
        }
        window
    }

    #[test]
    fn the_newest_are_free_together_only_where_they_see_the_same_scene() {
        let mut window = seen_again(&[24, 25]);
        window.keyframes.truncate(47);
        let chosen = window.choose_members(46);
        let free = chosen.members.iter().zip(&chosen.free).filter(|(_, free)| free.is_some());
        assert_eq!(free.map(|(&member, _)| member).collect::<Vec<_>>(), [45, 46]);
        assert!(chosen.members.contains(&24) && chosen.members.contains(&25), "what they see");
        assert!(chosen.members.iter().all(|member| !(36..45).contains(member)));
        // The camera is there for the first time: all seven are free.
        let chosen = window.choose_members(44);
        assert_eq!(chosen.free.iter().flatten().count(), window.params.num_free);
    }

    #[test]
    fn a_new_keyframe_is_aligned_to_covisible_ones_and_not_to_the_last_ones() {
        let window = seen_again(&[24]);
        let hosts = window.hosts_to_align_to(45);
        assert_eq!(hosts.len(), NUM_ALIGNED_TO);
        assert!(hosts.is_sorted() && hosts.contains(&24), "{hosts:?}");
        assert!(hosts.iter().all(|&of| window.is_linked(of, 45)), "{hosts:?}");
        // Where the camera moves on, the last one is among them.
        assert!(window.hosts_to_align_to(44).contains(&43));
    }

    #[test]
    fn every_part_of_a_piece_is_held() {
        let window = seen_again(&[24, 25]);
        let all: Vec<usize> = (0..52).collect();
        assert_eq!(window.groups(&all[40..]).len(), 2);
        let chosen = window.choose_piece(&all, 40, 52);
        assert_eq!(chosen.free.iter().flatten().count(), 12);
        let held: Vec<usize> =
            chosen.members.iter().copied().filter(|&member| member < 40).collect();
        for free in 40..52 {
            assert!(held.iter().any(|&of| window.is_linked(of, free)), "{free} by {held:?}");
        }
    }

    #[test]
    fn a_part_that_nothing_holds_is_left_unchanged() {
        let mut window = seen_again(&[24, 25]);
        for of in &mut window.keyframes[45..47] {
            of.camera_from_map.translation.x += 1000.0;
        }
        let all: Vec<usize> = (0..52).collect();
        let chosen = window.choose_piece(&all, 40, 52);
        assert!(!chosen.members.contains(&45) && !chosen.members.contains(&46));
        assert_eq!(chosen.free.iter().flatten().count(), 10);
    }

    #[test]
    fn an_occluder_in_a_keyframes_view_hides_the_points_of_others() {
        let mut window = wandering(50);
        let older: Vec<usize> = (0..40).collect();
        let before = window.covisible(&older, &[48, 49]);
        let wall = |v: u16| move |u: u16| (8 * u, 8 * v);
        let pixels = (0..(CAMERA.height / 8) as u16)
            .flat_map(|v| (0..(CAMERA.width / 8) as u16).map(wall(v)));
        let near: Vec<DepthPoint> = pixels
            .flat_map(|(u, v)| [(u, v); 4])
            .map(|(u, v)| DepthPoint { u, v, inverse_depth: 5.0, variance: 1e-4, intensity: 0.0 })
            .collect();
        // It sees a wall from near, and its own points are out of the others' view.
        window.keyframes[before[0]].surface = Surface::of(&near, &CAMERA);
        window.keyframes[before[0]].points.clear();
        let after = window.covisible(&older, &[48, 49]);
        assert!(!after.contains(&before[0]), "{before:?} {after:?}");
    }
}
