//! Eight points side by side: the start processes all points in blocks of them.

/// Points per block.
pub const LANES: usize = 8;

/// One number for each point of a block.
pub type Lanes = [f32; LANES];

/// A function of each lane.
#[inline(always)]
pub fn lanes(value: impl Fn(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; LANES];
    for l in 0..LANES {
        lanes[l] = value(l);
    }
    lanes
}

/// The numbers of a block; `spare` where there is no point.
#[inline(always)]
pub fn lanes_of(values: &[f32], block: usize, spare: f32) -> Lanes {
    let rest = &values[(block * LANES).min(values.len())..];
    match rest.first_chunk::<LANES>() {
        Some(lanes) => *lanes,
        None => lanes(|l| rest.get(l).copied().unwrap_or(spare)),
    }
}

/// A sum over points: in f64, as differences of such sums must keep their digits, lanes l and l + 4 together, and
/// always in the same order.
#[derive(Debug, Clone, Copy, Default)]
pub struct LaneSum([f64; LANES / 2]);

impl LaneSum {
    /// Adds a block.
    #[inline(always)]
    pub fn add(&mut self, lanes: &Lanes) {
        for l in 0..LANES / 2 {
            self.0[l] += f64::from(lanes[l] + lanes[l + LANES / 2]);
        }
    }

    /// The sum.
    pub fn total(&self) -> f64 {
        (self.0[0] + self.0[2]) + (self.0[1] + self.0[3])
    }
}

/// Translation, rotation, a, b, slopes of the gain.
pub const NUM_UNKNOWNS: usize = 10;

/// Index of the first slope; without slopes, the number of unknowns.
pub const FIRST_SLOPE: usize = 8;

/// Entries of a symmetric matrix's lower triangle.
pub const NUM_TRIANGLE: usize = NUM_UNKNOWNS * (NUM_UNKNOWNS + 1) / 2;

/// Sums of a symmetric matrix and a vector of the unknowns of the pose and brightness.
#[derive(Debug, Clone)]
pub struct NormalSums {
    triangle: [LaneSum; NUM_TRIANGLE],
    vector: [LaneSum; NUM_UNKNOWNS],
}

impl Default for NormalSums {
    fn default() -> Self {
        Self {
            triangle: [LaneSum::default(); NUM_TRIANGLE],
            vector: [LaneSum::default(); NUM_UNKNOWNS],
        }
    }
}

impl NormalSums {
    /// Adds a block to the entry in row `r` and column `c` ≤ `r`.
    #[inline(always)]
    pub fn add_entry(&mut self, r: usize, c: usize, lanes: &Lanes) {
        self.triangle[r * (r + 1) / 2 + c].add(lanes);
    }

    /// Adds a block to entry `r` of the vector.
    #[inline(always)]
    pub fn add_row(&mut self, r: usize, lanes: &Lanes) {
        self.vector[r].add(lanes);
    }

    /// The sum in row `r` and column `c` ≤ `r`.
    pub fn entry(&self, r: usize, c: usize) -> f64 {
        self.triangle[r * (r + 1) / 2 + c].total()
    }

    /// The sum in row `r` of the vector.
    pub fn row(&self, r: usize) -> f64 {
        self.vector[r].total()
    }
}
