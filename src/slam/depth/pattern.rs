//! The samples around a pixel that are compared with another frame.

/// The 8-sample residual pattern of Engel, Koltun, Cremers 2018 (fig. 4): even offsets only, so that no
/// sample takes part in the central difference of another and noise does not bias the refinement.
pub const PATTERN: [(i32, i32); 8] =
    [(0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2)];
