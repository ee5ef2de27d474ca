//! Dense Cholesky steps of a front, compiled for the vector units of the processor.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::kernel::{Body, Instructions};

/// Rows and columns of a tile of products: two registers' worth of the widest vector unit.
const TILE: usize = 8;
/// Columns that are eliminated before the rest is updated: their part of a front fits the second-level cache.
const PANEL: usize = 48;
/// A pivot below this share of its original value is rounding error.
const MIN_PIVOT: f64 = 1e-13;

/// A pivot was not positive: its column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct NotPositive(pub usize);

/// A symmetric matrix whose first `least.len()` columns are to be eliminated: lower triangle by columns.
pub(super) struct Part<'a> {
    /// Rows of the matrix.
    pub size: usize,
    /// Original value of each pivot.
    pub least: &'a [f64],
    /// The columns that are eliminated, `size` rows each.
    pub factor: &'a mut [f64],
    /// The other columns, without the rows of the eliminated ones.
    pub rest: &'a mut [f64],
    /// Scratch.
    pub packed: &'a mut Vec<f64>,
}

impl Body for Part<'_> {
    type Output = Result<(), NotPositive>;

    /// Eliminates the columns; afterwards `factor` holds those of the factor, and `rest` the Schur complement.
    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> Result<(), NotPositive> {
        let Self { size, least, factor, rest, packed } = self;
        let pivots = least.len();
        for first in (0..pivots).step_by(PANEL) {
            let end = (first + PANEL).min(pivots);
            eliminate_panel(size, first, end, least, factor)?;
            let (left, right) = factor.split_at_mut(end * size);
            let panel = &left[first * size..];
            pack(panel, size, end, size, packed);
            let tiles = (size - end).div_ceil(TILE);
            let width = (end - first) * TILE;
            // The remaining pivots' columns, then the others: rows of both are counted from `end` in `packed`.
            let own = pivots - end;
            if own > 0 {
                subtract_products(
                    packed,
                    width,
                    0..own,
                    tiles,
                    &mut right[end..],
                    size,
                    size - end,
                );
            }
            let others = size - pivots;
            if others > 0 && own == 0 {
                subtract_products(packed, width, 0..others, tiles, rest, others, others);
            } else if others > 0 {
                // Tiles start at the first row of `rest`.
                pack(panel, size, pivots, size, packed);
                let tiles = others.div_ceil(TILE);
                subtract_products(packed, width, 0..others, tiles, rest, others, others);
            }
        }
        Ok(())
    }
}

/// Eliminates columns `first..end`, with their rows below.
#[inline(always)]
fn eliminate_panel(
    size: usize,
    first: usize,
    end: usize,
    least: &[f64],
    factor: &mut [f64],
) -> Result<(), NotPositive> {
    for column in first..end {
        let (done, rest) = factor.split_at_mut(column * size);
        let current = &mut rest[column..size];
        for earlier in first..column {
            let other = &done[earlier * size + column..(earlier + 1) * size];
            let share = other[0];
            for (value, other) in current.iter_mut().zip(other) {
                *value -= share * other;
            }
        }
        let pivot = current[0];
        if !(pivot > MIN_PIVOT * least[column] && pivot.is_finite()) {
            return Err(NotPositive(column));
        }
        let inverse = 1.0 / pivot.sqrt();
        current.iter_mut().for_each(|value| *value *= inverse);
    }
    Ok(())
}

/// Rows `from..size` of a panel by tiles: eight rows of the first column, of the second, …; then the next eight.
#[inline(always)]
fn pack(panel: &[f64], stride: usize, from: usize, size: usize, packed: &mut Vec<f64>) {
    let columns = panel.len() / stride;
    packed.clear();
    packed.resize((size - from).div_ceil(TILE) * TILE * columns, 0.0);
    for (tile, into) in packed.chunks_exact_mut(TILE * columns).enumerate() {
        let row = from + tile * TILE;
        let rows = TILE.min(size - row);
        for (column, into) in into.chunks_exact_mut(TILE).enumerate() {
            into[..rows].copy_from_slice(&panel[column * stride + row..][..rows]);
        }
    }
}

