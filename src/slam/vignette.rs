//! Vignette: a lens that passes less light towards its corners. How much is estimated from images of a moving camera,
//! and undone once it is certain.
//!
//! What is seen at r in one image and at r′ in the next changes its grey level by the ratio of the lens' light there,
//! beside a gain and an offset of the whole image. The displacement is the rotation and zoom of `image_motion`; what
//! parallax adds to it changes grey levels where they have a gradient, and those count less.

#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::repeats::{Repeats, Shown};
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid};
use crate::slam::image_motion::{ImageMotion, MotionEstimator};

/// Each image is compared with one neighbour: with both, they would be compared twice as long.
const PERIOD: u32 = 2;

/// Standard deviation of grey levels that a comparison is expected to have, and displacement that is not modelled,
/// pixels of the level that is compared.
const NOISE_GREY: f32 = 1.5;
const DISPLACEMENT_PX: f32 = 0.3;

/// Deviations beyond this many standard deviations count less (Huber).
const HUBER: f64 = 1.5;

/// Grey levels that are compared: darker ones are noise, brighter ones may be saturated.
const COMPARED_GREYS: std::ops::RangeInclusive<f32> = 12.0..=225.0;

/// Fewest pixels of a comparison.
const MIN_COMPARED: usize = 1000;

/// Pixels that share their error: surfaces at one depth and edges of one object.
const PIXELS_PER_ERROR: f64 = 25.0;

/// Prior standard deviation of each coefficient: holds what no displacement determines.
const PRIOR_STD_DEV: f64 = 0.5;

/// Standard deviation of the logarithm of the light in the corners at which it is decided. The first views share errors
/// of their surfaces: up to 0.2 is left of a loss of 0.5. Waiting for thirty comparisons leaves less, but the views
/// before them then differ: rooms turned in on the spot have three times the error.
const CERTAIN: f64 = 0.02;

/// Least loss in the corners that is undone, as a logarithm: a sixth. Smaller ones cost nothing, and a correction
/// separates the views before and after it.
const MIN_LOSS: f64 = 0.18;

/// Largest factor on grey levels: beyond it there is nothing but noise.
const MAX_FACTOR: f64 = 4.0;

/// Bits after the point of a factor.
const FRACTION_BITS: u32 = 8;

/// Logarithm of the light, as the coefficients of powers of the squared distance from the principal point, 1 in the
/// farthest corner.
type Coefficients = Vector3<f64>;

/// Estimates and undoes the vignette of one lens, image after image.
#[derive(Debug)]
pub struct Vignette {
    intrinsics: Intrinsics,
    num_images: u32,
    stage: Stage,
}

#[derive(Debug)]
enum Stage {
    Estimated(Box<Estimate>),
    /// It is too small to be undone.
    Even,
    /// Factor on the grey level of each pixel, and the light in the corners.
    Undone {
        factors: Vec<u16>,
        light: f64,
    },
}

/// What the images so far tell.
#[derive(Debug)]
struct Estimate {
    pyramid: SumPyramid,
    repeats: Repeats,
    motion: MotionEstimator,
    /// Squared distance of the image's farthest corner.
    corner: f64,
    information: Matrix3<f64>,
    vector: Vector3<f64>,
}

