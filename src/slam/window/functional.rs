//! Linear functions of the free parameters, of which uncertainties are computed.

use nalgebra::{DVector, Vector4, Vector6};

use crate::slam::geometry::se3::SE3;
use crate::slam::window::comparison::POSE;

/// A linear function of the free parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Functional {
    /// Coefficients of the left increments of the free poses.
    pub poses: DVector<f64>,
    /// Coefficients of inverse depths, each with the index of its point in the views.
    pub depths: Vec<(usize, f64)>,
}

impl Functional {
    /// The zero function.
    pub fn zero(num_free: usize) -> Self {
        Self { poses: DVector::zeros(POSE * num_free), depths: Vec::new() }
    }

    /// Adds a function of a free pose.
    pub fn add_pose(&mut self, number: usize, of: &Vector6<f64>) {
        let mut entries = self.poses.fixed_rows_mut::<POSE>(POSE * number);
        entries += of;
    }
}

/// A point as seen in a keyframe.
pub(super) struct Seen {
    /// Index among the points of the views.
    pub(super) slot: usize,
    /// Its host, which moves it too, and the pose of the keyframe relative to it; `None` for the keyframe's own.
    pub(super) from_host: Option<(usize, SE3)>,
    /// (1, X, Y, ln d') in the keyframe.
    pub(super) phi: Vector4<f64>,
    /// ∂ ln d'/∂d.
    pub(super) by_depth: f64,
    /// ∂ ln d'/∂ the left increment of the keyframe's pose.
    pub(super) by_pose: Vector6<f64>,
}
