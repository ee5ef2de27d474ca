//! Tracks which motion has been ahead of its rivals since the first frame.
//!
//! A single frame may prefer the wrong one: where many depths have ended in wrong minima the right motion loses its
//! lead.

use nalgebra::Vector3;

use crate::slam::two_frame::hypothesis::RIVAL_COSINE;

/// The motion that is ahead, and by how much.
#[derive(Debug, Default)]
pub(super) struct Lead {
    /// Direction of the translation.
    heading: Vector3<f64>,
    /// Sum of its excesses over its rivals, minus theirs over it.
    excess: f64,
}

impl Lead {
    /// Adds the best motion of a frame and the excess of its rival's energy; returns whether it is ahead over all
    /// frames together.
    pub(super) fn observe(&mut self, heading: &Vector3<f64>, excess: f64) -> bool {
        // NaN counts as no excess.
        let excess = excess.max(0.0);
        let is_same = heading.dot(&self.heading) >= RIVAL_COSINE;
        if !is_same && excess < self.excess {
            self.excess -= excess;
            return false;
        }
        self.excess = if is_same { self.excess + excess } else { excess - self.excess };
        self.heading = *heading;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_that_was_behind_must_make_up_for_all_frames() {
        let mut lead = Lead::default();
        let (right, wrong) = (Vector3::x(), -Vector3::x());
        assert!(lead.observe(&wrong, 0.01));
        assert!(lead.observe(&right, 0.2));
        let turned = Vector3::new(0.95, 0.3122, 0.0);
        assert!(lead.observe(&turned, 0.15), "a path may bend");
        assert!(!lead.observe(&wrong, 0.2));
        assert!(lead.observe(&turned, 0.0));
        assert!(!lead.observe(&wrong, 0.1));
        assert!(!lead.observe(&wrong, f64::NAN));
        assert!(lead.observe(&wrong, 0.1), "0.34 ahead, 0.3 and 0.1 behind");
    }

    #[test]
    fn the_first_motion_leads() {
        assert!(Lead::default().observe(&Vector3::y(), 0.0));
        assert!(Lead::default().observe(&Vector3::zeros(), 0.0));
    }
}