impl Vignette {
    /// For rectified images with these intrinsics.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let pyramid = SumPyramid::with_size(intrinsics.width, intrinsics.height, MAX_LEVELS, 1);
        let estimate = Estimate {
            repeats: Repeats::with_size_of(&pyramid),
            pyramid,
            corner: farthest_corner(intrinsics),
            motion: MotionEstimator::new(intrinsics),
            information: Matrix3::from_diagonal_element(PRIOR_STD_DEV.powi(-2)),
            vector: Vector3::zeros(),
        };
        let stage = Stage::Estimated(Box::new(estimate));
        Self { intrinsics: *intrinsics, num_images: 0, stage }
    }

    /// Takes the next image as the sensor gave it, grey levels with 0 for no data. Returns the share of light in the
    /// corners if from now on it is undone. Does nothing once that is decided.
    pub fn follow(&mut self, pixels: &[u8]) -> Option<f64> {
        let Stage::Estimated(estimate) = &mut self.stage else { return None };
        if pixels.len() != self.intrinsics.width * self.intrinsics.height {
            return None;
        }
        estimate.pyramid.fill(pixels);
        // A repeated image shows no motion.
        if estimate.repeats.observe(&estimate.pyramid) == Shown::Repeat {
            return None;
        }
        estimate.motion.take(&estimate.pyramid);
        self.num_images += 1;
        if !self.num_images.is_multiple_of(PERIOD) {
            return None;
        }
        estimate.compare();
        self.decide()
    }

    /// Forgets the last image, as before a jump in the source.
    pub fn restart(&mut self) {
        self.num_images = 0;
        if let Stage::Estimated(estimate) = &mut self.stage {
            estimate.repeats = Repeats::with_size_of(&estimate.pyramid);
        }
    }

    /// Undoes it, if it is known and large enough.
    pub fn undo(&self, pixels: &mut [u8]) {
        if let Stage::Undone { factors, .. } = &self.stage {
            const HALF: u32 = 1 << (FRACTION_BITS - 1);
            for (grey, &factor) in pixels.iter_mut().zip(factors) {
                let undone = (u32::from(*grey) * u32::from(factor) + HALF) >> FRACTION_BITS;
                *grey = undone.min(u32::from(u8::MAX)) as u8;
            }
        }
    }

    /// Share of the light in the corners, if it is undone.
    pub fn light_in_corners(&self) -> Option<f64> {
        match &self.stage {
            Stage::Undone { light, .. } => Some(*light),
            _ => None,
        }
    }

    fn decide(&mut self) -> Option<f64> {
        let Stage::Estimated(estimate) = &self.stage else { return None };
        let inverse = estimate.information.try_inverse()?;
        let corner = Vector3::repeat(1.0);
        let std_dev = (corner.dot(&(inverse * corner))).sqrt();
        let coefficients = inverse * estimate.vector;
        if !(std_dev <= CERTAIN) {
            return None;
        }
        let loss = -coefficients.sum();
        if !(loss >= MIN_LOSS) {
            self.stage = Stage::Even;
            return None;
        }
        let light = (-loss).exp().max(MAX_FACTOR.recip());
        let factors = factors(&self.intrinsics, &coefficients);
        self.stage = Stage::Undone { factors, light };
        Some(light)
    }
}

/// Logarithm of the light at a squared distance.
fn logarithm(coefficients: &Coefficients, squared: f64) -> f64 {
    coefficients.dot(&powers(squared))
}

fn powers(squared: f64) -> Vector3<f64> {
    Vector3::new(squared, squared * squared, squared.powi(3))
}

/// Squared distance of the image's farthest corner from the principal point, in focal lengths.
fn farthest_corner(camera: &Intrinsics) -> f64 {
    let far = |center: f64, side: usize| center.max(side as f64 - 1.0 - center);
    let x = far(camera.cx, camera.width) / camera.fx;
    let y = far(camera.cy, camera.height) / camera.fy;
    x * x + y * y
}

/// Squared distance of a pixel of any level from the principal point, 1 in the image's farthest corner.
fn squared_distance(camera: &Intrinsics, corner: f64) -> impl Fn(f64, f64) -> f64 {
    let Intrinsics { fx, fy, cx, cy, .. } = *camera;
    move |u, v| (((u - cx) / fx).powi(2) + ((v - cy) / fy).powi(2)) / corner
}

/// Factors on grey levels, as integers.
fn factors(camera: &Intrinsics, coefficients: &Coefficients) -> Vec<u16> {
    let squared = squared_distance(camera, farthest_corner(camera));
    let one = f64::from(1_u32 << FRACTION_BITS);
    let factor = |(u, v): (usize, usize)| {
        let light = logarithm(coefficients, squared(u as f64, v as f64)).exp();
        (one * light.recip().clamp(1.0, MAX_FACTOR)).round() as u16
    };
    (0..camera.height).flat_map(|v| (0..camera.width).map(move |u| (u, v))).map(factor).collect()
}

/// Weighted products of the derivatives by coefficients, gain and offset, and of the new grey level.
type Products = SMatrix<f64, 6, 6>;

impl Estimate {
    /// Adds what the last two images tell.
    fn compare(&mut self) {
        let Some(motion) = self.motion.motion(None) else { return };
        // The first pass finds how well the images agree; the second counts what does not less.
        let Some((first, num_compared)) = self.products(&motion, 1.0, |_| 1.0) else { return };
        let before = self.coefficients();
        let Some((coefficients, light)) = light_of(&first, &before).and_then(|light| {
            let scale = scale(deviation(&first, &before, &light) / num_compared as f64);
            let (information, vector) = without_light(&first)?;
            let information = self.information + scale * information;
            let coefficients = information.cholesky()?.solve(&(self.vector + scale * vector));
            Some((coefficients, light_of(&first, &coefficients)?))
        }) else {
            return;
        };
        let variance = deviation(&first, &coefficients, &light) / num_compared as f64;
        let limit = HUBER * variance.max(f64::MIN_POSITIVE).sqrt();
        let gain = light.x;
        // The gain is in the derivatives by the coefficients too.
        let state =
            SVector::from([coefficients.x, coefficients.y, coefficients.z, light.x, light.y]);
        let weight = |terms: &SVector<f64, 6>| {
            (limit / (terms[5] - terms.fixed_rows::<5>(0).dot(&state)).abs()).min(1.0)
        };
        let products = self.products(&motion, gain, weight);
        let Some((information, vector)) = products.and_then(|(of, _)| without_light(&of)) else {
            return;
        };
        if information.iter().chain(vector.iter()).all(|value| value.is_finite()) {
            self.information += scale(variance) * information;
            self.vector += scale(variance) * vector;
        }
    }

