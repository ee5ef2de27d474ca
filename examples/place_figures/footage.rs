//! Keyframes of a sequence, and the view they share according to ground truth.

use std::error::Error;
use std::fs;
use std::path::Path;

use nalgebra::Vector3;
use semidense::capture::opening::{SourceParams, open};
use semidense::service::trajectory_file::read_trajectory;
use semidense::slam::depth::map::DepthMap;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::image::buffer::Image;
use semidense::slam::keyframe::{DepthPoint, Keyframe};
use semidense::slam::mapper::MapperParams;

use crate::Arguments;

/// A keyframe.
pub struct Frame {
    pub pixels: Vec<u8>,
    world_from_camera: SE3,
    depth: Option<Image<f32>>,
}

/// The keyframes of a sequence.
pub struct Footage {
    pub camera: Intrinsics,
    pub frames: Vec<Frame>,
    depths: Vec<f64>,
}

/// Pseudo-random errors, identical on every run.
struct Noise(u64);

impl Noise {
    /// Approximately normal with standard deviation 1: the sum of twelve uniform numbers.
    fn normal(&mut self) -> f64 {
        let mut even = || {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (self.0 >> 33) as f64 / (1u64 << 31) as f64
        };
        (0..12).map(|_| even()).sum::<f64>() - 6.0
    }
}

/// Lower and upper bound on the share of their view that two keyframes have in common.
#[derive(Debug, Clone, Copy)]
pub struct Overlap {
    pub least: f64,
    pub most: f64,
}

impl Footage {
    /// Reads the frames with a true pose and, if the source has it, their depth.
    pub fn read(arguments: &Arguments) -> Result<Self, Box<dyn Error>> {
        let mut params = SourceParams::default();
        params.simulator.seed = arguments.seed;
        params.simulator.frames = arguments.frames.unwrap_or(params.simulator.frames);
        let mut source = open(&arguments.source, None, &params)?;
        source.prepare(&mut |_, _| true)?;
        let camera = source.intrinsics();
        let truth = match &arguments.truth {
            Some(file) => read_trajectory(file)?,
            None => source.ground_truth().to_vec(),
        };
        let mut pixels = vec![0; camera.width * camera.height];
        let (mut frames, mut number) = (Vec::new(), 0);
        while let Some(stamp) = source.next_into(&mut pixels)? {
            number += 1;
            if arguments.frames.is_some_and(|most| number > most) {
                break;
            }
            if (number - 1) % arguments.stride != 0 {
                continue;
            }
            /// Half the period of frames.
            const NEAR_NANOS: u64 = 17_000_000;
            let nearest = truth.iter().min_by_key(|p| p.nanos.abs_diff(stamp.capture_nanos));
            let Some(pose) = nearest.filter(|p| p.nanos.abs_diff(stamp.capture_nanos) < NEAR_NANOS)
            else {
                continue;
            };
            let depth = source.depth_at(stamp.capture_nanos)?;
            let world_from_camera = pose.world_from_camera;
            frames.push(Frame { pixels: pixels.clone(), world_from_camera, depth });
        }
        Ok(Self { camera, frames, depths: arguments.depths.clone() })
    }

    /// The keyframes as queries, darkened and rolled.
    pub fn queries(&self, contrast: f32, roll_deg: f32) -> Vec<Vec<u8>> {
        let (width, height) = (self.camera.width, self.camera.height);
        let (sin, cos) = roll_deg.to_radians().sin_cos();
        let of = |frame: &Frame| {
            let image = frame.pixels.iter().map(|&grey| contrast * f32::from(grey)).collect();
            let Some(image) = Image::try_from_pixels(width, height, image) else {
                return Vec::new();
            };
            if roll_deg == 0.0 {
                return image.pixels().iter().map(|grey| grey.round() as u8).collect();
            }
            let [u0, v0] = [width, height].map(|side| side as f32 / 2.0 - 0.5);
            let at = |k: usize| {
                let (x, y) = ((k % width) as f32 - u0, (k / width) as f32 - v0);
                let (u, v) = (u0 + cos * x - sin * y, v0 + sin * x + cos * y);
                let is_inside = u >= 0.0 && v >= 0.0 && u < width as f32 && v < height as f32;
                if is_inside { image.bilinear(u, v).round() as u8 } else { 0 }
            };
            (0..width * height).map(at).collect()
        };
        self.frames.iter().map(of).collect()
    }

