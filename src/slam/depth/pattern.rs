//! The samples around a pixel that are compared with another frame.

/// The 8-sample residual pattern of Engel, Koltun, Cremers 2018 (fig. 4): even offsets only, so that no sample is part
/// of another's central difference and noise does not bias the refinement.
pub const PATTERN: [(i32, i32); 8] =
    [(0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2)];

/// Residual beyond which the cost of a sample grows linearly, grey levels (Engel, Koltun, Cremers 2018).
pub const HUBER_GREY: f32 = 9.0;

/// Weight of a sample with this gradient, `c²/(c²+‖g‖²)`: at strong gradients sub-pixel errors appear as residual.
#[inline]
pub fn sample_weight(gradient_u: f32, gradient_v: f32) -> f32 {
    /// Gradient at which the weight is one half, grey levels per pixel.
    const HALF_WEIGHT_GRADIENT: f32 = 50.0;
    let half = HALF_WEIGHT_GRADIENT * HALF_WEIGHT_GRADIENT;
    half / (half + gradient_u * gradient_u + gradient_v * gradient_v)
}

/// Sum over the samples, in pairs: an order that eight lanes can follow.
#[inline(always)]
pub fn sum_of_samples(of: &[f32; 8]) -> f32 {
    ((of[0] + of[4]) + (of[2] + of[6])) + ((of[1] + of[5]) + (of[3] + of[7]))
}
