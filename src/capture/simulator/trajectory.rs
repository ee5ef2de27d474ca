//! Camera paths: sums of sinusoids with incommensurate periods, smooth in every derivative, or rounds on a route.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::capture::simulator::params::{MotionKind, MotionParams};
use crate::capture::simulator::random::Stream;
use crate::capture::simulator::route::{Route, RoutePose};
use crate::capture::simulator::scene::Stage;
use crate::slam::geometry::se3::SE3;

/// Time over which mean speed and mean rate of turning hold, seconds. Fixed, so that a shorter sequence is the
/// beginning of a longer one.
const MEAN_OVER_S: f64 = 20.0;
/// Step of the sums that measure path and turning, seconds.
const MEASURE_STEP_S: f64 = 1.0 / 30.0;

/// A sinusoid of a phase.
#[derive(Debug, Clone, Copy)]
struct Wave {
    amplitude: f64,
    rate: f64,
    phase: f64,
}

impl Wave {
    fn at(self, phase: f64) -> f64 {
        self.amplitude * (self.rate * phase + self.phase).sin()
    }
}

fn wave(amplitude: f64, rate: f64, phase: f64) -> Wave {
    Wave { amplitude, rate, phase }
}

fn sum(waves: &[Wave], phase: f64) -> f64 {
    waves.iter().map(|w| w.at(phase)).sum()
}

/// A camera pose for every instant.
#[derive(Debug, Clone)]
pub struct Trajectory {
    stage: Stage,
    /// The route that is walked instead, and the seed of its rounds.
    route: Option<(&'static Route, u64)>,
    /// Offsets from the stage's centre along x, y, z; functions of the walking phase.
    walk: [Vec<Wave>; 3],
    /// Heading, elevation and roll about their means; functions of the turning phase.
    turn: [Vec<Wave>; 3],
    /// Tremor of x, y, z (metres) and heading, elevation, roll (radians); functions of time.
    tremor: [Vec<Wave>; 6],
    /// Walking phase per second; on a route, waypoints per second.
    walk_rate: f64,
    /// Turning phase per second.
    turn_rate: f64,
}

impl Trajectory {
    /// Builds a path through the stage, paced for the requested mean speed and turning. A route has its own turns, and
    /// the mean speed holds over a round.
    pub fn new(stage: Stage, motion: &MotionParams, seed: u64) -> Self {
        let mut stream = Stream::new(seed, 0x7247);
        let route = stage.route.filter(|_| motion.kind == MotionKind::Handheld);
        let mut path = Self {
            stage,
            route: route.map(|route| (route, seed)),
            walk: walk_waves(&stage, motion.kind, &mut stream),
            turn: turn_waves(&stage, motion.kind, &mut stream),
            tremor: tremor_waves(motion, &mut stream),
            walk_rate: 0.0,
            turn_rate: 0.0,
        };
        if let Some(route) = route {
            path.walk_rate =
                motion.mean_speed_m_s * route.waypoints.len() as f64 / route.length_m();
            return path;
        }
        path.walk_rate = pace(motion.mean_speed_m_s, |rate| {
            Self { walk_rate: rate, ..path.clone() }.mean_rates().0
        });
        let turn = motion.mean_turn_deg_s.to_radians();
        path.turn_rate = pace(turn, |rate| Self { turn_rate: rate, ..path.clone() }.mean_rates().1);
        path
    }

    /// The camera pose at `time_s` from the start of the sequence, metres.
    pub fn world_from_camera(&self, time_s: f64) -> SE3 {
        let (walk, turn) = (self.walk_rate * time_s, self.turn_rate * time_s);
        let RoutePose { place, angles: [heading, elevation] } = match self.route {
            Some((route, seed)) => route.at(walk, seed),
            None => RoutePose {
                place: Vector3::from(self.stage.centre)
                    + Vector3::from_fn(|k, _| sum(&self.walk[k], walk)),
                angles: [
                    self.stage.heading_rad + sum(&self.turn[0], turn),
                    self.stage.elevation_rad + sum(&self.turn[1], turn),
                ],
            },
        };
        let tremor = |k: usize| sum(&self.tremor[k], time_s);
        let roll = sum(&self.turn[2], turn) + tremor(5);
        SE3 {
            rotation: looking(heading + tremor(3), elevation + tremor(4), roll),
            translation: place + Vector3::new(tremor(0), tremor(1), tremor(2)),
        }
    }

