//! The loop over points for any instruction set: `residual::accumulate_reference` in lanes.
//!
//! Points are processed in chunks that stay in the L1 cache. A first pass writes the columns of the whitened Jacobian
//! √w J and residual √w r for each point; then five passes sum their products with at most eleven sums each, as many as
//! sixteen registers hold without spilling.

use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS};
use crate::slam::alignment::points::{LANES, LevelPoints, PointBlock};
use crate::slam::alignment::residual::{
    BORDER_PX, Evaluation, NEAREST_DEPTH_RATIO, SMALLEST_DETERMINANT, UNCLIPPED_GREY,
};
use crate::slam::image::buffer::Image;
use crate::slam::kernel::lanes_kernel::{Lanes, Mask, Register, Sample};
use crate::slam::kernel::{Body, Floats, Instructions};

/// Blocks per chunk: its columns take 10 kB, a third of a small L1 cache.
pub const CHUNK_BLOCKS: usize = 16;

/// Columns: eight of the Jacobian, the residual.
const COLUMNS: usize = UNKNOWNS + 1;
pub const RESIDUAL: usize = UNKNOWNS;

/// The columns of one block of points.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Whitened(pub [[f32; LANES]; COLUMNS]);

impl Whitened {
    pub const ZERO: Self = Self([[0.0; LANES]; COLUMNS]);
}

/// Sums of products of columns, the upper triangle of JᵀWJ and JᵀWr, lane by lane; `[i][j]`, where j > 7 is the
/// residual.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Sums([[[f32; LANES]; COLUMNS]; UNKNOWNS]);

/// Sums that are not products of columns.
pub struct Statistics<R> {
    energy: Lanes<R>,
    squared_residual: Lanes<R>,
    in_view: u32,
    compared: u32,
    inliers: u32,
}

impl<R: Register> Statistics<R> {
    #[inline(always)]
    pub fn zero(zero: Lanes<R>) -> Self {
        Self { energy: zero, squared_residual: zero, in_view: 0, compared: 0, inliers: 0 }
    }

    /// Counts the compared residuals; returns their weights, including Huber's. `own` is the variance that inliers are
    /// measured by.
    #[inline(always)]
    fn weigh<I: Instructions<Register = R>>(
        &mut self,
        lanes: I,
        at: &Evaluation,
        r: Lanes<R>,
        [variance, own]: [Lanes<R>; 2],
        is_compared: Mask<R>,
    ) -> Lanes<R> {
        let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
        let squared = r * r;
        let information = one / variance;
        let normalized = squared * information;
        let huber = (lanes.splat(at.huber) / normalized.sqrt()).min(one);
        let inlier = (lanes.splat(at.inlier_gate_squared) * own).greater(squared);
        self.compared += is_compared.count();
        self.inliers += (is_compared & inlier).count();
        let energy = huber * (lanes.splat(2.0) - huber) * normalized;
        self.energy = self.energy + is_compared.select(energy, zero);
        self.squared_residual = self.squared_residual + is_compared.select(squared, zero);
        is_compared.select(huber * information, zero)
    }
}

/// The input of `Kernel::accumulate`.
pub struct Accumulation<'a> {
    pub points: &'a LevelPoints,
    pub image: &'a Image<u16>,
    pub at: &'a Evaluation,
}

impl Body for Accumulation<'_> {
    type Output = NormalEquations;

    #[inline(always)]
    fn run<I: Instructions>(self, lanes: I) -> NormalEquations {
        let Self { points, image, at } = self;
        let mut columns = [Whitened::ZERO; CHUNK_BLOCKS];
        let mut sums = Sums([[[0.0; LANES]; COLUMNS]; UNKNOWNS]);
        let mut statistics = Statistics::zero(lanes.splat(0.0));
        for blocks in points.blocks().chunks(CHUNK_BLOCKS) {
            for (block, whitened) in blocks.iter().zip(&mut columns) {
                for lane in (0..LANES).step_by(I::N) {
                    whiten(lanes, block, lane, image, at, whitened, &mut statistics);
                }
            }
            let columns = &columns[..blocks.len()];
            sum_rows_0_and_1(lanes, columns, &mut sums);
            sum_rows_2_to_5(lanes, columns, &mut sums);
            sum_column::<I, 6>(lanes, columns, &mut sums);
            sum_column::<I, 7>(lanes, columns, &mut sums);
            sum_gradient(lanes, columns, &mut sums);
        }
        finish(&sums, &statistics)
    }
}