    fn coefficients(&self) -> Coefficients {
        self.information.cholesky().map_or_else(Vector3::zeros, |of| of.solve(&self.vector))
    }

    /// Sums over the pixels that both images see, each as if its grey level had a standard deviation of 1, times
    /// `weight`; and their number. `gain` is that of the derivatives by the coefficients.
    fn products(
        &self,
        motion: &ImageMotion,
        gain: f64,
        weight: impl Fn(&SVector<f64, 6>) -> f64,
    ) -> Option<(Products, usize)> {
        let (k, last, now) = self.motion.finest();
        let rotation = Rotation3::from_scaled_axis(Vector3::new(motion[0], motion[1], motion[2]));
        let scale = 1.0 + motion[3];
        let squared = squared_distance(k, self.corner);
        // Samples beyond would be clamped.
        let [right, bottom] = [k.width, k.height].map(|side| side.saturating_sub(2) as f64);
        let mut products = Products::zeros();
        let mut num_compared = 0;
        for v in 1..k.height - 1 {
            let (above, row, below) = (last.row(v - 1), last.row(v), last.row(v + 1));
            for u in 1..k.width - 1 {
                let (du, dv) = (row[u + 1] - row[u - 1], below[u] - above[u]);
                if !COMPARED_GREYS.contains(&row[u]) || (du + dv).is_nan() {
                    continue;
                }
                let ray = Vector3::new((u as f64 - k.cx) / k.fx, (v as f64 - k.cy) / k.fy, 1.0);
                let ray = rotation * ray;
                let seen_u = k.fx * scale * ray.x / ray.z + k.cx;
                let seen_v = k.fy * scale * ray.y / ray.z + k.cy;
                let is_inside =
                    seen_u >= 0.0 && seen_v >= 0.0 && seen_u <= right && seen_v <= bottom;
                if !(ray.z > 0.0 && is_inside) {
                    continue;
                }
                let seen = now.bilinear(seen_u as f32, seen_v as f32);
                if !COMPARED_GREYS.contains(&seen) {
                    continue;
                }
                let squared_gradient = 0.25 * (du * du + dv * dv);
                let variance =
                    NOISE_GREY * NOISE_GREY + DISPLACEMENT_PX * DISPLACEMENT_PX * squared_gradient;
                let inverse_std_dev = f64::from(variance.sqrt().recip());
                let grey = f64::from(row[u]);
                let to = powers(squared(seen_u, seen_v));
                let change = gain * grey * (to - powers(squared(u as f64, v as f64)));
                let terms = inverse_std_dev
                    * SVector::from([change.x, change.y, change.z, grey, 1.0, f64::from(seen)]);
                products += weight(&terms) * terms * terms.transpose();
                num_compared += 1;
            }
        }
        (num_compared >= MIN_COMPARED).then_some((products, num_compared))
    }
}

/// Weight of a comparison whose pixels have this variance, times that expected.
fn scale(variance: f64) -> f64 {
    1.0 / (variance.max(1.0) * PIXELS_PER_ERROR)
}

/// Information on the coefficients, with gain and offset eliminated.
fn without_light(products: &Products) -> Option<(Matrix3<f64>, Vector3<f64>)> {
    let of_light = products.fixed_view::<2, 2>(3, 3).try_inverse()?;
    let cross = products.fixed_view::<3, 2>(0, 3) * of_light;
    let information = products.fixed_view::<3, 3>(0, 0) - cross * products.fixed_view::<2, 3>(3, 0);
    let vector = products.fixed_view::<3, 1>(0, 5) - cross * products.fixed_view::<2, 1>(3, 5);
    Some((information, vector))
}

/// Gain and offset that fit best with these coefficients.
fn light_of(products: &Products, coefficients: &Coefficients) -> Option<SVector<f64, 2>> {
    let right =
        products.fixed_view::<2, 1>(3, 5) - products.fixed_view::<2, 3>(3, 0) * coefficients;
    Some(products.fixed_view::<2, 2>(3, 3).try_inverse()? * right)
}

/// Sum of the squared deviations.
fn deviation(products: &Products, coefficients: &Coefficients, light: &SVector<f64, 2>) -> f64 {
    let combined =
        SVector::from([-coefficients.x, -coefficients.y, -coefficients.z, -light.x, -light.y, 1.0]);
    combined.dot(&(products * combined)).max(0.0)
}