/// Subtracts A Aᵀ from the lower triangle of `target`, A packed by tiles of `width` numbers: its `columns`, with `rows`
/// rows and `stride` numbers per column.
#[inline(always)]
fn subtract_products(
    packed: &[f64],
    width: usize,
    columns: std::ops::Range<usize>,
    tiles: usize,
    target: &mut [f64],
    stride: usize,
    rows: usize,
) {
    for (column_tile, of_columns) in packed.chunks_exact(width).enumerate() {
        let column = column_tile * TILE;
        if column >= columns.end {
            break;
        }
        for row_tile in column_tile..tiles {
            let of_rows = &packed[row_tile * width..][..width];
            let product = tile_product(of_rows, of_columns);
            let row = row_tile * TILE;
            let present = TILE.min(rows - row);
            for (c, product) in product.iter().enumerate().take(columns.end - column) {
                let into = &mut target[(column + c) * stride + row..][..present];
                for (value, product) in into.iter_mut().zip(product) {
                    *value -= product;
                }
            }
        }
    }
}

/// Products of eight rows and eight columns.
#[inline(always)]
fn tile_product(of_rows: &[f64], of_columns: &[f64]) -> [[f64; TILE]; TILE] {
    let mut sums = [[0.0; TILE]; TILE];
    for (a, b) in of_rows.as_chunks::<TILE>().0.iter().zip(of_columns.as_chunks::<TILE>().0) {
        for c in 0..TILE {
            for r in 0..TILE {
                sums[c][r] += a[r] * b[c];
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::kernel::Kernel;
    use crate::slam::test_scene::Random;

    /// A positive definite matrix by columns.
    fn matrix(size: usize, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        let root: Vec<f64> = (0..size * size).map(|_| random.normal()).collect();
        let mut matrix = vec![0.0; size * size];
        for c in 0..size {
            for r in 0..size {
                let product: f64 = (0..size).map(|k| root[k * size + r] * root[k * size + c]).sum();
                matrix[c * size + r] = product + if r == c { 1.0 } else { 0.0 };
            }
        }
        matrix
    }

    fn eliminate_in(
        kernel: Kernel,
        size: usize,
        least: &[f64],
        factor: &mut [f64],
        rest: &mut [f64],
    ) -> Result<(), NotPositive> {
        kernel.run(Part { size, least, factor, rest, packed: &mut Vec::new() })
    }

    fn run(kernel: Kernel, matrix: &[f64], size: usize, pivots: usize) -> (Vec<f64>, Vec<f64>) {
        let mut factor = matrix[..size * pivots].to_vec();
        let others = size - pivots;
        let mut rest = Vec::new();
        for c in pivots..size {
            rest.extend_from_slice(&matrix[c * size + pivots..(c + 1) * size]);
        }
        let least: Vec<f64> = (0..pivots).map(|k| matrix[k * size + k]).collect();
        eliminate_in(kernel, size, &least, &mut factor, &mut rest).unwrap();
        // The part above the diagonal is undefined.
        (0..pivots).for_each(|c| factor[c * size..c * size + c].fill(0.0));
        (0..others).for_each(|c| rest[c * others..c * others + c].fill(0.0));
        (factor, rest)
    }

    #[test]
    fn all_versions_give_the_same_bits_and_the_factor_reproduces_the_matrix() {
        for (size, pivots) in [(1, 1), (7, 7), (20, 6), (33, 32), (150, 117), (130, 130)] {
            let matrix = matrix(size, size as u64);
            let (factor, rest) = run(Kernel::Portable, &matrix, size, pivots);
            for kernel in Kernel::available() {
                assert_eq!(run(kernel, &matrix, size, pivots), (factor.clone(), rest.clone()));
            }
            for c in 0..size {
                for r in c..size {
                    let product: f64 =
                        (0..pivots).map(|k| factor[k * size + r] * factor[k * size + c]).sum();
                    let left = if c >= pivots {
                        rest[(c - pivots) * (size - pivots) + r - pivots]
                    } else {
                        0.0
                    };
                    let error = (product + left - matrix[c * size + r]).abs();
                    assert!(error < 1e-9, "{size} {pivots}: {r} {c}: {error}");
                }
            }
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_is_refused() {
        let mut factor = vec![1.0, 1.0, 1.0, 1.0];
        let singular = eliminate_in(Kernel::Portable, 2, &[1.0, 1.0], &mut factor, &mut []);
        assert_eq!(singular, Err(NotPositive(1)));
        let mut factor = vec![f64::NAN];
        let nan = eliminate_in(Kernel::Portable, 1, &[1.0], &mut factor, &mut []);
        assert_eq!(nan, Err(NotPositive(0)));
    }
}
