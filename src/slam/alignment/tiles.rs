//! Tiles of the image, over which the gradient of the cost is summed.

use crate::slam::alignment::normal_equations::UNKNOWNS;

/// Tiles along u and v: some 170 with points in a usual keyframe, where eight unknowns need tens. Between 8×6 and 40×30
/// the calibration hardly depends on it.
const TILES: (usize, usize) = (16, 12);

/// Number of tiles.
pub const NUM_TILES: usize = TILES.0 * TILES.1;

/// The tile of a pixel of an image of this size.
pub fn tile_of(u: usize, v: usize, width: usize, height: usize) -> u16 {
    let (columns, rows) = TILES;
    // Sides are at most 65 536 pixels, and 32-bit division is faster.
    let share = |at: usize, parts: usize, side: usize| {
        ((at as u32 * parts as u32 / (side as u32).max(1)) as usize).min(parts - 1)
    };
    (share(v, rows, height) * columns + share(u, columns, width)) as u16
}

/// Sums over the points of one tile.
#[derive(Debug, Clone, Copy, Default)]
pub struct TileSum {
    /// Σ w J r.
    pub gradient: [f32; UNKNOWNS],
    /// Σ w; positive if a point is in view.
    pub weight: f32,
    /// Upper triangle of Σ w J Jᵀ of the rotations about x and y, which move a tile along v and u.
    pub information: [f32; 3],
}
