//! What a start estimates.

use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;

/// What is estimated.
#[derive(Debug, Clone)]
pub struct State {
    /// Pose, in the unit of 1/d.
    pub current_from_first: SE3,
    /// Brightness of the current frame against the first.
    pub brightness: Brightness,
    /// By how much the logarithm of the gain grows with x and with y of a point's ray; `None` where it is the same
    /// everywhere and stays so.
    pub gain_slopes: Option<[f64; 2]>,
    /// Inverse depth of each point.
    pub inverse_depths: Vec<f32>,
}

impl State {
    /// A camera that has not moved, with the inverse depth 1 of so many points.
    pub fn at_rest(num_points: usize) -> Self {
        Self {
            current_from_first: SE3::identity(),
            brightness: Brightness::default(),
            gain_slopes: None,
            inverse_depths: vec![1.0; num_points],
        }
    }

    /// Lets the gain differ from place to place.
    pub fn free_slopes(&mut self) {
        self.gain_slopes.get_or_insert([0.0; 2]);
    }
}
