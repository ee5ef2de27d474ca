//! Cost of place recognition: `cargo bench --bench places`, on keyframes that each show a different collage.

use std::hint::black_box;
use std::time::Instant;

use semidense::slam::places::{Describer, Description, PlaceIndex};

const SIZE: [usize; 2] = [640, 480];
/// Keyframes that are looked up.
const QUERIES: usize = 100;

fn main() {
    println!("keyframes: describe, insert, query (median, worst) ms; B a keyframe");
    let (mut describer, mut index) = (Describer::default(), PlaceIndex::default());
    let mut known: Vec<Description> = Vec::new();
    let [mut describing, mut inserting] = [0.0f64; 2];
    for keyframe in 0..10_000u64 {
        let pixels = collage(keyframe, 0);
        let began = Instant::now();
        let description =
            describer.describe(&pixels, SIZE[0], SIZE[1]).expect("it shows something");
        describing += began.elapsed().as_secs_f64();
        let began = Instant::now();
        index.insert(keyframe, &description);
        inserting += began.elapsed().as_secs_f64();
        if known.len() < QUERIES {
            let pixels = collage(keyframe, 3);
            known.extend(describer.describe(&pixels, SIZE[0], SIZE[1]));
        }
        let count = keyframe + 1;
        if [100, 1_000, 10_000].contains(&count) {
            let millis = |seconds: f64| 1e3 * seconds / count as f64;
            let [median, worst] = query(&index, &known);
            println!(
                "{count}: {:.2}, {:.3}, {median:.2}, {worst:.2}; {}",
                millis(describing),
                millis(inserting),
                index.bytes() / count as usize
            );
        }
    }
}

/// Median and worst time of a query, milliseconds.
fn query(index: &PlaceIndex, known: &[Description]) -> [f64; 2] {
    let mut millis: Vec<f64> = Vec::new();
    for (id, description) in (0..).zip(known) {
        let began = Instant::now();
        let found = black_box(index.candidates(description, 10, |_| false));
        millis.push(1e3 * began.elapsed().as_secs_f64());
        assert_eq!(found.first().map(|best| best.keyframe_id), Some(id), "a place is not found");
    }
    millis.sort_by(f64::total_cmp);
    [millis[millis.len() / 2], millis[millis.len() - 1]]
}

/// Rectangles of all grey levels and sizes, shifted by `moved` pixels.
fn collage(seed: u64, moved: usize) -> Vec<u8> {
    const RECTANGLES: usize = 400;
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut below = |limit: usize| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 20) as usize % limit
    };
    let mut pixels = vec![128; SIZE[0] * SIZE[1]];
    for _ in 0..RECTANGLES {
        let [u, v] = [below(SIZE[0]) + moved, below(SIZE[1]) + moved];
        let [width, height] = [8 + below(60), 8 + below(60)];
        let grey = below(256) as u8;
        for row in v..(v + height).min(SIZE[1]) {
            let right = (u + width).min(SIZE[0]);
            if u < right {
                pixels[row * SIZE[0] + u..row * SIZE[0] + right].fill(grey);
            }
        }
    }
    pixels
}
