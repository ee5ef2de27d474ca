//! The unknowns of a start.

use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;

/// The estimated state.
#[derive(Debug, Clone)]
pub struct State {
    /// Pose, in the unit of 1/d.
    pub current_from_first: SE3,
    /// Brightness of the current frame against the first.
    pub brightness: Brightness,
    /// Slopes of the logarithm of the gain along x and y of a point's ray; `None` where it is uniform and stays so.
    pub gain_slopes: Option<[f64; 2]>,
    /// Inverse depth of each point.
    pub inverse_depths: Vec<f32>,
}

impl State {
    /// A camera that has not moved, with the inverse depth 1 of `num_points` points.
    pub fn at_rest(num_points: usize) -> Self {
        Self {
            current_from_first: SE3::identity(),
            brightness: Brightness::default(),
            gain_slopes: None,
            inverse_depths: vec![1.0; num_points],
        }
    }

    /// Lets the gain vary over the image.
    pub fn free_slopes(&mut self) {
        self.gain_slopes.get_or_insert([0.0; 2]);
    }
}
