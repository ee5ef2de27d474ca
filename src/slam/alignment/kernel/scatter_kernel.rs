//! The gradient of the cost by image tile and its change with common errors of depth, for any instruction set:
//! `GradientScatter::reference` in lanes.
//!
//! The whitened columns suffice: √w J · √w r is a point's gradient, √w · √w its weight, and its Huber weight is 1 where
//! (√w r)² ≤ k². Points lie row by row, so that a block covers a few tiles in runs of lanes: each run adds its
//! products, lane by lane, to the sums of its tile.

use crate::slam::alignment::kernel::accumulate_kernel::{
    CHUNK_BLOCKS, RESIDUAL, Statistics, Whitened, whiten,
};
use crate::slam::alignment::kernel::mode_kernel::{ModeSums, add_modes};
use crate::slam::alignment::normal_equations::UNKNOWNS;
use crate::slam::alignment::points::{LANES, LevelPoints, TileRun};
use crate::slam::alignment::residual::Evaluation;
use crate::slam::alignment::scatter::{GradientScatter, ScatterSums};
use crate::slam::alignment::tiles::NUM_TILES;
use crate::slam::image::buffer::Image;
use crate::slam::kernel::{Body, Floats, Instructions};

/// The columns of the rotations about x and y.
const ABOUT_X: usize = 3;
const ABOUT_Y: usize = 4;

/// The column of −√w: the derivative with respect to the offset is −1.
const WEIGHT: usize = 7;

/// Sums of one tile, lane by lane; with an instruction set of fewer lanes the rest stays zero.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct TileSums {
    gradient: [[f32; LANES]; UNKNOWNS],
    weight: [f32; LANES],
    information: [[f32; LANES]; 3],
}

impl TileSums {
    const ZERO: Self = Self {
        gradient: [[0.0; LANES]; UNKNOWNS],
        weight: [0.0; LANES],
        information: [[0.0; LANES]; 3],
    };
}

/// Mask of a run, read at an offset: sixteen zeros, sixteen ones, sixteen zeros.
static ONES: [f32; 3 * LANES] = {
    let mut ones = [0.0; 3 * LANES];
    let mut lane = LANES;
    while lane < 2 * LANES {
        ones[lane] = 1.0;
        lane += 1;
    }
    ones
};

/// The input of `Kernel::scatter`.
pub struct Scattering<'a> {
    pub points: &'a LevelPoints,
    pub image: &'a Image<u16>,
    pub at: &'a Evaluation,
}

impl Body for Scattering<'_> {
    type Output = GradientScatter;

    #[inline(always)]
    fn run<I: Instructions>(self, lanes: I) -> GradientScatter {
        let Self { points, image, at } = self;
        let mut columns = [Whitened::ZERO; CHUNK_BLOCKS];
        let mut tiles = [TileSums::ZERO; NUM_TILES];
        let mut sums = ScatterSums::default();
        let mut mode_sums = ModeSums::ZERO;
        let mut logs = points.log_inverse_depths();
        let mut runs = points.runs();
        let mut statistics = Statistics::zero(lanes.splat(0.0));
        let mut quadratic = lanes.splat(0.0);
        for (chunk, blocks) in points.blocks().chunks(CHUNK_BLOCKS).enumerate() {
            for (block, whitened) in blocks.iter().zip(&mut columns) {
                for lane in (0..LANES).step_by(I::N) {
                    whiten(lanes, block, lane, image, at, whitened, &mut statistics);
                    quadratic = quadratic + quadratic_weight(lanes, whitened, lane, at.huber);
                }
            }
            let (chunk_logs, later_logs) = logs.split_at(blocks.len().min(logs.len()));
            logs = later_logs;
            add_modes(lanes, blocks, chunk_logs, &columns, at.translation, &mut mode_sums);
            let first_block = chunk * CHUNK_BLOCKS;
            let is_here = |run: &TileRun| (run.block as usize) < first_block + blocks.len();
            let (here, rest) = runs.split_at(runs.partition_point(is_here));
            runs = rest;
            for run in here {
                let Some(tile) = tiles.get_mut(usize::from(run.tile)) else { continue };
                add_run(lanes, &columns[run.block as usize - first_block], run, tile);
            }
        }
        sums.quadratic = total(&quadratic.to_array());
        for (tile, sums) in tiles.iter().zip(&mut sums.tiles) {
            sums.weight = total(&tile.weight);
            if sums.weight > 0.0 {
                sums.gradient = std::array::from_fn(|i| total(&tile.gradient[i]));
                sums.information = std::array::from_fn(|i| total(&tile.information[i]));
            }
        }
        sums.d_gradient_d_modes = mode_sums.total();
        GradientScatter::from_sums(&sums)
    }
}

/// The weights of the points whose Huber weight is 1.
#[inline(always)]
fn quadratic_weight<I: Instructions>(
    lanes: I,
    whitened: &Whitened,
    lane: usize,
    huber: f32,
) -> Floats<I> {
    let root = lanes.load(&whitened.0[WEIGHT][lane..]);
    let residual = lanes.load(&whitened.0[RESIDUAL][lane..]);
    let is_within = lanes.splat(huber * huber).at_least(residual * residual);
    is_within.select(root * root, lanes.splat(0.0))
}

/// Adds the products of the lanes of `run`, whose block is `whitened`.
#[inline(always)]
fn add_run<I: Instructions>(lanes: I, whitened: &Whitened, run: &TileRun, tile: &mut TileSums) {
    let (first, end) = (usize::from(run.first).min(LANES), usize::from(run.end).min(LANES));
    for lane in (first - first % I::N..end).step_by(I::N) {
        let column = |index: usize| lanes.load(&whitened.0[index][lane..]);
        // One from the first lane on, and one before the end.
        let from_first = lanes.load(&ONES[LANES + lane - first..]);
        let before_end = lanes.load(&ONES[2 * LANES + lane - end..]);
        let mask = from_first * before_end;
        let residual = column(RESIDUAL) * mask;
        let root = column(WEIGHT);
        for (index, sum) in tile.gradient.iter_mut().enumerate() {
            column(index).mul_add(residual, lanes.load(sum)).store(sum);
        }
        let (about_x, about_y) = (column(ABOUT_X), column(ABOUT_Y));
        let factors = [(about_x, about_x), (about_x, about_y), (about_y, about_y)];
        for ((one, other), sum) in factors.into_iter().zip(&mut tile.information) {
            (one * mask).mul_add(other, lanes.load(sum)).store(sum);
        }
        let sum = &mut tile.weight;
        (root * mask).mul_add(root, lanes.load(sum)).store(sum);
    }
}

/// The sum of all lanes, by repeated halving: the same order on every CPU.
#[inline(always)]
fn total(lanes: &[f32; LANES]) -> f32 {
    let eight: [f32; 8] = std::array::from_fn(|lane| lanes[lane] + lanes[lane + 8]);
    let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}
