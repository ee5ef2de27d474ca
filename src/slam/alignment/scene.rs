//! A textured slanted plane in closed form, for tests: exact depth, exact poses, smooth texture.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe};

/// A small fixed generator (SplitMix64), so that tests do not depend on a crate's version.
pub struct Noise(pub u64);

impl Noise {
    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [-1, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Standard normal, as a sum of twelve uniforms.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() * 0.5
    }
}

/// The plane n·X = 1 in camera coordinates of the keyframe, with a texture of sines.
pub struct Plane {
    /// n of n·X = 1, 1/keyframe units.
    pub normal: [f64; 3],
    waves: Vec<[f64; 4]>,
}

impl Plane {
    /// A plane with mean inverse depth about 1, textured at `wavelengths_px` (level 0) of `at`.
    pub fn new(normal: [f64; 3], wavelengths_px: [f64; 2], at: &Intrinsics) -> Self {
        let mut noise = Noise(7);
        let waves = (0..24)
            .map(|i| {
                let [short, long] = wavelengths_px;
                let length = short * (long / short).powf(f64::from(i) / 23.0) / at.fx;
                let angle = std::f64::consts::PI * noise.uniform();
                let wave_number = std::f64::consts::TAU / length;
                let phase = std::f64::consts::PI * noise.uniform();
                [wave_number * angle.cos(), wave_number * angle.sin(), phase, 9.0]
            })
            .collect();
        Self { normal, waves }
    }

    /// Brightness at a point of the plane, keyframe coordinates.
    fn brightness(&self, x: f64, y: f64) -> f64 {
        let waves = self.waves.iter();
        128.0 + waves.map(|[kx, ky, phase, a]| a * (kx * x + ky * y + phase).sin()).sum::<f64>()
    }

    /// Inverse depth at a pixel of a camera at `keyframe_from_camera`.
    pub fn inverse_depth(
        &self,
        at: &Intrinsics,
        keyframe_from_camera: &SE3,
        u: f64,
        v: f64,
    ) -> f64 {
        let ray = at.ray(u, v);
        let normal = nalgebra::Vector3::from(self.normal);
        let direction = keyframe_from_camera.rotation * ray;
        normal.dot(&direction) / (1.0 - normal.dot(&keyframe_from_camera.translation))
    }

    /// The grey value at a (sub-)pixel of a camera.
    pub fn grey(&self, at: &Intrinsics, keyframe_from_camera: &SE3, u: f64, v: f64) -> f64 {
        let ray = at.ray(u, v);
        let depth = 1.0 / self.inverse_depth(at, keyframe_from_camera, u, v);
        let point = *keyframe_from_camera * (ray * depth);
        self.brightness(point.x, point.y)
    }

    /// The image of a camera, with Gaussian noise of `noise_std_dev` grey levels and an affine
    /// change of brightness (gain, offset).
    pub fn render(
        &self,
        at: &Intrinsics,
        keyframe_from_camera: &SE3,
        noise_std_dev: f64,
        (gain, offset): (f64, f64),
        seed: u64,
    ) -> Vec<u8> {
        let mut noise = Noise(seed);
        let mut pixels = Vec::with_capacity(at.width * at.height);
        for v in 0..at.height {
            for u in 0..at.width {
                let grey = self.grey(at, keyframe_from_camera, u as f64, v as f64);
                let noisy = gain * grey + offset + noise_std_dev * noise.normal();
                pixels.push(noisy.round().clamp(1.0, 255.0) as u8);
            }
        }
        pixels
    }

    /// A keyframe at the identity with a depth at every `stride`-th pixel, with noise of relative size `depth_std_dev`
    /// (of the inverse depth) and the matching variance.
    pub fn keyframe(&self, at: &Intrinsics, stride: usize, depth_std_dev: f64) -> Keyframe {
        let image = self.render(at, &SE3::identity(), 2.0, (1.0, 0.0), 1);
        let mut noise = Noise(99);
        let mut points = Vec::new();
        for v in (2..at.height - 2).step_by(stride) {
            for u in (2..at.width - 2).step_by(stride) {
                let exact = self.inverse_depth(at, &SE3::identity(), u as f64, v as f64);
                let std_dev = depth_std_dev * exact;
                points.push(DepthPoint {
                    u: u as u16,
                    v: v as u16,
                    inverse_depth: (exact + std_dev * noise.normal()).max(0.05) as f32,
                    variance: (std_dev * std_dev).max(1e-8) as f32,
                    intensity: f32::from(image[v * at.width + u]),
                });
            }
        }
        Keyframe {
            keyframe_id: 3,
            revision: 1,
            ..Keyframe::at(Sim3::identity(), *at, points, image)
        }
    }
}

/// A small camera for quick tests: 320×240, f = 260 px.
pub fn small_camera() -> Intrinsics {
    Intrinsics { fx: 260.0, fy: 262.0, cx: 159.2, cy: 119.7, width: 320, height: 240 }
}

/// The plane of most tests, slanted so that no axis is special.
pub fn small_plane() -> Plane {
    Plane::new([0.12, -0.2, 0.95], [16.0, 180.0], &small_camera())
}