/// Residual, weight and Jacobian of `I::N` points, with the same formulas and steps as `residual::point_terms`.
#[inline(always)]
pub fn whiten<I: Instructions>(
    lanes: I,
    block: &PointBlock,
    lane: usize,
    image: &Image<u16>,
    at: &Evaluation,
    whitened: &mut Whitened,
    statistics: &mut Statistics<I::Register>,
) {
    let load = |column: &[f32; LANES]| lanes.load(&column[lane..]);
    let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
    let (u, v, in_image) = project(lanes, block, lane, at);
    let pixels = Lanes::sample(image.pixels(), image.width(), u, v);
    let in_view = in_image & pixels.has_data().greater(zero);
    let value = interpolate(&pixels) * lanes.splat(at.grey_per_sum);
    let predicted = load(&block.intensity) * lanes.splat(at.gain);
    let residual = value - (predicted + lanes.splat(at.offset));
    // At the limits of the sensor, a residual pointing beyond the limit carries no information.
    let [darkest, lightest] = UNCLIPPED_GREY.map(|grey| lanes.splat(grey));
    let within = value.greater(lightest).select(residual, one);
    let within = darkest.greater(value).select(zero - residual, within);
    let is_compared = in_view & within.at_least(zero);

    let Surface { ax, ay, nx, ny, inverse_ratio } = Surface::of(lanes, block, lane, at);
    let m = ax.mul_add(nx, ay * ny);
    let [wx, wy, wz] = at.variance_translation.map(|value| lanes.splat(value));
    let weighing = ax.mul_add(wx, ay.mul_add(wy, (zero - m) * wz)) * inverse_ratio;
    let (squared, d) = (weighing * weighing, load(&block.inverse_depth));
    let from_depth = squared * load(&block.variance);
    let factor = lanes.splat(at.depth_variance_factor);
    let own = from_depth.mul_add(factor, lanes.splat(at.intensity_variance));
    let variance = (squared * (d * d)).mul_add(lanes.splat(at.common_variance_factor), own);
    statistics.in_view += in_view.count();
    let root = statistics.weigh(lanes, at, residual, [variance, own], is_compared).sqrt();

    let translation = load(&block.surrounding_inverse_depth) * inverse_ratio;
    let columns = [
        translation * ax,
        translation * ay,
        (zero - translation) * m,
        zero - ny.mul_add(m, ay),
        nx.mul_add(m, ax),
        nx * ay - ny * ax,
        zero - predicted,
        lanes.splat(-1.0),
        residual,
    ];
    for (column, whitened) in columns.into_iter().zip(&mut whitened.0) {
        (column * root).store(&mut whitened[lane..]);
    }
}

/// X̃ of points at inverse depth `d`.
#[inline(always)]
fn warp<I: Instructions>(
    lanes: I,
    block: &PointBlock,
    lane: usize,
    at: &Evaluation,
    d: Floats<I>,
) -> [Floats<I>; 3] {
    let [r0, r1, r2, r3, r4, r5, r6, r7, r8] = at.rotation.map(|value| lanes.splat(value));
    let [tx, ty, tz] = at.translation.map(|value| lanes.splat(value));
    let (x, y) = (lanes.load(&block.ray_x[lane..]), lanes.load(&block.ray_y[lane..]));
    [
        r0.mul_add(x, r1.mul_add(y, tx.mul_add(d, r2))),
        r3.mul_add(x, r4.mul_add(y, ty.mul_add(d, r5))),
        r6.mul_add(x, r7.mul_add(y, tz.mul_add(d, r8))),
    ]
}

