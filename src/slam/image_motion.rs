//! Motion of the image as a whole between two successive images: a rotation and a zoom, which includes the camera's
//! translation at the scene's mean depth. Estimated directly from grey levels, from coarse to fine, with a gain and an
//! offset.

#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3, Vector6};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::image::pyramid::halve;
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid, grey_per_sum};

/// Rotation vector, radians, and relative change of the image's scale: directions of the first image rotated by it, and
/// their positions scaled about the principal point, are seen in the second.
pub type ImageMotion = [f64; 4];

/// Largest width of the finest level, pixels: motion is known to a hundredth of a pixel there, a tenth in the image.
const FINEST_WIDTH: usize = 160;

/// Rows of the finest level are compared in steps: half of them know the motion as well.
const FINEST_ROW_STEP: usize = 2;

/// Smallest sides of the coarsest level, pixels.
const COARSEST_SIZE: [usize; 2] = [40, 8];

/// Most levels.
const NUM_LEVELS: usize = 3;

/// Most iterations on a level; two to five are usual.
const MAX_ITERATIONS: usize = 12;

/// Steps below these end a level: pixels, gain, and grey levels.
const MIN_STEP_PX: f64 = 0.01;
const MIN_STEP_GAIN: f64 = 0.01;
const MIN_STEP_GREY: f64 = 0.5;

/// Residuals beyond this many standard deviations count less (Huber).
const HUBER: f32 = 1.5;

/// Standard deviation of a Gaussian distribution over its mean absolute value.
const STD_DEV_PER_MEAN: f32 = 1.2533;

/// Least standard deviation of residuals, grey levels: rounding.
const MIN_STD_DEV: f32 = 0.1;

/// Least share of the pixels with data that both images see.
const MIN_IN_VIEW: f64 = 0.5;

/// Least share of the image's variance that the motion must explain; parallax and moving objects are the rest.
const MIN_EXPLAINED: f64 = 0.5;

/// Least factor on the contrast of the last image.
const MIN_CONTRAST: f32 = 0.1;

/// Grey level about which the gain acts, near the mean of images, so that it hardly depends on the offset.
const MIDDLE_GREY: f32 = 128.0;

/// Prior standard deviations of a step: radians, scale, gain, and offset in grey levels. They hold what a blank wall or
/// a single edge leaves undetermined, and are wider than any motion between frames.
const PRIOR_STD_DEV: [f64; 6] = [0.3, 0.3, 0.3, 0.3, 1.0, 100.0];

/// Grey levels of one image on the levels that are compared, coarsest last; NaN without data.
type Levels = Vec<Image<f32>>;

/// Measures the motion from image to image.
#[derive(Debug)]
pub struct MotionEstimator {
    /// The pyramid's level that is the finest to be compared, and the intrinsics of all.
    finest: usize,
    cameras: Vec<Intrinsics>,
    last: Levels,
    now: Levels,
}

/// What is estimated.
#[derive(Debug, Clone, Copy)]
struct State {
    rotation: Rotation3<f64>,
    zoom: f64,
    gain: f64,
    offset: f64,
}

