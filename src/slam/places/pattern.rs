//! The pairs of pixels that a descriptor compares, rotated with the feature (Calonder et al. 2010; Rublee et al. 2011).

/// Comparisons of a descriptor: its bits.
pub(super) const BITS: usize = 256;
/// Words of 64 bits that hold them.
pub const WORDS: usize = BITS / 64;
/// Orientations per turn, 11° each: a comparison tolerates half of that.
pub(super) const ORIENTATIONS: usize = 32;
/// Largest distance of a comparison's pixel from the feature, pixels, in any orientation.
pub(super) const RADIUS_PX: i32 = 15;

/// Two pixels relative to the feature: columns and rows.
pub(super) type Pair = [[i8; 2]; 2];

/// The pairs for every orientation.
#[derive(Debug, Clone)]
pub(super) struct Pattern(Vec<Pair>);

impl Default for Pattern {
    fn default() -> Self {
        let upright = upright();
        let turned = |k: usize| {
            let (sin, cos) = angle_rad(k).sin_cos();
            let turn = move |[x, y]: [f64; 2]| {
                [(cos * x - sin * y).round() as i8, (sin * x + cos * y).round() as i8]
            };
            upright.iter().map(move |pair| pair.map(turn))
        };
        Self((0..ORIENTATIONS).flat_map(turned).collect())
    }
}

impl Pattern {
    /// The pairs for an orientation.
    pub(super) fn turned(&self, orientation: u8) -> &[Pair] {
        let begin = BITS * (usize::from(orientation) % ORIENTATIONS);
        &self.0[begin..begin + BITS]
    }
}

/// The angle of an orientation.
pub(super) fn angle_rad(orientation: usize) -> f64 {
    std::f64::consts::TAU * orientation as f64 / ORIENTATIONS as f64
}

/// Pairs scattered around the feature as is best without training (Calonder et al. 2010, G II), drawn once for all.
fn upright() -> Vec<[[f64; 2]; 2]> {
    /// Standard deviation of either coordinate: a fifth of the patch.
    const SCATTER_PX: f64 = 6.2;
    /// Shorter pairs measure noise.
    const MIN_LENGTH_PX: f64 = 4.0;
    let mut state = 1u64;
    let mut uniform = move || {
        // SplitMix64 (Steele, Lea, Flood 2014).
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    // Twelve uniform numbers have a variance of one.
    let mut coordinate = move || SCATTER_PX * ((0..12).map(|_| uniform()).sum::<f64>() - 6.0);
    let mut pairs = Vec::with_capacity(BITS);
    while pairs.len() < BITS {
        let [a, b] = std::array::from_fn(|_| [coordinate(), coordinate()]);
        let is_inside = |[x, y]: [f64; 2]| x.hypot(y) <= f64::from(RADIUS_PX) - 0.5;
        if is_inside(a) && is_inside(b) && (a[0] - b[0]).hypot(a[1] - b[1]) >= MIN_LENGTH_PX {
            pairs.push([a, b]);
        }
    }
    pairs
}