/// Projections of points, and which of them are in view; the others are put on the border.
#[inline(always)]
fn project<I: Instructions>(
    lanes: I,
    block: &PointBlock,
    lane: usize,
    at: &Evaluation,
) -> (Floats<I>, Floats<I>, Mask<I::Register>) {
    let [fx, fy] = at.focal.map(|f| lanes.splat(f));
    let [cx, cy] = at.centre.map(|c| lanes.splat(c));
    let d = lanes.load(&block.inverse_depth[lane..]);
    let [warped_x, warped_y, depth_ratio] = warp(lanes, block, lane, at, d);
    let in_front = depth_ratio.greater(lanes.splat(NEAREST_DEPTH_RATIO));
    // Lanes out of view continue with finite numbers: 0 · NaN would be NaN.
    let depth_ratio = in_front.select(depth_ratio, lanes.splat(1.0));
    let inverse_ratio = lanes.splat(1.0) / depth_ratio;
    let (nx, ny) = (warped_x * inverse_ratio, warped_y * inverse_ratio);
    let (u, v) = (fx.mul_add(nx, cx), fy.mul_add(ny, cy));
    let border = lanes.splat(BORDER_PX);
    let inside =
        |value: Floats<I>, bound| value.at_least(border) & lanes.splat(bound).greater(value);
    let in_view = in_front & inside(u, at.upper_bound[0]) & inside(v, at.upper_bound[1]);
    (in_view.select(u, border), in_view.select(v, border), in_view)
}

/// Bilinear sample of the image.
#[inline(always)]
fn interpolate<R: Register>(pixels: &Sample<R>) -> Lanes<R> {
    let above = (pixels.upper_right - pixels.upper_left).mul_add(pixels.du, pixels.upper_left);
    let below = (pixels.lower_right - pixels.lower_left).mul_add(pixels.du, pixels.lower_left);
    (below - above).mul_add(pixels.dv, above)
}

/// The surface around points as seen in the frame: its gradient, n and 1/z̃.
struct Surface<R> {
    ax: Lanes<R>,
    ay: Lanes<R>,
    nx: Lanes<R>,
    ny: Lanes<R>,
    inverse_ratio: Lanes<R>,
}

impl<R: Register> Surface<R> {
    #[inline(always)]
    fn of<I: Instructions<Register = R>>(
        lanes: I,
        block: &PointBlock,
        lane: usize,
        at: &Evaluation,
    ) -> Self {
        let load = |column: &[f32; LANES]| lanes.load(&column[lane..]);
        let [r0, r1, _, r3, r4, _, r6, r7, _] = at.rotation.map(|value| lanes.splat(value));
        let [fx, fy] = at.focal.map(|f| lanes.splat(f));
        let d = load(&block.surrounding_inverse_depth);
        let [warped_x, warped_y, depth_ratio] = warp(lanes, block, lane, at, d);
        let depth_ratio = depth_ratio.max(lanes.splat(NEAREST_DEPTH_RATIO));
        let inverse_ratio = lanes.splat(1.0) / depth_ratio;
        let (nx, ny) = (warped_x * inverse_ratio, warped_y * inverse_ratio);
        let (m11, m12) = (r0 - nx * r6, r1 - nx * r7);
        let (m21, m22) = (r3 - ny * r6, r4 - ny * r7);
        let determinant = (m11 * m22 - m12 * m21).max(lanes.splat(SMALLEST_DETERMINANT));
        let scale = depth_ratio * lanes.splat(at.gain) / determinant;
        let keyframe_x = load(&block.gradient_x) * fx * scale;
        let keyframe_y = load(&block.gradient_y) * fy * scale;
        let ax = m22 * keyframe_x - m21 * keyframe_y;
        let ay = m11 * keyframe_y - m12 * keyframe_x;
        Self { ax, ay, nx, ny, inverse_ratio }
    }
}

