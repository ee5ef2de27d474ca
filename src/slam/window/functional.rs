//! Linear functions of everything that is free, of which the uncertainties are asked for.

use nalgebra::{DVector, Vector4, Vector6};

use crate::slam::geometry::se3::SE3;
use crate::slam::window::comparison::POSE;

/// A linear function of everything that is free.
#[derive(Debug, Clone, PartialEq)]
pub struct Functional {
    /// By entry of the left increments of the free poses.
    pub poses: DVector<f64>,
    /// By inverse depth, of some points by their place in the views.
    pub depths: Vec<(usize, f64)>,
}

impl Functional {
    /// That nothing changes.
    pub fn zero(num_free: usize) -> Self {
        Self { poses: DVector::zeros(POSE * num_free), depths: Vec::new() }
    }

    /// Adds a function of a free pose.
    pub fn add_pose(&mut self, number: usize, of: &Vector6<f64>) {
        let mut entries = self.poses.fixed_rows_mut::<POSE>(POSE * number);
        entries += of;
    }
}

/// A point as a keyframe has it.
pub(super) struct Seen {
    /// Place among the points of the views.
    pub(super) slot: usize,
    /// Who else moves it: its host, with where the keyframe stands from that; `None` of the keyframe's own.
    pub(super) from_host: Option<(usize, SE3)>,
    /// (1, X, Y, ln d') there.
    pub(super) phi: Vector4<f64>,
    /// ∂ ln d'/∂d.
    pub(super) by_depth: f64,
    /// ∂ ln d'/∂ the left increment of the keyframe's pose.
    pub(super) by_pose: Vector6<f64>,
}
