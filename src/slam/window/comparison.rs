//! Comparison of points with a keyframe: its inputs and the resulting sums.
//!
//! `X' = R X + t` with (R, t) = `observer_from_host`, X at the host's pixel and the point's inverse depth d; with the
//! image of the observer I and its gradient g at π(X'):
//!
//! `r_k = I(π(X'_k)) − m h_k`, `h_k` the host's samples over their mean, `m` the mean of the observer's: every pattern
//! has its own gain, so that vignette, exposure and response need no model. It costs one degree of freedom of eight. X'
//! is scaled by d throughout, so that points at infinity are finite.
//!
//! `∂r_k/∂p = (g_k − h_k mean(g))ᵀ ∂π/∂p`, where ∂π/∂p is taken at the pattern's centre (Engel, Koltun, Cremers 2018
//! §2.3), for the observer's pose p (left increment) and for d. The eight samples then enter only through
//! `M = Σ w g gᵀ` and `b = Σ w g r`: `H = (∂π/∂p)ᵀ M (∂π/∂p)`.

use nalgebra::Matrix6;

use crate::slam::depth::pattern::{PATTERN, sum_of_samples};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::shared::SharedImage;

/// Samples of a pattern.
pub const SAMPLES: usize = PATTERN.len();
/// Parameters of a pose.
pub const POSE: usize = 6;
/// Entries of the upper triangle of a pose's normal equations.
pub const TRIANGLE: usize = POSE * (POSE + 1) / 2;
/// Comparisons of a block: as many as the widest registers have lanes.
pub const LANES: usize = 16;
/// Pixels at the border of an observer that are not read.
pub(super) const BORDER_PX: f32 = 1.0;

/// One value for each comparison of a block.
pub type Lane = [f32; LANES];

/// Appearance of a point in its host, at one level.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PatternAppearance {
    /// Samples over their mean.
    pub shape: [f32; SAMPLES],
    /// Weight by the gradient: sub-pixel errors show there. All 0 where the pattern leaves the image or is dark.
    pub weight: [f32; SAMPLES],
}

impl PatternAppearance {
    /// Whether there is a valid pattern.
    pub fn is_whole(&self) -> bool {
        self.weight[0] > 0.0
    }
}

/// Robust weighting of residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Robustness {
    /// The cost of residuals beyond this grows linearly, grey levels.
    pub huber_grey: f32,
    /// Energy above which the observer sees something else.
    pub most_energy: f32,
}

/// Points of a host, sixteen at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub struct Patterns {
    pub(super) shape: [Lane; SAMPLES],
    pub(super) weight: [Lane; SAMPLES],
    /// At depth 1.
    pub(super) ray: [Lane; 2],
    /// In the host.
    pub inverse_depth: Lane,
}

impl Patterns {
    /// No points: their rays are outside every image.
    pub const NONE: Self = Self {
        shape: [[0.0; LANES]; SAMPLES],
        weight: [[0.0; LANES]; SAMPLES],
        ray: [[f32::NAN; LANES]; 2],
        inverse_depth: [0.0; LANES],
    };

    /// Puts a point into a lane; does nothing where it has no valid pattern.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, appearance: &PatternAppearance, ray: [f32; 2]) {
        if !appearance.is_whole() {
            return;
        }
        for k in 0..SAMPLES {
            self.shape[k][lane] = appearance.shape[k];
            self.weight[k][lane] = appearance.weight[k];
        }
        self.ray[0][lane] = ray[0];
        self.ray[1][lane] = ray[1];
    }
}

/// The results of the comparisons of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub struct Compared {
    /// Robust cost, grey levels²; NaN where a sample is outside the image, behind the camera or without data, infinite
    /// where the observer sees something else.
    pub cost: Lane,
    /// Σ w J ∂r/∂d of the observer's pose; unchanged where poses are not wanted.
    pub observer: [Lane; POSE],
    /// The same for the host's pose.
    pub host: [Lane; POSE],
    /// Σ w (∂r/∂d)².
    pub depth: Lane,
    /// Σ w r ∂r/∂d.
    pub depth_right: Lane,
}

impl Compared {
    /// No point is seen.
    pub const NONE: Self = Self {
        cost: [f32::NAN; LANES],
        observer: [[0.0; LANES]; POSE],
        host: [[0.0; LANES]; POSE],
        depth: [0.0; LANES],
        depth_right: [0.0; LANES],
    };
}

/// Sums of the comparisons of a host with an observer, by lane.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C, align(64))]
pub struct PairSums {
    /// Σ w J Jᵀ of the observer's pose, rows of the upper triangle.
    pub pose: [Lane; TRIANGLE],
    /// Σ w J r.
    pub right: [Lane; POSE],
}

/// Which derivatives are wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wanted {
    /// By the observer's pose.
    pub poses: bool,
    /// By the depths of the points.
    pub depths: bool,
    /// By the host's pose together with the depths.
    pub host: bool,
}

/// Geometry of an observer relative to a host, at one level.
#[derive(Debug, Clone, Copy)]
pub struct Pair {
    pub(super) rotation: [[f32; 3]; 3],
    pub(super) translation: [f32; 3],
    /// R times what the pattern's offsets add to the ray.
    pub(super) offsets: [[f32; SAMPLES]; 3],
    pub(super) focal: [f32; 2],
    pub(super) centre: [f32; 2],
    /// Largest pixel position that is read.
    pub(super) last: [f32; 2],
    /// Derivative of the observer's increment with respect to the host's.
    pub(super) by_host: [[f32; POSE]; POSE],
    pub(super) wanted: Wanted,
}

impl Pair {
    /// Creates the pair for images of `camera`, the camera of the level.
    pub fn new(observer_from_host: &SE3, camera: &Intrinsics, wanted: Wanted) -> Self {
        let of = observer_from_host.rotation_matrix();
        let rotation = [0, 1, 2].map(|row| [0, 1, 2].map(|column| of[(row, column)] as f32));
        let translation = [0, 1, 2].map(|row| observer_from_host.translation[row] as f32);
        let Intrinsics { fx, fy, cx, cy, width, height } = *camera;
        let offsets = [0, 1, 2].map(|row| {
            PATTERN.map(|(du, dv)| {
                (of[(row, 0)] * f64::from(du) / fx + of[(row, 1)] * f64::from(dv) / fy) as f32
            })
        });
        let by_host = Self::by_host(observer_from_host);
        let last = |side: usize| side as f32 - 2.0 - BORDER_PX;
        Self {
            rotation,
            translation,
            offsets,
            focal: [fx as f32, fy as f32],
            centre: [cx as f32, cy as f32],
            last: [last(width), last(height)],
            by_host: [0, 1, 2, 3, 4, 5].map(|r| std::array::from_fn(|c| by_host[(r, c)] as f32)),
            wanted,
        }
    }

    /// Derivative of the observer's increment with respect to the host's.
    pub fn by_host(observer_from_host: &SE3) -> Matrix6<f64> {
        -observer_from_host.adjoint()
    }
}

/// Whether positions up to [`Pair`]'s last are inside an image.
pub(super) fn fits(image: &SharedImage, pair: &Pair) -> bool {
    let [right, bottom] = pair.last;
    image.width() >= 4
        && image.height() >= 4
        && right <= image.width() as f32 - 3.0
        && bottom <= image.height() as f32 - 3.0
}

/// The sum of all lanes, added in pairs.
pub fn sum(of: &Lane) -> f32 {
    let half: [f32; 8] = std::array::from_fn(|k| of[k] + of[k + 8]);
    sum_of_samples(&half)
}
