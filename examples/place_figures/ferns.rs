//! Random ferns (Glocker et al. 2015): each encodes a few bits of a small image; similar images share many codes.

use crate::footage::Footage;
use crate::methods::{Scores, busy_secs};

/// Ferns, tests per fern, and size of the small image.
const FERNS: usize = 500;
const TESTS: usize = 4;
const SIZE: [usize; 2] = [40, 30];

/// Tests: a pixel of the small image and a threshold.
pub struct Ferns(Vec<(usize, u8)>);

impl Ferns {
    /// Scores of all pairs.
    pub fn scores(footage: &Footage, queries: &[Vec<u8>]) -> Scores {
        let ferns = Self::new();
        let size = [footage.camera.width, footage.camera.height];
        let known: Vec<_> = footage.frames.iter().map(|f| ferns.codes(&f.pixels, size)).collect();
        let asking: Vec<_> = queries.iter().map(|q| ferns.codes(q, size)).collect();
        let began = busy_secs();
        let alike = |a: &[u8], b: &[u8]| {
            a.iter().zip(b).filter(|(a, b)| a == b).count() as f32 / FERNS as f32
        };
        let of = asking
            .iter()
            .map(|ours| known.iter().map(|theirs| alike(ours, theirs)).collect())
            .collect();
        let micros = 1e6 * (busy_secs() - began) / queries.len().max(1) as f64;
        Scores {
            of,
            candidates: Vec::new(),
            cost: format!("query {micros:.0} µs, {FERNS} B a keyframe"),
        }
    }

    fn new() -> Self {
        let mut state = 7u64;
        let mut below = move |limit: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 33) as usize % limit
        };
        Self((0..FERNS * TESTS).map(|_| (below(SIZE[0] * SIZE[1]), below(256) as u8)).collect())
    }

    /// Codes of an image whose brightness is stretched to the whole range, to compensate for exposure.
    fn codes(&self, pixels: &[u8], [width, height]: [usize; 2]) -> Vec<u8> {
        let mut small = Vec::with_capacity(SIZE[0] * SIZE[1]);
        for row in 0..SIZE[1] {
            for column in 0..SIZE[0] {
                let rows = row * height / SIZE[1]..(row + 1) * height / SIZE[1];
                let columns = column * width / SIZE[0]..(column + 1) * width / SIZE[0];
                let count = rows.len() * columns.len();
                let sum: usize = rows
                    .flat_map(|v| &pixels[v * width..][columns.clone()])
                    .map(|&grey| usize::from(grey))
                    .sum();
                small.push(sum as f32 / count as f32);
            }
        }
        let mean = small.iter().sum::<f32>() / small.len() as f32;
        let variance =
            small.iter().map(|g| (g - mean) * (g - mean)).sum::<f32>() / small.len() as f32;
        let stretched = |grey: f32| 127.5 + 60.0 * (grey - mean) / variance.sqrt().max(1.0);
        let bit =
            |(at, threshold): &(usize, u8)| u8::from(stretched(small[*at]) > f32::from(*threshold));
        let code = |tests: &[(usize, u8)]| tests.iter().fold(0, |code, test| code << 1 | bit(test));
        self.0.chunks_exact(TESTS).map(code).collect()
    }
}