    /// A frame as a keyframe at its true pose, with the mean depth as unit: pixels selected as by the mapper, with
    /// depth that has the relative error `depth_error`. `None` without depth.
    pub fn keyframe(&self, number: usize, depth_error: f64) -> Option<Keyframe> {
        let frame = self.frames.get(number)?;
        let depth = frame.depth.as_ref()?;
        let params = MapperParams::default();
        let mut map = DepthMap::with_size(self.camera.width, self.camera.height);
        map.restart(&frame.pixels, params.min_gradient, params.max_candidates);
        let mut noise = Noise(number as u64);
        let mut points = Vec::new();
        for (v, row) in (0..).zip(map.candidates.pixels().chunks_exact(self.camera.width)) {
            for (u, _) in (0..).zip(row).filter(|(_, is_candidate)| **is_candidate) {
                let [column, row] = [u, v].map(usize::from);
                let z = f64::from(depth.at(column, row));
                if !(z > 0.0 && z.is_finite()) {
                    continue;
                }
                let inverse_depth = (1.0 + depth_error * noise.normal()).max(0.1) / z;
                points.push(DepthPoint {
                    u,
                    v,
                    inverse_depth: inverse_depth as f32,
                    variance: (depth_error * inverse_depth).powi(2) as f32,
                    intensity: f32::from(frame.pixels[row * self.camera.width + column]),
                });
            }
        }
        let sum: f64 = points.iter().map(|point| f64::from(point.inverse_depth)).sum();
        let unit = points.len() as f64 / sum;
        for point in &mut points {
            point.inverse_depth *= unit as f32;
            point.variance *= (unit * unit) as f32;
        }
        let place = Sim3::new(frame.world_from_camera, unit);
        (sum > 0.0).then(|| Keyframe::at(place, self.camera, points, frame.pixels.clone()))
    }

    /// For every pair, the share that each sees of the other.
    pub fn overlaps(&self) -> Vec<Vec<Overlap>> {
        let count = self.frames.len();
        let one_way: Vec<Vec<Overlap>> =
            (0..count).map(|i| (0..count).map(|j| self.seen(i, j)).collect()).collect();
        let both = |i: usize, j: usize| {
            let (a, b) = (one_way[i][j], one_way[j][i]);
            Overlap { least: a.least.min(b.least), most: a.most.max(b.most) }
        };
        (0..count).map(|i| (0..count).map(|j| both(i, j)).collect()).collect()
    }

    /// Share of the view of frame `i` that `j` sees too: by depth, or bounded by the assumed depths.
    fn seen(&self, i: usize, j: usize) -> Overlap {
        let (i, j) = (&self.frames[i], &self.frames[j]);
        let j_from_i = j.world_from_camera.inverse() * i.world_from_camera;
        if let Some(depth) = &i.depth {
            let at = |u: usize, v: usize| Some(f64::from(depth.at(u, v))).filter(|z| *z > 0.0);
            let share = self.share(&j_from_i, at, j.depth.as_ref());
            return Overlap { least: share, most: share };
        }
        let shares: Vec<f64> =
            self.depths.iter().map(|&z| self.share(&j_from_i, |_, _| Some(z), None)).collect();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        Overlap { least: mean, most: shares.into_iter().fold(0.0, f64::max) }
    }

    fn share(
        &self,
        j_from_i: &SE3,
        depth_at: impl Fn(usize, usize) -> Option<f64>,
        theirs: Option<&Image<f32>>,
    ) -> f64 {
        /// Pixels from one sample to the next.
        const STEP: usize = 16;
        /// Relative difference of depths above which a point is occluded.
        const HIDDEN: f64 = 0.15;
        let Intrinsics { width, height, fx, fy, cx, cy, .. } = self.camera;
        let (mut all, mut seen) = (0, 0);
        for v in (STEP / 2..height).step_by(STEP) {
            for u in (STEP / 2..width).step_by(STEP) {
                let Some(z) = depth_at(u, v) else { continue };
                all += 1;
                let ray = Vector3::new((u as f64 - cx) / fx, (v as f64 - cy) / fy, 1.0);
                let point = j_from_i.rotation * (ray * z) + j_from_i.translation;
                if point.z <= 0.0 {
                    continue;
                }
                let (x, y) = (fx * point.x / point.z + cx + 0.5, fy * point.y / point.z + cy + 0.5);
                if x < 0.0 || y < 0.0 || x >= width as f64 || y >= height as f64 {
                    continue;
                }
                let there = theirs.map(|depth| f64::from(depth.at(x as usize, y as usize)));
                let is_seen =
                    there.is_none_or(|there| there <= 0.0 || (there / point.z).ln().abs() < HIDDEN);
                seen += usize::from(is_seen);
            }
        }
        f64::from(seen as u32) / f64::from(all.max(1) as u32)
    }

    /// Writes the keyframes as PGM files, and their overlaps as `least/most`, a line for each keyframe.
    pub fn export(&self, folder: &Path, overlaps: &[Vec<Overlap>]) -> Result<(), Box<dyn Error>> {
        fs::create_dir_all(folder)?;
        for (number, frame) in self.frames.iter().enumerate() {
            let mut file =
                format!("P5\n{} {}\n255\n", self.camera.width, self.camera.height).into_bytes();
            file.extend(&frame.pixels);
            fs::write(folder.join(format!("{number:05}.pgm")), file)?;
        }
        let cell = |o: &Overlap| format!("{:.3}/{:.3}", o.least, o.most);
        let line = |row: &Vec<Overlap>| row.iter().map(cell).collect::<Vec<_>>().join(" ");
        fs::write(
            folder.join("overlaps.txt"),
            overlaps.iter().map(line).collect::<Vec<_>>().join("\n"),
        )?;
        Ok(())
    }
}
