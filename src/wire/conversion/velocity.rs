//! The velocity in the message of a pose.

use nalgebra::Vector3;

use crate::slam::pose::Velocity;
use crate::wire::conversion::{DIAGONAL, MessageError};
use crate::wire::message::PoseMessage;

/// Writes a velocity into `message`; where there is none, zeros and that there is none.
pub(super) fn put_velocity(velocity: Option<&Velocity>, message: &mut PoseMessage) {
    message.has_velocity = u32::from(velocity.is_some());
    let zero = Vector3::zeros();
    let [linear, angular] = velocity.map_or([zero; 2], |v| [v.linear, v.angular]);
    (message.linear_velocity, message.angular_velocity) = (linear.into(), angular.into());
    message.velocity_covariance = velocity.map_or([0.0; 21], |v| v.covariance);
}

/// The velocity in a pose's message, checked; `None` where it says that there is none.
pub fn velocity_from_message(message: &PoseMessage) -> Result<Option<Velocity>, MessageError> {
    let covariance = message.velocity_covariance;
    let [linear, angular] = [message.linear_velocity, message.angular_velocity];
    let is_finite = linear.iter().chain(&angular).chain(&covariance).all(|x| x.is_finite());
    if !is_finite || DIAGONAL.iter().any(|&entry| covariance[entry] < 0.0) {
        return Err(MessageError::InvalidNumber { field: "velocity" });
    }
    match message.has_velocity {
        0 => Ok(None),
        1 => Ok(Some(Velocity { linear: linear.into(), angular: angular.into(), covariance })),
        code => Err(MessageError::UnknownCode { field: "has_velocity", code }),
    }
}
