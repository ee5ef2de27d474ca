//! Orders points so that any prefix shows the whole map, more coarsely the shorter it is.

use crate::slam::fusion::SurfacePoint;
use crate::slam::fusion::grid::hash;

/// Bits of a coordinate.
const BITS: u32 = 20;

/// Levels by which a point from only one or two keyframes is deferred: it may be wrong, and where it is alone in a
/// large cell it would be among the first.
const DOUBT: u32 = 3;

/// The order: index in the list for each rank. The most certain point of each octree cell represents it; points that
/// represent larger cells come first, those of one size in random spatial order.
pub(super) fn progressive_order(points: &[SurfacePoint]) -> Vec<usize> {
    let positions = || points.iter().map(|point| point.position);
    let [low, high] =
        positions().fold([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]], |[low, high], at| {
            [
                std::array::from_fn(|c| low[c].min(at[c])),
                std::array::from_fn(|c| high[c].max(at[c])),
            ]
        });
    let extent = (0..3).map(|c| f64::from(high[c]) - f64::from(low[c])).fold(0.0, f64::max);
    let cells = f64::from((1u32 << BITS) - 1);
    let scale = if extent > 0.0 { cells / extent } else { 0.0 };
    let code = |at: [f32; 3]| {
        let cell = |c: usize| ((f64::from(at[c]) - f64::from(low[c])) * scale) as u64;
        spread(cell(0)) | spread(cell(1)) << 1 | spread(cell(2)) << 2
    };
    let mut by_code: Vec<(u64, usize)> =
        positions().enumerate().map(|(i, at)| (code(at), i)).collect();
    by_code.sort_unstable();
    let mut ranked: Vec<(u32, u64, usize)> = levels(points, &by_code)
        .into_iter()
        .zip(&by_code)
        .map(|(level, &(code, i))| {
            let doubt = if points[i].keyframes <= 2 { DOUBT } else { 0 };
            (level + doubt, hash([code as i64, i as i64, 0]), i)
        })
        .collect();
    ranked.sort_unstable();
    ranked.into_iter().map(|(_, _, i)| i).collect()
}

/// For each point, in order of the codes, the level of the largest cell that it represents, from 0.
fn levels(points: &[SurfacePoint], by_code: &[(u64, usize)]) -> Vec<u32> {
    const NONE: u32 = u32::MAX;
    let mut levels = vec![NONE; by_code.len()];
    for level in 0..=BITS {
        let shift = 3 * (BITS - level);
        let mut begin = 0;
        for cell in by_code.chunk_by(|a, b| a.0 >> shift == b.0 >> shift) {
            let of_cell = &mut levels[begin..begin + cell.len()];
            begin += cell.len();
            if of_cell.iter().any(|&level| level != NONE) {
                continue;
            }
            let known = |&k: &usize| {
                let point = &points[cell[k].1];
                (std::cmp::Reverse(point.keyframes), point.sigma.to_bits(), k)
            };
            if let Some(best) = (0..cell.len()).min_by_key(known) {
                of_cell[best] = level;
            }
        }
    }
    // The points that share the smallest cell with a better one.
    levels.into_iter().map(|level| level.min(BITS + 1)).collect()
}

/// A number with two zero bits inserted between its bits.
fn spread(number: u64) -> u64 {
    let mut x = number & 0x1F_FFFF;
    for (shift, mask) in [
        (32, 0x1F_0000_0000_FFFF),
        (16, 0x1F_0000_FF00_00FF),
        (8, 0x100F_00F0_0F00_F00F),
        (4, 0x10C3_0C30_C30C_30C3),
        (2, 0x1249_2492_4924_9249),
    ] {
        x = (x | x << shift) & mask;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_prefix_shows_all_of_a_line() {
        let points = |positions: &[[f32; 3]]| -> Vec<SurfacePoint> {
            let point =
                |&position| SurfacePoint { position, keyframes: 3, ..SurfacePoint::default() };
            positions.iter().map(point).collect()
        };
        let positions: Vec<[f32; 3]> = (0..4096).map(|i| [i as f32, 1.0, 2.0]).collect();
        let mut line = points(&positions);
        line[77].keyframes = 1;
        let order = progressive_order(&line);
        assert!(order.iter().position(|&i| i == 77).unwrap() > 2000, "it may be wrong");
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &k)| i == k), "each point once");
        for count in [64, 256, 1000, 3000] {
            let mut shown: Vec<usize> = order[..count].to_vec();
            shown.sort_unstable();
            let gap = shown.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap();
            assert!(gap <= 4 * 4096 / count, "{count} points, a gap of {gap}");
        }
        assert!(progressive_order(&[]).is_empty());
        assert_eq!(progressive_order(&points(&[[1.0; 3]])), [0]);
        assert_eq!(progressive_order(&points(&[[1.0; 3]; 3])).len(), 3);
    }
}
