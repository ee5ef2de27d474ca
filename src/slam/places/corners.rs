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
    /// How much the circle differs, grey levels beyond the threshold, summed up.
    pub(super) strength: u32,
}

/// Finds corners; owns the memory for that.
#[derive(Debug, Clone, Default)]
pub(super) struct CornerFinder {
    strengths: Vec<u16>,
}

impl CornerFinder {
    /// Corners at least `margin` (3 or more) pixels from the edges, row after row, none beside a stronger one.
    pub(super) fn find(
        &mut self,
        pixels: &[u8],
        width: usize,
        height: usize,
        margin: usize,
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
        for v in margin..height - margin {
            for at in v * width + margin..(v + 1) * width - margin {
                self.strengths[at] = strength(pixels, at, &offsets, width);
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

/// 0 where there is no corner: nine pixels of the circle in a row all brighter or all darker.
#[inline(always)]
fn strength(pixels: &[u8], at: usize, offsets: &[isize; 16], width: usize) -> u16 {
    /// Grey levels, beyond the noise of a small sensor; the strongest are taken.
    const THRESHOLD: i32 = 8;
    let centre = i32::from(pixels[at]);
    let (low, high) = (centre - THRESHOLD, centre + THRESHOLD);
    // Any nine in a row hold two of four that are a quarter apart.
    let quarters = [at - 3 * width, at + 3, at + 3 * width, at - 3].map(|k| i32::from(pixels[k]));
    let brighter = quarters.iter().filter(|&&grey| grey > high).count();
    let darker = quarters.iter().filter(|&&grey| grey < low).count();
    if brighter < 2 && darker < 2 {
        return 0;
    }
    let (mut brighter, mut darker) = (0u32, 0u32);
    let (mut above, mut below) = (0i32, 0i32);
    for (k, offset) in offsets.iter().enumerate() {
        let grey = i32::from(pixels[at.wrapping_add_signed(*offset)]);
        if grey > high {
            brighter |= 1 << k;
            above += grey - high;
        } else if grey < low {
            darker |= 1 << k;
            below += low - grey;
        }
    }
    match (has_nine(brighter), has_nine(darker)) {
        (true, _) => above as u16 + 1,
        (_, true) => below as u16 + 1,
        _ => 0,
    }
}

/// Whether nine of the sixteen bits, which close a circle, are set in a row.
fn has_nine(bits: u32) -> bool {
    let around = bits | bits << 16;
    let two = around & around >> 1;
    let four = two & two >> 2;
    let eight = four & four >> 4;
    eight & around >> 8 != 0
}
