//! Pixels covered by more than one surface: the share of each, and the brightness of the whole.

use crate::capture::simulator::lens::{LANES, Ray};
use crate::capture::simulator::scene::Scene;
use crate::capture::simulator::shade::{FaceView, PIXEL_WIDTH, grey};
use crate::capture::simulator::view::{LocalView, NO_SURFACE, Nearest};
use crate::slam::kernel::{Floats, Instructions};

/// Side of the grid of rays cast through a pixel that an edge crosses.
const EDGE_GRID: usize = 4;
/// Rays of the grid.
const RAYS: usize = EDGE_GRID * EDGE_GRID;
/// Number of shares that makes sorting worthwhile.
const ENOUGH_SHARES: usize = 2048;

/// Offset of every ray of the grid in its pixel: to the right, and down.
const PLACES: [[f32; RAYS]; 2] = {
    const STEP: f32 = 1.0 / EDGE_GRID as f32;
    let mut places = [[0.0; RAYS]; 2];
    let mut i = 0;
    while i < RAYS {
        places[0][i] = PIXEL_WIDTH * (((i % EDGE_GRID) as f32 + 0.5) * STEP - 0.5);
        places[1][i] = PIXEL_WIDTH * (((i / EDGE_GRID) as f32 + 0.5) * STEP - 0.5);
        i += 1;
    }
    places
};

/// The part of a pixel that one surface covers.
#[derive(Debug, Clone, Copy)]
struct Share {
    surface: f32,
    /// Rays of the grid that meet it.
    count: f32,
    /// The centre of these, and their extent.
    ray: Ray,
    /// Index of the pixel in the image.
    pixel: usize,
}

/// Shares collected until there are enough: those of one surface are shaded together.
#[derive(Debug, Default)]
pub struct Shares {
    /// The shares of a pixel are consecutive.
    shares: Vec<Share>,
    /// Surface and index of each.
    order: Vec<(u32, u32)>,
    /// Brightness of each.
    greys: Vec<f32>,
}

impl Shares {
    /// Whether there are enough to add them to the image.
    pub fn are_enough(&self) -> bool {
        self.shares.len() >= ENOUGH_SHARES
    }

    /// Divides a pixel: a grid of rays counts each surface's share, testing the blocks of the surfaces `around`, which
    /// are those of the pixel and its neighbours.
    #[inline(always)]
    pub fn divide<I: Instructions>(
        &mut self,
        lanes: I,
        views: &[LocalView],
        around: [f32; 5],
        ray: &Ray,
        pixel: usize,
    ) {
        let (blocks, num_blocks) = blocks_of(&around);
        let mut seen = [lanes.splat(NO_SURFACE); RAYS / LANES];
        for part in 0..RAYS / LANES {
            let mut at = [lanes.splat(0.0); 2];
            for k in 0..2 {
                let [a, b] = [0, 1].map(|k| lanes.load(&PLACES[k][part * LANES..]));
                let [x, du, dv] = [ray.at[k], ray.du[k], ray.dv[k]].map(|x| lanes.splat(x));
                at[k] = x + a * du + b * dv;
            }
            let mut nearest = Nearest::nothing(lanes);
            for &block in &blocks[..num_blocks] {
                nearest = nearest.or_block(lanes, views, block, at);
            }
            seen[part] = nearest.surfaces(lanes, views, at);
        }
        let surfaces = seen.map(|part| part.to_array::<LANES>());
        let mut left: u32 = (1 << RAYS) - 1;
        while left != 0 {
            let first = left.trailing_zeros() as usize;
            let surface = surfaces[first / LANES][first % LANES];
            let mut here = 0;
            for (part, &seen) in seen.iter().enumerate() {
                here |= seen.equal(lanes.splat(surface)).bits() << (part * LANES);
            }
            left &= !here;
            self.shares.push(Share::of_rays(here, surface, ray, pixel));
        }
    }

    /// Adds `weight` × the mean brightness of every divided pixel to `out`; each share is sampled once, at its centre.
    #[inline(always)]
    pub fn add_to<I: Instructions>(
        &mut self,
        lanes: I,
        scene: &Scene,
        views: &[LocalView],
        weight: f32,
        out: &mut [f32],
    ) {
        self.shade(lanes, scene, views);
        let mut greys = self.greys.iter();
        for shares in self.shares.chunk_by(|a, b| a.pixel == b.pixel) {
            let mut sum = 0.0;
            for (share, grey) in shares.iter().zip(&mut greys) {
                sum += share.count * grey;
            }
            out[shares[0].pixel] += weight * (sum / RAYS as f32);
        }
        self.shares.clear();
    }

    #[inline(always)]
    fn shade<I: Instructions>(&mut self, lanes: I, scene: &Scene, views: &[LocalView]) {
        let Self { shares, order, greys } = self;
        order.clear();
        // One more than the surface's number, so that no surface comes first.
        let numbered = shares.iter().zip(0..);
        order.extend(numbered.map(|(share, i)| ((share.surface + 1.0) as u32, i)));
        order.sort_unstable();
        greys.resize(shares.len(), 0.0);
        for alike in order.chunk_by(|a, b| a.0 == b.0) {
            let face = FaceView::new(scene, views, alike[0].0 as f32 - 1.0);
            for some in alike.chunks(LANES) {
                let ray = together(lanes, shares, some);
                let values = grey(lanes, face.as_ref(), some.len(), &ray).to_array::<LANES>();
                for (&(_, i), value) in some.iter().zip(values) {
                    greys[i as usize] = value;
                }
            }
        }
    }
}

impl Share {
    /// The part of a pixel covered by the grid rays whose bits are set.
    #[inline(always)]
    fn of_rays(mut bits: u32, surface: f32, ray: &Ray, pixel: usize) -> Self {
        let count = bits.count_ones() as f32;
        let (mut a, mut b) = (0.0, 0.0);
        while bits != 0 {
            let i = bits.trailing_zeros() as usize;
            a += PLACES[0][i];
            b += PLACES[1][i];
            bits &= bits - 1;
        }
        let side = (count / RAYS as f32).sqrt();
        let at = ray.shifted(a / count, b / count);
        let ray = Ray { at, du: ray.du.map(|d| side * d), dv: ray.dv.map(|d| side * d) };
        Self { surface, count, ray, pixel }
    }
}

/// The rays of some shares; if there are fewer than [`LANES`], the last one fills the rest.
#[inline(always)]
fn together<I: Instructions>(lanes: I, shares: &[Share], some: &[(u32, u32)]) -> Ray<Floats<I>> {
    let mut numbers = [[0.0; LANES]; 6];
    for lane in 0..LANES {
        let Ray { at, du, dv } = shares[some[lane.min(some.len() - 1)].1 as usize].ray;
        for (numbers, number) in numbers.iter_mut().zip([at, du, dv].as_flattened()) {
            numbers[lane] = *number;
        }
    }
    let [x, y, du_x, du_y, dv_x, dv_y] = numbers.map(|numbers| lanes.load(&numbers));
    Ray { at: [x, y], du: [du_x, du_y], dv: [dv_x, dv_y] }
}

/// The distinct blocks of some surfaces, and their number.
#[inline(always)]
fn blocks_of(around: &[f32; 5]) -> ([u32; 5], usize) {
    let (mut blocks, mut count) = ([0; 5], 0);
    for &surface in around.iter().filter(|&&surface| surface != NO_SURFACE) {
        let block = surface as u32 >> 3;
        if !blocks[..count].contains(&block) {
            blocks[count] = block;
            count += 1;
        }
    }
    (blocks, count)
}
