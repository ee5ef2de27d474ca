//! The samples around a pixel that are compared with another frame.

/// The 8-sample residual pattern of Engel, Koltun, Cremers 2018 (fig. 4): even offsets only, so that no
/// sample takes part in the central difference of another and noise does not bias the refinement.
pub const PATTERN: [(i32, i32); 8] =
    [(0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2)];

/// The sum over its samples, in pairs: an order that eight lanes can do.
#[inline(always)]
pub fn sum_of_samples(of: &[f32; 8]) -> f32 {
    ((of[0] + of[4]) + (of[2] + of[6])) + ((of[1] + of[5]) + (of[3] + of[7]))
}
