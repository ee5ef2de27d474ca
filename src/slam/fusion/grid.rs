//! Points in a grid of cells, for queries of those near a position.

/// Points hashed by cell: lists in reverse order of insertion.
#[derive(Debug)]
pub(super) struct Grid {
    side: f64,
    mask: usize,
    heads: Vec<u32>,
    /// Each point with the index of the previous one in its bucket.
    points: Vec<([f32; 3], u32)>,
}

const NONE: u32 = u32::MAX;

impl Grid {
    /// An empty grid with cells of `side`, for about `count` points.
    pub fn new(side: f64, count: usize) -> Self {
        let buckets = (2 * count).next_power_of_two().max(16);
        Self {
            side,
            mask: buckets - 1,
            heads: vec![NONE; buckets],
            points: Vec::with_capacity(count),
        }
    }

    /// Adds the next point; points are numbered from 0 in order of insertion.
    pub fn push(&mut self, position: [f32; 3]) {
        let bucket = self.bucket(self.cell(position));
        self.points.push((position, self.heads[bucket]));
        self.heads[bucket] = (self.points.len() - 1) as u32;
    }

    /// Calls `look` with the number of each point within `radius`, until it returns `false`.
    pub fn near(&self, position: [f32; 3], radius: f64, look: &mut dyn FnMut(usize) -> bool) {
        let end = |sign: f64| position.map(|c| floor((f64::from(c) + sign * radius) / self.side));
        let (low, high) = (end(-1.0), end(1.0));
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for z in low[2]..=high[2] {
                    let mut at = self.heads[self.bucket([x, y, z])];
                    while let Some(&(other, next)) = self.points.get(at as usize) {
                        // Other cells can share the bucket.
                        let is_near = self.cell(other) == [x, y, z]
                            && distance_squared(position, other) <= radius * radius;
                        if is_near && !look(at as usize) {
                            return;
                        }
                        at = next;
                    }
                }
            }
        }
    }

    fn cell(&self, position: [f32; 3]) -> [i64; 3] {
        position.map(|c| floor(f64::from(c) / self.side))
    }

    fn bucket(&self, cell: [i64; 3]) -> usize {
        hash(cell) as usize & self.mask
    }
}

/// Large odd numbers that spread neighbouring cells over the buckets (Teschner et al. 2003 have the form).
pub(super) fn hash([x, y, z]: [i64; 3]) -> u64 {
    let mixed = (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ (z as u64).wrapping_mul(0x1656_67B1_9E37_79F9);
    let mixed = (mixed ^ (mixed >> 31)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    mixed ^ (mixed >> 32)
}

/// The largest integer not above `x`; `f64::floor` is a call on CPUs of the least instruction set.
fn floor(x: f64) -> i64 {
    let whole = x as i64;
    whole - i64::from(whole as f64 > x)
}

fn distance_squared(a: [f32; 3], b: [f32; 3]) -> f64 {
    (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_near_a_position_are_those_of_an_exhaustive_search() {
        let number = |i: u64, c: i64| (hash([i as i64, c, 7]) % 2000) as f32 / 1000.0 - 1.0;
        let points: Vec<[f32; 3]> =
            (0..500).map(|i| [number(i, 0), number(i, 1), number(i, 2)]).collect();
        // So few buckets that cells share them.
        let mut grid = Grid::new(0.2, 10);
        points.iter().for_each(|&point| grid.push(point));
        for (i, &at) in points.iter().enumerate().step_by(7) {
            for radius in [0.1, 0.25, 0.5] {
                let mut found = Vec::new();
                grid.near(at, radius, &mut |k| {
                    found.push(k);
                    true
                });
                found.sort_unstable();
                let is_near = |k: &usize| distance_squared(at, points[*k]) <= radius * radius;
                let expected: Vec<usize> = (0..points.len()).filter(is_near).collect();
                assert_eq!(found, expected, "{i}, {radius}");
            }
        }
    }
}
