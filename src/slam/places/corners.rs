//! Corners of an image (FAST; Rosten, Drummond 2006).

/// Pixels of the circle around a corner, columns and rows, in order.
const CIRCLE: [[i32; 2]; 16] = [
    [0, -3],
    [1, -3],
    [2, -2],
    [3, -1],
    [3, 0],
    [3, 1],
    [2, 2],
    [1, 3],
    [0, 3],
    [-1, 3],
    [-2, 2],
    [-3, 1],
    [-3, 0],
    [-3, -1],
    [-2, -2],
    [-1, -3],
];

/// A corner of one level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Corner {
    pub(super) u: u16,
    pub(super) v: u16,
    /// Sum of the differences of the circle beyond the threshold, grey levels.
    pub(super) strength: u32,
}

/// Finds corners; owns the memory for that.
#[derive(Debug, Clone, Default)]
pub(super) struct CornerFinder {
    strengths: Vec<u16>,
    /// For the pixels of a row, whether they can be corners, and scratch for that.
    may_be: [Vec<u8>; 2],
}

impl CornerFinder {
    /// Finds corners at least `margin` (3 or more) pixels from the edges, whose circle differs by more than `threshold`
    /// grey levels, row by row, none next to a stronger one.
    pub(super) fn find(
        &mut self,
        pixels: &[u8],
        width: usize,
        height: usize,
        margin: usize,
        threshold: u8,
        found: &mut Vec<Corner>,
    ) {
        found.clear();
        if margin < 3
            || width <= 2 * margin
            || height <= 2 * margin
            || pixels.len() != width * height
        {
            return;
        }
        let offsets = CIRCLE.map(|[x, y]| y as isize * width as isize + x as isize);
        self.strengths.clear();
        self.strengths.resize(width * height, 0);
        let inner = width - 2 * margin;
        self.may_be.iter_mut().for_each(|marks| marks.resize(inner, 0));
        for v in margin..height - margin {
            let begin = v * width + margin;
            mark(pixels, begin, &offsets, threshold, &mut self.may_be);
            for (k, may_be) in self.may_be[0].iter().enumerate() {
                if *may_be != 0 {
                    self.strengths[begin + k] = strength(pixels, begin + k, &offsets, threshold);
                }
            }
        }
        let strengths = &self.strengths;
        for v in margin..height - margin {
            for at in v * width + margin..(v + 1) * width - margin {
                let strength = strengths[at];
                if strength == 0 {
                    continue;
                }
                // Of equals the first.
                let before = [at - width - 1, at - width, at - width + 1, at - 1];
                let after = [at + 1, at + width - 1, at + width, at + width + 1];
                if before.iter().all(|&k| strengths[k] < strength)
                    && after.iter().all(|&k| strengths[k] <= strength)
                {
                    let (u, v) = ((at - v * width) as u16, v as u16);
                    found.push(Corner { u, v, strength: u32::from(strength) });
                }
            }
        }
    }
}

/// Marks the pixels of a row, from `at` on, that can be corners: any nine consecutive ones of the circle contain one of
/// any two opposite ones.
fn mark(
    pixels: &[u8],
    at: usize,
    offsets: &[isize; 16],
    threshold: u8,
    [low, high]: &mut [Vec<u8>; 2],
) {
    let count = low.len();
    low.fill(u8::MAX);
    high.fill(0);
    let row = |offset: isize| &pixels[at.wrapping_add_signed(offset)..][..count];
    for (one, other) in offsets[..8].iter().zip(&offsets[8..]) {
        let facing = row(*one).iter().zip(row(*other));
        // The minimum over all pairs of the brighter pixel, and the maximum of the darker one.
        for ((low, high), (a, b)) in low.iter_mut().zip(high.iter_mut()).zip(facing) {
            *low = (*low).min(*a.max(b));
            *high = (*high).max(*a.min(b));
        }
    }
    for ((low, high), centre) in low.iter_mut().zip(high).zip(row(0)) {
        let is_brighter = *low > centre.saturating_add(threshold);
        let is_darker = *high < centre.saturating_sub(threshold);
        *low = u8::from(is_brighter | is_darker);
    }
}

/// 0 where there is no corner: nine consecutive pixels of the circle that are all brighter or all darker.
#[inline(always)]
fn strength(pixels: &[u8], at: usize, offsets: &[isize; 16], threshold: u8) -> u16 {
    let circle = offsets.map(|offset| pixels[at.wrapping_add_signed(offset)]);
    let centre = pixels[at];
    let (low, high) = (centre.saturating_sub(threshold), centre.saturating_add(threshold));
    let above = circle.map(|grey| grey.saturating_sub(high));
    let below = circle.map(|grey| low.saturating_sub(grey));
    let sum = |of: [u8; 16]| of.iter().map(|&grey| u16::from(grey)).sum();
    match (has_nine(&above), has_nine(&below)) {
        (true, _) => sum(above),
        (_, true) => sum(below),
        _ => 0,
    }
}

/// Whether nine consecutive ones of the sixteen, which form a circle, are not 0.
#[inline(always)]
fn has_nine(around: &[u8; 16]) -> bool {
    let bits = (0..16).fold(0u32, |bits, k| bits | u32::from(around[k] != 0) << k);
    let around = bits | bits << 16;
    let two = around & around >> 1;
    let four = two & two >> 2;
    let eight = four & four >> 4;
    eight & around >> 8 != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [60, 50];

    fn corners(pixels: &[u8], margin: usize) -> Vec<[u16; 2]> {
        let mut found = Vec::new();
        CornerFinder::default().find(pixels, SIZE[0], SIZE[1], margin, 20, &mut found);
        found.iter().map(|corner| [corner.u, corner.v]).collect()
    }

    /// A square of `inside` from column 20, row 15 to 39, 34.
    fn square(inside: u8, outside: u8) -> Vec<u8> {
        let is_inside =
            |k: usize| (20..40).contains(&(k % SIZE[0])) && (15..35).contains(&(k / SIZE[0]));
        (0..SIZE[0] * SIZE[1]).map(|k| if is_inside(k) { inside } else { outside }).collect()
    }

    #[test]
    fn a_square_has_four_corners_bright_or_dark() {
        for (inside, outside) in [(200, 100), (100, 200)] {
            let found = corners(&square(inside, outside), 3);
            assert_eq!(found.len(), 4, "{found:?}");
            for corner in [[20, 15], [39, 15], [20, 34], [39, 34]] {
                let is_near =
                    |at: &[u16; 2]| at[0].abs_diff(corner[0]).max(at[1].abs_diff(corner[1])) <= 1;
                assert!(found.iter().any(is_near), "{corner:?} of {found:?}");
            }
        }
        assert!(corners(&square(110, 100), 3).is_empty(), "below the threshold");
    }

    #[test]
    fn margins_and_sizes_are_respected() {
        let square = square(200, 100);
        assert_eq!(corners(&square, 14).len(), 4);
        assert!(corners(&square, 20).is_empty(), "the corners are beside it");
        assert!(corners(&square, 25).is_empty());
        assert!(corners(&square[1..], 3).is_empty());
    }
}
