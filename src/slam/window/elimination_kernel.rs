//! Elimination of points from the normal equations, compiled for the processor's vector units.
//!
//! One source for all: no operation is fused or reordered, so every version gives the same bits.

use crate::slam::kernel::Kernel;
use crate::slam::window::comparison::POSE;

/// Entries of a row of a block: padded to a register, the last two are 0.
pub(super) const PADDED: usize = 8;

/// The block that couples two poses.
pub(super) type Block = [[f64; PADDED]; POSE];

/// The block that couples a point with one free pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct RowBlock {
    /// Number of the pose.
    pub pose: usize,
    /// ∂²/∂pose∂d.
    pub values: [f64; PADDED],
}

/// A point's part of the equations.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointRow {
    /// Index of the first of its blocks, which are in the order of the poses.
    pub first: usize,
    /// Number of them.
    pub count: usize,
    /// 1/H_dd, damped.
    pub inverse: f64,
    /// Its right side.
    pub right: f64,
}

/// Index of a block of the lower triangle.
#[inline(always)]
pub(super) fn lower(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}

/// Eliminates points from the equations of the poses, a lower triangle of blocks.
pub(super) fn eliminate(
    kernel: Kernel,
    points: &[PointRow],
    rows: &[RowBlock],
    reduced: &mut [Block],
    right: &mut [f64],
) {
    match kernel {
        // SAFETY: only `available` makes these values, after it has found AVX2 and AVX-512F.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 => unsafe { eliminate_avx2(points, rows, reduced, right) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx512 => unsafe { eliminate_avx512(points, rows, reduced, right) },
        _ => eliminate_portable(points, rows, reduced, right),
    }
}

// Not a `Body`: the compiler must know that the slices do not overlap, which only function arguments express.

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn eliminate_avx2(
    points: &[PointRow],
    rows: &[RowBlock],
    reduced: &mut [Block],
    right: &mut [f64],
) {
    eliminate_portable(points, rows, reduced, right);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f")]
fn eliminate_avx512(
    points: &[PointRow],
    rows: &[RowBlock],
    reduced: &mut [Block],
    right: &mut [f64],
) {
    eliminate_portable(points, rows, reduced, right);
}

/// The reference, which the others compile for their instructions.
#[inline(always)]
fn eliminate_portable(
    points: &[PointRow],
    rows: &[RowBlock],
    reduced: &mut [Block],
    right: &mut [f64],
) {
    for point in points {
        let row = &rows[point.first..point.first + point.count];
        for (index, block) in row.iter().enumerate() {
            let weighted: [f64; POSE] = std::array::from_fn(|k| point.inverse * block.values[k]);
            for k in 0..POSE {
                right[POSE * block.pose + k] -= weighted[k] * point.right;
            }
            for other in &row[..=index] {
                let to = &mut reduced[lower(block.pose, other.pose)];
                for k in 0..POSE {
                    for (entry, value) in to[k].iter_mut().zip(&other.values) {
                        *entry -= weighted[k] * value;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::Random;

    #[test]
    fn all_versions_give_the_same_bits_and_subtract_the_product() {
        let mut random = Random::new(3);
        let poses = 4;
        let mut rows = Vec::new();
        let points: Vec<PointRow> = (0..50)
            .map(|k| {
                let first = rows.len();
                for pose in (0..poses).filter(|pose| (k >> pose) % 2 == 0) {
                    let mut values: [f64; PADDED] = std::array::from_fn(|_| random.normal());
                    values[POSE..].fill(0.0);
                    rows.push(RowBlock { pose, values });
                }
                let (count, right) = (rows.len() - first, random.normal());
                PointRow { first, count, inverse: 0.5 + random.uniform(), right }
            })
            .collect();
        let run = |kernel| {
            let mut reduced = vec![[[1.0; PADDED]; POSE]; lower(poses, 0)];
            let mut right = vec![2.0; POSE * poses];
            eliminate(kernel, &points, &rows, &mut reduced, &mut right);
            (reduced, right)
        };
        let (reduced, right) = run(Kernel::Portable);
        for kernel in Kernel::available() {
            assert_eq!(run(kernel), (reduced.clone(), right.clone()), "{kernel:?}");
        }
        // The same with dense rows.
        let dense = |point: &PointRow| {
            let mut of = vec![0.0; POSE * poses];
            for block in &rows[point.first..point.first + point.count] {
                of[POSE * block.pose..][..POSE].copy_from_slice(&block.values[..POSE]);
            }
            of
        };
        for r in 0..POSE * poses {
            for c in 0..=r {
                let product = |point: &PointRow| dense(point)[r] * dense(point)[c] * point.inverse;
                let expected = 1.0 - points.iter().map(product).sum::<f64>();
                let found = reduced[lower(r / POSE, c / POSE)][r % POSE][c % POSE];
                assert!((found - expected).abs() < 1e-9, "{r} {c}: {found} {expected}");
            }
            let product = |point: &PointRow| dense(point)[r] * point.inverse * point.right;
            let expected = 2.0 - points.iter().map(product).sum::<f64>();
            assert!((right[r] - expected).abs() < 1e-9);
        }
    }
}
