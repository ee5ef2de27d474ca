//! Points gathered in cells of space whose size follows their uncertainty.

use std::cmp::Ordering;

/// Number of cell sizes per factor of two.
const STEPS_PER_OCTAVE: f64 = 2.0;
/// Largest index of a cell along an axis, of either sign.
const MAX_CELL_INDEX: f64 = 1e9;

/// A cell: its size and its position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Cell {
    /// Its size level, see [`side`].
    pub level: i16,
    /// Its index along each axis.
    pub at: [i32; 3],
}

/// Side of the cells of a level, map units.
pub(super) fn side(level: i16) -> f64 {
    (f64::from(level) / STEPS_PER_OCTAVE).exp2()
}

impl Cell {
    /// Octave of the cell: within one, sizes differ by less than a factor of two.
    pub fn octave(&self) -> i16 {
        self.level.div_euclid(STEPS_PER_OCTAVE as i16)
    }

    /// The cell, of a size of at most `size`, that contains a position; `None` where either is out of range.
    pub fn of(position: [f64; 3], size: f64) -> Option<Self> {
        let level = (STEPS_PER_OCTAVE * size.log2()).floor();
        if !(level.abs() < 1000.0) {
            return None;
        }
        let level = level as i16;
        let side = side(level);
        let at = position.map(|c| (c / side).floor());
        at.iter()
            .all(|c| c.abs() < MAX_CELL_INDEX)
            .then(|| Self { level, at: at.map(|c| c as i32) })
    }
}

/// Sums over the points of a cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Gathered {
    /// The cell.
    pub cell: Cell,
    /// Weighted sum of positions, from the cell's corner, in sides of it.
    position: [f32; 3],
    grey: f32,
    weight: f32,
    /// Smallest standard deviation along the ray, map units.
    pub sigma: f32,
    /// Largest number of keyframes of any of its points.
    pub keyframes: u8,
    /// The point with the smallest standard deviation: index of its keyframe, and of the point there.
    pub best: (u32, u32),
}

impl Gathered {
    /// From one point, `sigma` in map units.
    pub fn new(
        cell: Cell,
        position: [f64; 3],
        grey: f32,
        sigma: f64,
        keyframes: u8,
        best: (u32, u32),
    ) -> Self {
        let side = side(cell.level);
        let weight = (side * side / (sigma * sigma)).min(1e9) as f32;
        let offset =
            std::array::from_fn(|c| (position[c] / side - f64::from(cell.at[c])) as f32 * weight);
        Self {
            cell,
            position: offset,
            grey: grey * weight,
            weight,
            sigma: sigma as f32,
            keyframes,
            best,
        }
    }

    fn add(&mut self, other: &Self) {
        for (sum, part) in self.position.iter_mut().zip(other.position) {
            *sum += part;
        }
        self.grey += other.grey;
        self.weight += other.weight;
        self.keyframes = self.keyframes.max(other.keyframes);
        if other.sigma < self.sigma {
            (self.sigma, self.best) = (other.sigma, other.best);
        }
    }

    /// Mean position, map units.
    pub fn position(&self) -> [f64; 3] {
        let side = side(self.cell.level);
        std::array::from_fn(|c| {
            (f64::from(self.cell.at[c]) + f64::from(self.position[c] / self.weight)) * side
        })
    }

    /// Mean brightness.
    pub fn grey(&self) -> u8 {
        (self.grey / self.weight).round() as u8
    }
}

/// One entry per cell, in order of the cells; the points of a cell are summed in their order of arrival.
pub(super) fn gathered(mut points: Vec<Gathered>) -> Vec<Gathered> {
    points.sort_by_key(|point| point.cell);
    points.dedup_by(|later, kept| {
        let is_same = later.cell == kept.cell;
        if is_same {
            kept.add(later);
        }
        is_same
    });
    points
}

/// Merges two lists; where both have a cell, the second's is added to the first's.
pub(super) fn merged(first: Vec<Gathered>, second: Vec<Gathered>) -> Vec<Gathered> {
    if first.is_empty() {
        return second;
    }
    let mut merged = Vec::with_capacity(first.len() + second.len());
    let (mut first, mut second) = (first.into_iter().peekable(), second.into_iter().peekable());
    while let (Some(a), Some(b)) = (first.peek_mut(), second.peek()) {
        let next = match a.cell.cmp(&b.cell) {
            Ordering::Less => first.next(),
            Ordering::Greater => second.next(),
            Ordering::Equal => {
                a.add(b);
                second.next();
                first.next()
            }
        };
        merged.extend(next);
    }
    merged.extend(first);
    merged.extend(second);
    merged
}
