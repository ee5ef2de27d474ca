//! An analytic scene for tests: a textured room with boxes in it, rendered by ray casting with exact
//! depth.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Mutex;

use nalgebra::Vector3;

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::{DepthPoint, Keyframe};

/// A camera of about 63° × 49°.
pub const CAMERA: Intrinsics = Intrinsics::pinhole(320, 240, 260.0);

/// The views rendered last, 90 MB of [`CAMERA`]'s: two thirds of all that the tests ask for are among them.
static RENDERED: Mutex<VecDeque<(String, Rendering)>> = Mutex::new(VecDeque::new());
const MAX_RENDERED: usize = 150;

/// One rendered frame.
#[derive(Clone)]
pub struct Rendering {
    /// Brightness without noise, 0 to 255.
    pub intensity: Image<f32>,
    /// Exact inverse depth at the pixel centres, 1/m.
    pub inverse_depth: Image<f32>,
}

impl Rendering {
    /// Eight-bit pixels with Gaussian noise.
    pub fn noisy(&self, std_dev: f64, seed: u64) -> Vec<u8> {
        let mut random = Random::new(seed);
        let grey = |i: &f32| (f64::from(*i) + std_dev * random.normal()).round();
        self.intensity.pixels().iter().map(grey).map(|i| i.clamp(1.0, 255.0) as u8).collect()
    }
}

/// SplitMix64.
pub struct Random(u64);

impl Random {
    /// The sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xD134_2543_DE82_EF95).wrapping_add(1))
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal, by Box and Muller.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// An axis-aligned box.
#[derive(Debug, Clone, Copy)]
struct Cuboid {
    low: Vector3<f64>,
    high: Vector3<f64>,
}

impl Cuboid {
    /// Entry and exit of a ray with this `inverse` direction, in multiples of it, with the axes of the faces.
    fn cross(&self, origin: &Vector3<f64>, inverse: &Vector3<f64>) -> Option<[(f64, usize); 2]> {
        let (mut enter, mut leave) = ((f64::NEG_INFINITY, 0), (f64::INFINITY, 0));
        for axis in 0..3 {
            let a = (self.low[axis] - origin[axis]) * inverse[axis];
            let b = (self.high[axis] - origin[axis]) * inverse[axis];
            if a.min(b) > enter.0 {
                enter = (a.min(b), axis);
            }
            if a.max(b) < leave.0 {
                leave = (a.max(b), axis);
            }
        }
        (enter.0 < leave.0).then_some([enter, leave])
    }

    /// Columns and rows in which a camera can see the box: all where it extends behind the camera.
    fn seen_in(&self, camera: &Intrinsics, camera_from_world: &SE3) -> [Range<f64>; 2] {
        const ALL: Range<f64> = f64::NEG_INFINITY..f64::INFINITY;
        let mut seen = [f64::INFINITY..f64::NEG_INFINITY, f64::INFINITY..f64::NEG_INFINITY];
        for corner in 0..8 {
            let side = |axis: usize| if corner >> axis & 1 == 0 { self.low } else { self.high };
            let at = Vector3::from_fn(|axis, _| side(axis)[axis]);
            let at = *camera_from_world * at;
            if at.z < 0.01 {
                return [ALL, ALL];
            }
            let place = [camera.fx * at.x / at.z + camera.cx, camera.fy * at.y / at.z + camera.cy];
            for (seen, place) in seen.iter_mut().zip(place) {
                // A ray is at most a quarter of a pixel from its pixel's centre.
                *seen = seen.start.min(place - 1.0)..seen.end.max(place + 1.0);
            }
        }
        seen
    }
}

/// A room around the origin, the camera looking along +z into it.
#[derive(Debug)]
pub struct Scene {
    seed: u64,
    room: Cuboid,
    boxes: [Cuboid; 4],
    /// Length after which the texture of every surface repeats, metres.
    period: Option<f64>,
    /// Factor of the texture's contrast.
    contrast: f64,
}

impl Scene {
    /// The room of a seed: same layout, other positions and other texture.
    pub fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut cuboid = |low: [f64; 3], size: [f64; 3]| {
            let low = Vector3::from(low).map(|x| x + 0.15 * (random.uniform() - 0.5));
            Cuboid { low, high: low + Vector3::from(size) }
        };
        let boxes = [
            cuboid([-1.1, -0.2, 2.0], [0.6, 1.9, 0.5]),
            cuboid([0.4, 0.3, 1.5], [0.6, 1.4, 0.6]),
            cuboid([-0.3, -1.6, 2.6], [0.7, 1.0, 0.6]),
            cuboid([1.0, -0.9, 3.2], [0.5, 0.8, 0.5]),
        ];
        let room =
            Cuboid { low: Vector3::new(-2.5, -1.6, -2.0), high: Vector3::new(2.5, 1.6, 4.2) };
        Self { seed, room, boxes, period: None, contrast: 1.0 }
    }