impl MotionEstimator {
    /// For images with these intrinsics.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let width = |level: usize| intrinsics.width >> level;
        let is_fine = |&level: &usize| width(level) <= FINEST_WIDTH;
        let finest = (1..MAX_LEVELS).find(is_fine).unwrap_or(MAX_LEVELS - 1);
        let [least_width, least_height] = COARSEST_SIZE;
        let is_large = |k: &Intrinsics| k.width >= least_width && k.height >= least_height;
        let cameras: Vec<_> = (finest..finest + NUM_LEVELS)
            .map(|level| intrinsics.at_level(level))
            .enumerate()
            .filter(|(index, camera)| *index == 0 || is_large(camera))
            .map(|(_, camera)| camera)
            .collect();
        let images = || cameras.iter().map(|k| Image::filled(k.width, k.height, 0.0)).collect();
        Self { finest, last: images(), now: images(), cameras }
    }

    /// Takes the next image.
    pub fn take(&mut self, pyramid: &SumPyramid) {
        std::mem::swap(&mut self.last, &mut self.now);
        let factor = grey_per_sum(self.finest);
        let sums = pyramid.level(self.finest).pixels();
        for (grey, &sum) in self.now[0].pixels_mut().iter_mut().zip(sums) {
            *grey = if sum == 0 { f32::NAN } else { f32::from(sum) * factor };
        }
        for level in 1..self.now.len() {
            let (fine, coarse) = self.now.split_at_mut(level);
            halve(&fine[level - 1], &mut coarse[0]);
        }
    }

    /// The motion between the last two images, `None` if it cannot be measured. `predicted` is where the search begins,
    /// beside no motion.
    pub fn motion(&self, predicted: Option<ImageMotion>) -> Option<ImageMotion> {
        // The coarsest level decides where to begin.
        let coarsest = self.cameras.len() - 1;
        let from = |start| self.solve(coarsest, State::from_motion(start));
        let ends = [Some(ImageMotion::default()), predicted].map(|start| from(start?));
        let ends = ends.into_iter().flatten();
        let mut state = ends.max_by(|one, other| one.1.total_cmp(&other.1))?;
        for level in (0..coarsest).rev() {
            state = self.solve(level, state.0)?;
        }
        let (State { rotation, zoom, gain, .. }, explained) = state;
        let turn = rotation.scaled_axis();
        let is_seen = explained >= MIN_EXPLAINED && 1.0 + gain >= f64::from(MIN_CONTRAST);
        is_seen.then_some([turn.x, turn.y, turn.z, zoom])
    }

    /// The finest level: its intrinsics, and the grey levels of the last image and the new one, NaN without data.
    pub(crate) fn finest(&self) -> (&Intrinsics, &Image<f32>, &Image<f32>) {
        (&self.cameras[0], &self.last[0], &self.now[0])
    }

    /// Iterates on one level; returns where it ends, and the share of the image's variance that it explains.
    fn solve(&self, level: usize, mut state: State) -> Option<(State, f64)> {
        let mut std_dev = f32::INFINITY;
        let mut explained = 0.0;
        for _ in 0..MAX_ITERATIONS {
            let sums = self.linearise(level, &state, HUBER * std_dev);
            let num_pixels = sums.num_pixels as f64;
            if sums.num_pixels == 0 || num_pixels < MIN_IN_VIEW * sums.num_with_data as f64 {
                return None;
            }
            explained = sums.explained(state.gain);
            std_dev = (STD_DEV_PER_MEAN * (sums.absolute / num_pixels) as f32).max(MIN_STD_DEV);
            let variance = f64::from(std_dev).powi(2);
            let prior = PRIOR_STD_DEV.map(|prior| variance / (prior * prior));
            let hessian = sums.hessian() + Matrix6::from_diagonal(&Vector6::from(prior));
            let step = -hessian.cholesky()?.solve(&sums.gradient());
            state.update(&step);
            let moved_px = step.fixed_rows::<4>(0).amax() * self.cameras[level].fx;
            if moved_px < MIN_STEP_PX
                && step[4].abs() < MIN_STEP_GAIN
                && step[5].abs() < MIN_STEP_GREY
            {
                break;
            }
        }
        Some((state, explained))
    }

    /// Compares the images of a level, the last one moved by `state`. The derivative is that of the last image, which
    /// the step moves first, in the light of the new one.
    fn linearise(&self, level: usize, state: &State, limit: f32) -> Sums {
        let k = &self.cameras[level];
        let (last, now) = (&self.last[level], &self.now[level]);
        let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(|value| value as f32);
        let m: Matrix3<f32> = state.rotation.matrix().cast();
        let [scale, gain, offset] =
            [1.0 + state.zoom, state.gain, state.offset].map(|value| value as f32);
        let (right, bottom) = ((k.width - 1) as f32, (k.height - 1) as f32);
        let contrast = (1.0 + gain).max(MIN_CONTRAST);
        let mut sums = Sums::default();
        let row_step = if level == 0 { FINEST_ROW_STEP } else { 1 };
        for v in (1..k.height - 1).step_by(row_step) {
            let (above, row, below) = (last.row(v - 1), last.row(v), last.row(v + 1));
            let y = (v as f32 - cy) / fy;
            let mut products = [0.0; NUM_PRODUCTS];
            for u in 1..k.width - 1 {
                if row[u].is_nan() {
                    continue;
                }
                sums.num_with_data += 1;
                let x = (u as f32 - cx) / fx;
                let ray = m * Vector3::new(x, y, 1.0);
                let seen_u = fx * scale * ray.x / ray.z + cx;
                let seen_v = fy * scale * ray.y / ray.z + cy;
                let is_seen = (0.0..right).contains(&seen_u) && (0.0..bottom).contains(&seen_v);
                if !is_seen || ray.z <= 0.0 {
                    continue;
                }
                let grey = row[u] - MIDDLE_GREY;
                let gradient_u = 0.5 * contrast * fx * (row[u + 1] - row[u - 1]);
                let gradient_v = 0.5 * contrast * fy * (below[u] - above[u]);
                let residual =
                    now.bilinear(seen_u, seen_v) - MIDDLE_GREY - (1.0 + gain) * grey - offset;
                // Anything without data makes it NaN.
                if (residual + gradient_u + gradient_v).is_nan() {
                    continue;
                }
                let terms = [
                    -gradient_u * x * y - gradient_v * (1.0 + y * y),
                    gradient_u * (1.0 + x * x) + gradient_v * x * y,
                    gradient_v * x - gradient_u * y,
                    gradient_u * x + gradient_v * y,
                    -grey,
                    -1.0,
                    residual,
                ];
                add_products(&mut products, &terms, (limit / residual.abs()).min(1.0));
                sums.absolute += f64::from(residual.abs());
                sums.num_pixels += 1;
            }
            for (sum, row) in sums.products.iter_mut().zip(products) {
                *sum += f64::from(row);
            }
        }
        sums
    }
}