    /// Mean speed (m/s) and mean rate of turning (rad/s) of the first [`MEAN_OVER_S`].
    fn mean_rates(&self) -> (f64, f64) {
        let steps = (MEAN_OVER_S / MEASURE_STEP_S) as usize;
        let mut before = self.world_from_camera(0.0);
        let (mut path, mut angle) = (0.0, 0.0);
        for step in 1..=steps {
            let now = self.world_from_camera(step as f64 * MEASURE_STEP_S);
            path += (now.translation - before.translation).norm();
            angle += now.rotation.angle_to(&before.rotation);
            before = now;
        }
        let duration = steps as f64 * MEASURE_STEP_S;
        (path / duration, angle / duration)
    }
}

/// Finds the phase rate at which `measure` returns `target`; 0 if nothing moves or tremor alone exceeds it.
fn pace(target: f64, measure: impl Fn(f64) -> f64) -> f64 {
    /// Fastest phase, rad/s; a stage is at least 0.2 m wide, so this is beyond any allowed speed.
    const FASTEST: f64 = 64.0;
    if target == 0.0 || measure(1.0) <= 0.0 || measure(0.0) >= target {
        return 0.0;
    }
    // The first rate of a doubling series that is too fast, then bisection below it: the measure grows with the rate
    // wherever a period is sampled often enough.
    let mut high = 1.0 / 64.0;
    while measure(high) < target && high < FASTEST {
        high *= 2.0;
    }
    let mut low = 0.0;
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if measure(middle) < target { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Rotation of a camera (x right, y down, z forward) in a z-up world that looks along `heading`
/// (about the vertical, from +x towards +y) and `elevation` (upwards), rolled clockwise.
pub fn looking(heading: f64, elevation: f64, roll: f64) -> UnitQuaternion<f64> {
    let forward = Vector3::new(
        heading.cos() * elevation.cos(),
        heading.sin() * elevation.cos(),
        elevation.sin(),
    );
    let right = Vector3::new(heading.sin(), -heading.cos(), 0.0);
    let down = forward.cross(&right);
    let upright = Matrix3::from_columns(&[right, down, forward]);
    let rolled = upright * Rotation3::from_axis_angle(&Vector3::z_axis(), roll).into_inner();
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rolled))
}

fn walk_waves(stage: &Stage, kind: MotionKind, stream: &mut Stream) -> [Vec<Wave>; 3] {
    let mut phase = || stream.uniform_f64(0.0, std::f64::consts::TAU);
    let start = {
        let (low, high) = stage.start_rad;
        low + (high - low) * phase() / std::f64::consts::TAU
    };
    let [x, y, z] = stage.reach;
    match kind {
        // An ellipse that the slower and faster waves keep from closing.
        MotionKind::Handheld => [
            vec![wave(0.86 * x, 1.0, start), wave(0.10 * x, 2.236, phase())],
            vec![wave(0.82 * y, 1.0, start + 1.4), wave(0.14 * y, 1.618, phase())],
            vec![wave(0.60 * z, 1.272, phase()), wave(0.35 * z, 2.899, phase())],
        ],
        MotionKind::Straight => {
            // Across the mean viewing direction.
            let (sin, cos) = stage.heading_rad.sin_cos();
            let reach = x.min(y);
            let along = |share: f64| vec![wave(share * reach, 1.0, 0.0)];
            [along(sin), along(-cos), vec![]]
        }
        MotionKind::Rotation | MotionKind::Standing => [vec![], vec![], vec![]],
    }
}

fn turn_waves(stage: &Stage, kind: MotionKind, stream: &mut Stream) -> [Vec<Wave>; 3] {
    if !matches!(kind, MotionKind::Handheld | MotionKind::Rotation) {
        return [vec![], vec![], vec![]];
    }
    /// Amplitude of the roll of a handheld camera, radians.
    const ROLL_RAD: f64 = 0.05;
    let mut phase = || stream.uniform_f64(0.0, std::f64::consts::TAU);
    let (heading, elevation) = (stage.heading_swing_rad, stage.elevation_swing_rad);
    [
        vec![wave(0.82 * heading, 1.0, phase()), wave(0.16 * heading, 2.147, phase())],
        vec![wave(0.62 * elevation, 1.539, phase()), wave(0.36 * elevation, 0.7, phase())],
        vec![wave(ROLL_RAD, 1.1, phase())],
    ]
}

fn tremor_waves(motion: &MotionParams, stream: &mut Stream) -> [Vec<Wave>; 6] {
    /// Amplitude of each wave of a trembling hand: metres, then radians.
    const PLACE_M: f64 = 0.0009;
    const ANGLE_RAD: f64 = 0.0009;
    const BANDS_HZ: [(f64, f64); 3] = [(1.4, 2.0), (2.6, 3.7), (4.4, 6.1)];
    std::array::from_fn(|axis| {
        if motion.kind != MotionKind::Handheld || motion.tremor == 0.0 {
            return vec![];
        }
        let size = motion.tremor * if axis < 3 { PLACE_M } else { ANGLE_RAD };
        let wave = |(low, high): (f64, f64)| Wave {
            amplitude: size * stream.uniform_f64(0.6, 1.4) / low,
            rate: std::f64::consts::TAU * stream.uniform_f64(low, high),
            phase: stream.uniform_f64(0.0, std::f64::consts::TAU),
        };
        BANDS_HZ.map(wave).to_vec()
    })
}
