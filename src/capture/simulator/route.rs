//! Rounds through rooms: a closed route of positions and headings, never walked exactly alike twice.

use nalgebra::Vector3;

use crate::capture::simulator::random::Stream;

/// A position that a route passes, and the camera's direction there.
#[derive(Debug, Clone, Copy)]
pub struct Waypoint {
    /// Position on the floor, metres.
    pub at: [f64; 2],
    /// Heading about the vertical from +x towards +y, degrees; grows without wrapping along the route.
    pub heading_deg: f64,
    /// Elevation of the optical axis, degrees, negative looks down.
    pub elevation_deg: f64,
}

/// Shorthand for the tables of routes.
pub const fn waypoint(x: f64, y: f64, heading_deg: f64, elevation_deg: f64) -> Waypoint {
    Waypoint { at: [x, y], heading_deg, elevation_deg }
}

/// A closed route: the last waypoint is followed by the first.
#[derive(Debug)]
pub struct Route {
    /// About 0.8 m apart: where they are denser the camera is slower.
    pub waypoints: &'static [Waypoint],
    /// Increase of the heading over a round, degrees.
    pub turn_deg: f64,
    /// Height of the camera, metres.
    pub height_m: f64,
    /// Number of rounds that show everything.
    pub rounds: usize,
}

/// Position and direction of a camera.
#[derive(Debug, Clone, Copy)]
pub struct RoutePose {
    /// Position, metres.
    pub place: Vector3<f64>,
    /// Heading and elevation, radians.
    pub angles: [f64; 2],
}

impl Route {
    /// Returns the pose `phase` waypoints after the first one. Each round has different offsets, chosen by `seed`.
    pub fn at(&self, phase: f64, seed: u64) -> RoutePose {
        spline(phase, |index| self.control(index, seed))
    }

    /// Length of a round without its offsets, metres.
    pub fn length_m(&self) -> f64 {
        /// Chords per waypoint: an error of a millimetre on a round.
        const CHORDS: usize = 16;
        let at =
            |chord: usize| spline(chord as f64 / CHORDS as f64, |index| self.waypoint(index)).place;
        let chords = self.waypoints.len() * CHORDS;
        (0..chords).map(|chord| (at(chord + 1) - at(chord)).norm()).sum()
    }

    /// A waypoint by its number from the start of the first round, without offsets.
    fn waypoint(&self, index: i64) -> RoutePose {
        let count = self.waypoints.len() as i64;
        let round = index.div_euclid(count);
        let Waypoint { at, heading_deg, elevation_deg } =
            self.waypoints[index.rem_euclid(count) as usize];
        let heading_deg = heading_deg + round as f64 * self.turn_deg;
        RoutePose {
            place: Vector3::new(at[0], at[1], self.height_m),
            angles: [heading_deg.to_radians(), elevation_deg.to_radians()],
        }
    }

    /// The same waypoint with the offsets of its round.
    fn control(&self, index: i64, seed: u64) -> RoutePose {
        /// Largest offset from the table of a round as a whole and of each of its waypoints: a hand's breadth and the
        /// height of a step, so that two rounds see the same from different positions.
        const ROUND_M: [f64; 3] = [0.06, 0.06, 0.10];
        const PLACE_M: [f64; 3] = [0.10, 0.10, 0.05];
        /// Largest offset of heading and elevation, degrees.
        const ANGLE_DEG: [f64; 2] = [6.0, 3.0];
        let round = index.div_euclid(self.waypoints.len() as i64);
        let mut of_round = Stream::new(seed, 0x7080_0000 ^ round as u64);
        let mut of_place = Stream::new(seed, 0x7090_0000_0000 ^ index as u64);
        let RoutePose { mut place, mut angles } = self.waypoint(index);
        for k in 0..3 {
            place[k] += of_round.uniform_f64(-ROUND_M[k], ROUND_M[k]);
            place[k] += of_place.uniform_f64(-PLACE_M[k], PLACE_M[k]);
        }
        for k in 0..2 {
            angles[k] += of_place.uniform_f64(-ANGLE_DEG[k], ANGLE_DEG[k]).to_radians();
        }
        RoutePose { place, angles }
    }
}

/// A uniform cubic B-spline over numbered controls: speed, turning and their rates of change are continuous.
fn spline(phase: f64, control: impl Fn(i64) -> RoutePose) -> RoutePose {
    let segment = phase.floor();
    let x = phase - segment;
    let y = 1.0 - x;
    let weights = [
        y * y * y / 6.0,
        (3.0 * x * x * x - 6.0 * x * x + 4.0) / 6.0,
        (3.0 * y * y * y - 6.0 * y * y + 4.0) / 6.0,
        x * x * x / 6.0,
    ];
    let mut pose = RoutePose { place: Vector3::zeros(), angles: [0.0; 2] };
    for (index, weight) in (segment as i64 - 1..).zip(weights) {
        let control = control(index);
        pose.place += weight * control.place;
        for (sum, angle) in pose.angles.iter_mut().zip(control.angles) {
            *sum += weight * angle;
        }
    }
    pose
}