    /// The same room, its walls with the same texture, but with the boxes of another seed's room, moved by `by` metres
    /// along x.
    pub fn refurnished(self, seed: u64, by: f64) -> Self {
        let boxes = Self::new(seed).boxes.map(|Cuboid { low, high }| {
            let by = Vector3::new(by, 0.0, 0.0);
            Cuboid { low: low + by, high: high + by }
        });
        Self { boxes, ..self }
    }

    /// The same texture on walls that are `factor` times as far away.
    pub fn resized(self, factor: f64) -> Self {
        let room = Cuboid { low: self.room.low * factor, high: self.room.high * factor };
        Self { room, ..self }
    }

    /// The same room with the texture at this share of its contrast.
    pub fn with_contrast(self, contrast: f64) -> Self {
        Self { contrast, ..self }
    }

    /// A corridor along z without boxes, with a repeating texture.
    pub fn corridor(seed: u64, period: f64) -> Self {
        let far = Vector3::new(0.0, 0.0, 1000.0);
        let room =
            Cuboid { low: Vector3::new(-1.2, -1.1, -20.0), high: Vector3::new(1.2, 1.3, 60.0) };
        let scene = Self::new(seed);
        let boxes =
            scene.boxes.map(|Cuboid { low, high }| Cuboid { low: low + far, high: high + far });
        Self { room, boxes, period: Some(period), ..scene }
    }

    /// A keyframe of [`CAMERA`] with exact depth at every fourth pixel, and image noise of this standard deviation.
    pub fn keyframe(&self, keyframe_id: u64, world_from_camera: SE3, noise: f64) -> Keyframe {
        let view = self.render(&CAMERA, &world_from_camera);
        let pixels = (4..CAMERA.height - 4)
            .step_by(2)
            .flat_map(|v| (4..CAMERA.width - 4).step_by(2).map(move |u| (u, v)));
        let points = pixels.map(|(u, v)| DepthPoint {
            u: u as u16,
            v: v as u16,
            inverse_depth: view.inverse_depth.at(u, v),
            variance: 1e-4,
            intensity: view.intensity.at(u, v),
        });
        let (place, image) = (Sim3::new(world_from_camera, 1.0), view.noisy(noise, keyframe_id));
        Keyframe {
            keyframe_id,
            revision: 1,
            sequence: keyframe_id,
            ..Keyframe::at(place, CAMERA, points.collect(), image)
        }
    }

    /// Renders the view of a camera; every pixel is the mean of 2×2 rays.
    pub fn render(&self, camera: &Intrinsics, world_from_camera: &SE3) -> Rendering {
        let view = format!("{self:?} {camera:?} {world_from_camera:?}");
        let known = RENDERED.lock().unwrap().iter().find(|of| of.0 == view).map(|of| of.1.clone());
        known.unwrap_or_else(|| {
            let rendering = self.cast(camera, world_from_camera);
            let mut rendered = RENDERED.lock().unwrap();
            rendered.push_front((view, rendering.clone()));
            rendered.truncate(MAX_RENDERED);
            rendering
        })
    }

    /// The image of a camera that exposes row after row, each with its own pose, rounded.
    pub fn rolling(&self, camera: &Intrinsics, world_from_row: impl Fn(usize) -> SE3) -> Vec<u8> {
        let row = |v: usize| {
            let row = Intrinsics { height: 1, cy: camera.cy - v as f64, ..*camera };
            self.cast(&row, &world_from_row(v)).noisy(0.0, 0)
        };
        (0..camera.height).flat_map(row).collect()
    }