/// Derivatives by what is estimated, and the residual.
const NUM_TERMS: usize = 7;

/// Products of two of them.
const NUM_PRODUCTS: usize = NUM_TERMS * (NUM_TERMS + 1) / 2;

/// Adds the weighted products of all pairs of terms.
#[inline(always)]
fn add_products(sums: &mut [f32; NUM_PRODUCTS], terms: &[f32; NUM_TERMS], weight: f32) {
    let mut index = 0;
    for i in 0..NUM_TERMS {
        let weighted = weight * terms[i];
        for &other in &terms[i..] {
            sums[index] += weighted * other;
            index += 1;
        }
    }
}

/// Sums over the pixels of a level; products of terms in double precision from row to row.
#[derive(Default)]
struct Sums {
    products: [f64; NUM_PRODUCTS],
    /// Absolute residuals.
    absolute: f64,
    /// Pixels in both images.
    num_pixels: usize,
    /// Pixels of the last image with data.
    num_with_data: usize,
}

impl Sums {
    /// Sum of the products of terms `i` and `j`, the lower first.
    fn product(&self, i: usize, j: usize) -> f64 {
        self.products[i * NUM_TERMS - i * (i + 1) / 2 + j]
    }

    fn hessian(&self) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| self.product(i.min(j), i.max(j)))
    }

    fn gradient(&self) -> Vector6<f64> {
        Vector6::from_fn(|i, _| self.product(i, 6))
    }

    /// Share of the new image's variance that is explained, if its contrast is that of the last one times 1 + `gain`.
    fn explained(&self, gain: f64) -> f64 {
        // The derivatives by gain and offset are the grey level and 1, negated.
        let (weight, grey, grey_squared) =
            (self.product(5, 5), self.product(4, 5), self.product(4, 4));
        let deviation = grey_squared - grey * grey / weight.max(f64::MIN_POSITIVE);
        1.0 - self.product(6, 6) / (deviation * (1.0 + gain).powi(2)).max(f64::MIN_POSITIVE)
    }
}

impl State {
    fn from_motion([x, y, z, zoom]: ImageMotion) -> Self {
        let rotation = Rotation3::from_scaled_axis(Vector3::new(x, y, z));
        Self { rotation, zoom, gain: 0.0, offset: 0.0 }
    }

    fn update(&mut self, step: &Vector6<f64>) {
        self.rotation *= Rotation3::from_scaled_axis(step.fixed_rows::<3>(0).into_owned());
        self.zoom += step[3];
        self.gain += step[4];
        self.offset += step[5];
    }
}