/// Sums the products of the named columns over a chunk, lane by lane.
macro_rules! sum_products {
    ($lanes:expr, $columns:expr, $sums:expr; loads $($name:ident = $index:expr),*; $($sum:ident = $one:ident[$i:expr] * $other:ident[$j:expr]),* $(,)?) => {
        for lane in (0..LANES).step_by(I::N) {
            $(let mut $sum = $lanes.load(&$sums.0[$i][$j][lane..]);)*
            for block in $columns {
                $(let $name = $lanes.load(&block.0[$index][lane..]);)*
                $($sum = $one.mul_add($other, $sum);)*
            }
            $($sum.store(&mut $sums.0[$i][$j][lane..]);)*
        }
    };
}

#[inline(always)]
fn sum_rows_0_and_1<I: Instructions>(lanes: I, columns: &[Whitened], sums: &mut Sums) {
    sum_products!(lanes, columns, sums; loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5;
        aa = a[0] * a[0], ab = a[0] * b[1], ac = a[0] * c[2],
        ad = a[0] * d[3], ae = a[0] * e[4], af = a[0] * f[5],
        bb = b[1] * b[1], bc = b[1] * c[2], bd = b[1] * d[3],
        be = b[1] * e[4], bf = b[1] * f[5]);
}

#[inline(always)]
fn sum_rows_2_to_5<I: Instructions>(lanes: I, columns: &[Whitened], sums: &mut Sums) {
    sum_products!(lanes, columns, sums; loads c = 2, d = 3, e = 4, f = 5;
        cc = c[2] * c[2], cd = c[2] * d[3], ce = c[2] * e[4], cf = c[2] * f[5],
        dd = d[3] * d[3], de = d[3] * e[4], df = d[3] * f[5],
        ee = e[4] * e[4], ef = e[4] * f[5], ff = f[5] * f[5]);
}

/// The products of a brightness column with itself and all columns before it.
#[inline(always)]
fn sum_column<I: Instructions, const COLUMN: usize>(
    lanes: I,
    columns: &[Whitened],
    sums: &mut Sums,
) {
    sum_products!(lanes, columns, sums;
        loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5, g = 6, x = COLUMN;
        ax = a[0] * x[COLUMN], bx = b[1] * x[COLUMN], cx = c[2] * x[COLUMN],
        dx = d[3] * x[COLUMN], ex = e[4] * x[COLUMN], fx = f[5] * x[COLUMN],
        gx = g[6] * x[COLUMN]);
    if COLUMN == 7 {
        sum_products!(lanes, columns, sums; loads x = 7; xx = x[7] * x[7]);
    }
}

#[inline(always)]
fn sum_gradient<I: Instructions>(lanes: I, columns: &[Whitened], sums: &mut Sums) {
    sum_products!(lanes, columns, sums;
        loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5, g = 6, h = 7,
            r = RESIDUAL;
        ar = a[0] * r[RESIDUAL], br = b[1] * r[RESIDUAL], cr = c[2] * r[RESIDUAL],
        dr = d[3] * r[RESIDUAL], er = e[4] * r[RESIDUAL], fr = f[5] * r[RESIDUAL],
        gr = g[6] * r[RESIDUAL], hr = h[7] * r[RESIDUAL]);
}

/// Adds up the lanes, in their order, in f64.
#[inline(always)]
fn finish<R: Register>(sums: &Sums, statistics: &Statistics<R>) -> NormalEquations {
    let total = |lanes: &[f32; LANES]| lanes.iter().map(|&sum| f64::from(sum)).sum::<f64>();
    let mut equations = NormalEquations::default();
    for i in 0..UNKNOWNS {
        for j in i..UNKNOWNS {
            equations.information[(i, j)] = total(&sums.0[i][j]);
        }
        equations.gradient[i] = total(&sums.0[i][RESIDUAL]);
    }
    equations.information.fill_lower_triangle_with_upper_triangle();
    equations.energy = total(&statistics.energy.to_array());
    equations.squared_residual = total(&statistics.squared_residual.to_array());
    equations.in_view = statistics.in_view;
    equations.compared = statistics.compared;
    equations.inliers = statistics.inliers;
    equations
}