    fn cast(&self, camera: &Intrinsics, world_from_camera: &SE3) -> Rendering {
        let rotation = world_from_camera.rotation_matrix();
        let origin = world_from_camera.translation;
        let ray = |u: f64, v: f64| rotation * camera.ray(u, v);
        let mut intensity = Image::filled(camera.width, camera.height, 0.0);
        let mut inverse_depth = intensity.clone();
        let mut cells = [Cell::default(); 3];
        let camera_from_world = world_from_camera.inverse();
        let seen = self.boxes.map(|cuboid| cuboid.seen_in(camera, &camera_from_world));
        for i in 0..camera.width * camera.height {
            let (u, v) = ((i % camera.width) as f64, (i / camera.width) as f64);
            let near = seen.each_ref().map(|[us, vs]| us.contains(&u) && vs.contains(&v));
            inverse_depth.pixels_mut()[i] = (1.0 / self.hit(&origin, &ray(u, v), &near).0) as f32;
            let samples = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];
            let mut shade = |s: (f64, f64)| {
                let ray = ray(u + s.0, v + s.1);
                self.shade(&origin, &ray, self.hit(&origin, &ray, &near), &mut cells)
            };
            let sum: f64 = samples.into_iter().map(&mut shade).sum();
            intensity.pixels_mut()[i] = (0.25 * sum) as f32;
        }
        Rendering { intensity, inverse_depth }
    }

    fn shade(
        &self,
        origin: &Vector3<f64>,
        ray: &Vector3<f64>,
        (distance, axis, surface): (f64, usize, u64),
        cells: &mut [Cell; 3],
    ) -> f64 {
        let at = origin + ray * distance;
        let (x, y) = match axis {
            0 => (at.y, at.z),
            1 => (at.x, at.z),
            _ => (at.x, at.y),
        };
        let repeated = |x: f64| self.period.map_or(x, |period| x.rem_euclid(period));
        self.texture(surface * 3 + axis as u64, repeated(x), repeated(y), cells)
    }

    /// Distance along the ray (depth, for rays of unit depth), axis of the face, and surface; only the boxes that are
    /// `near` the ray are tested.
    fn hit(
        &self,
        origin: &Vector3<f64>,
        ray: &Vector3<f64>,
        near: &[bool; 4],
    ) -> (f64, usize, u64) {
        let inverse = ray.map(|along| 1.0 / along);
        let [_, wall] = self.room.cross(origin, &inverse).unwrap_or([(0.0, 0), (1.0, 0)]);
        let mut nearest = (wall.0, wall.1, 0);
        for (index, cuboid) in self.boxes.iter().enumerate().filter(|(index, _)| near[*index]) {
            if let Some([(enter, axis), _]) = cuboid.cross(origin, &inverse)
                && enter > 0.0
                && enter < nearest.0
            {
                nearest = (enter, axis, index as u64 + 1);
            }
        }
        nearest
    }

    /// Smooth noise at three scales and soft-edged stripes, so that there are corners and edges.
    fn texture(&self, surface: u64, x: f64, y: f64, [fine, middle, coarse]: &mut [Cell; 3]) -> f64 {
        let surface = surface ^ (self.seed << 8);
        let noise = 45.0 * fine.noise(surface, x / 0.06, y / 0.06)
            + 50.0 * middle.noise(surface ^ 0x55, x / 0.2, y / 0.2)
            + 60.0 * coarse.noise(surface ^ 0xAA, x / 0.7, y / 0.7);
        // tanh z, from the one function that is fast.
        let tanh = |z: f64| 1.0 - 2.0 / ((2.0 * z).exp() + 1.0);
        let stripes = 25.0 * tanh((4.0 * x + 1.5 * y).sin() * 12.0);
        128.0 + self.contrast * (noise + stripes)
    }
}

/// A cell of a unit lattice, and the noise at its corners: successive rays mostly share them.
#[derive(Clone, Copy, Default)]
struct Cell {
    /// Seed of the lattice, column and row; `None` before the first.
    place: Option<(u64, i64, i64)>,
    corners: [[f64; 2]; 2],
}

impl Cell {
    /// Value noise in [-1, 1], smooth between the points of the lattice.
    fn noise(&mut self, seed: u64, x: f64, y: f64) -> f64 {
        let below = |x: f64| x as i64 - i64::from(x < (x as i64) as f64);
        let (column, row) = (below(x), below(y));
        let place = Some((seed, column, row));
        if self.place != place {
            let corner = |dx: i64, dy: i64| {
                let cell = ((column + dx) as u64).wrapping_mul(0x9E37_79B9)
                    ^ ((row + dy) as u64).wrapping_mul(0x85EB_CA6B_1234_5677);
                2.0 * Random::new(cell ^ seed.wrapping_mul(0x2545_F491_4F6C_DD1D)).uniform() - 1.0
            };
            let corners = [0, 1].map(|dy| [0, 1].map(|dx| corner(dx, dy)));
            *self = Self { place, corners };
        }
        let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
        let (fx, fy) = (smooth(x - column as f64), smooth(y - row as f64));
        let [upper, lower] = self.corners.map(|[left, right]| left * (1.0 - fx) + right * fx);
        upper * (1.0 - fy) + lower * fy
    }
}
