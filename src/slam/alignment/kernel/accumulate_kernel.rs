//! The loop over points for any instruction set: `residual::accumulate_reference` in lanes.
//!
//! Points are taken in chunks that stay in the first-level cache. A first pass writes, for each
//! point, the columns of the whitened Jacobian √w J and residual √w r; then five passes sum their
//! products with at most eleven sums each, what sixteen registers hold without spilling.

use crate::slam::alignment::normal_equations::{NormalEquations, UNKNOWNS};
use crate::slam::alignment::points::{LANES, LevelPoints, PointBlock};
use crate::slam::alignment::residual::{
    BORDER_PX, Evaluation, NEAREST_DEPTH_RATIO, SMALLEST_DETERMINANT, UNCLIPPED_GREY,
};
use crate::slam::image::buffer::Image;
use crate::slam::kernel::lanes_kernel::Lanes;

/// Blocks of a chunk: its columns take 10 kB, a third of a small first-level cache.
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

/// Sums of products of columns, the upper triangle of JᵀWJ and JᵀWr, lane by lane; `[i][j]`, j > 7
/// the residual.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Sums([[[f32; LANES]; COLUMNS]; UNKNOWNS]);

/// Sums that are not products of columns.
pub struct Statistics<L> {
    energy: L,
    squared_residual: L,
    in_view: u32,
    compared: u32,
    inliers: u32,
}

impl<L: Lanes> Statistics<L> {
    /// # Safety
    /// The CPU has the instructions of `L`.
    #[inline(always)]
    pub unsafe fn zero() -> Self {
        // SAFETY: this function's own contract.
        let zero = unsafe { L::splat(0.0) };
        Self { energy: zero, squared_residual: zero, in_view: 0, compared: 0, inliers: 0 }
    }

    /// Counts residuals that are compared; their weights, with Huber's.
    ///
    /// # Safety
    /// The CPU has the instructions of `L`.
    #[inline(always)]
    unsafe fn weigh(&mut self, at: &Evaluation, r: L, variance: L, is_compared: L::Mask) -> L {
        // SAFETY: this function's own contract.
        unsafe {
            let (zero, one) = (L::splat(0.0), L::splat(1.0));
            let squared = r.mul(r);
            let information = one.div(variance);
            let normalized = squared.mul(information);
            let huber = L::min(L::splat(at.huber).div(normalized.sqrt()), one);
            let inlier = L::splat(at.inlier_gate_squared).greater(normalized);
            self.compared += L::count(is_compared);
            self.inliers += L::count(L::both(is_compared, inlier));
            let energy = huber.mul(L::splat(2.0).sub(huber)).mul(normalized);
            self.energy = self.energy.add(L::select(is_compared, energy, zero));
            self.squared_residual =
                self.squared_residual.add(L::select(is_compared, squared, zero));
            L::select(is_compared, huber.mul(information), zero)
        }
    }
}

/// # Safety
/// The CPU has the instructions of `L`; a projection below `at.upper_bound` has a right and a
/// lower neighbour in `image`.
#[inline(always)]
pub unsafe fn accumulate<L: Lanes>(
    points: &LevelPoints,
    image: &Image<u16>,
    at: &Evaluation,
) -> NormalEquations {
    let mut columns = [Whitened::ZERO; CHUNK_BLOCKS];
    let mut sums = Sums([[[0.0; LANES]; COLUMNS]; UNKNOWNS]);
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        let mut statistics = Statistics::<L>::zero();
        for blocks in points.blocks().chunks(CHUNK_BLOCKS) {
            for (block, whitened) in blocks.iter().zip(&mut columns) {
                for lane in (0..LANES).step_by(L::N) {
                    whiten::<L>(block, lane, image, at, whitened, &mut statistics);
                }
            }
            let columns = &columns[..blocks.len()];
            sum_rows_0_and_1::<L>(columns, &mut sums);
            sum_rows_2_to_5::<L>(columns, &mut sums);
            sum_column::<L, 6>(columns, &mut sums);
            sum_column::<L, 7>(columns, &mut sums);
            sum_gradient::<L>(columns, &mut sums);
        }
        finish(&sums, &statistics)
    }
}

/// Residual, weight and Jacobian of `L::N` points; the formulas and the steps are those of `residual::point_terms`.
///
/// # Safety
/// As [`accumulate`].
#[inline(always)]
pub unsafe fn whiten<L: Lanes>(
    block: &PointBlock,
    lane: usize,
    image: &Image<u16>,
    at: &Evaluation,
    whitened: &mut Whitened,
    statistics: &mut Statistics<L>,
) {
    // SAFETY: this function's own contract; `lane` + N is at most sixteen.
    unsafe {
        let load = |column: &[f32; LANES]| L::load(column.as_ptr().add(lane));
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let (u, v, in_view) = project::<L>(block, lane, at);
        let value = sample::<L>(image, u, v).mul(L::splat(at.grey_per_sum));
        let predicted = load(&block.intensity).mul(L::splat(at.gain));
        let residual = value.sub(predicted.add(L::splat(at.offset)));
        // Where the sensor ends, a residual that points beyond its end says nothing.
        let [darkest, lightest] = UNCLIPPED_GREY.map(|grey| L::splat(grey));
        let within = L::select(value.greater(lightest), residual, one);
        let within = L::select(darkest.greater(value), zero.sub(residual), within);
        let is_compared = L::both(in_view, within.at_least(zero));

        let Surface { ax, ay, nx, ny, inverse_ratio } = Surface::<L>::of(block, lane, at);
        let m = ax.mul_add(nx, ay.mul(ny));
        let [wx, wy, wz] = at.variance_translation.map(|value| L::splat(value));
        let weighing = ax.mul_add(wx, ay.mul_add(wy, zero.sub(m).mul(wz))).mul(inverse_ratio);
        let from_depth = weighing.mul(weighing).mul(load(&block.variance));
        let variance =
            from_depth.mul_add(L::splat(at.depth_variance_factor), L::splat(at.intensity_variance));
        statistics.in_view += L::count(in_view);
        let root = statistics.weigh(at, residual, variance, is_compared).sqrt();

        let store = |whitened: &mut Whitened, column: usize, value: L| {
            value.mul(root).store(whitened.0[column].as_mut_ptr().add(lane));
        };
        let translation = load(&block.surrounding_inverse_depth).mul(inverse_ratio);
        store(whitened, 0, translation.mul(ax));
        store(whitened, 1, translation.mul(ay));
        store(whitened, 2, zero.sub(translation).mul(m));
        store(whitened, 3, zero.sub(ny.mul_add(m, ay)));
        store(whitened, 4, nx.mul_add(m, ax));
        store(whitened, 5, nx.mul(ay).sub(ny.mul(ax)));
        store(whitened, 6, zero.sub(predicted));
        store(whitened, 7, L::splat(-1.0));
        store(whitened, RESIDUAL, residual);
    }
}

/// X̃ of points at inverse depth `d`.
///
/// # Safety
/// As [`whiten`].
#[inline(always)]
unsafe fn warp<L: Lanes>(block: &PointBlock, lane: usize, at: &Evaluation, d: L) -> [L; 3] {
    // SAFETY: this function's own contract.
    unsafe {
        let [r0, r1, r2, r3, r4, r5, r6, r7, r8] = at.rotation.map(|value| L::splat(value));
        let [tx, ty, tz] = at.translation.map(|value| L::splat(value));
        let x = L::load(block.ray_x.as_ptr().add(lane));
        let y = L::load(block.ray_y.as_ptr().add(lane));
        [
            r0.mul_add(x, r1.mul_add(y, tx.mul_add(d, r2))),
            r3.mul_add(x, r4.mul_add(y, ty.mul_add(d, r5))),
            r6.mul_add(x, r7.mul_add(y, tz.mul_add(d, r8))),
        ]
    }
}

/// Where points fall, and which of them are in view; the others fall on the border.
///
/// # Safety
/// As [`whiten`].
#[inline(always)]
unsafe fn project<L: Lanes>(block: &PointBlock, lane: usize, at: &Evaluation) -> (L, L, L::Mask) {
    // SAFETY: this function's own contract.
    unsafe {
        let ([fx, fy], [cx, cy]) = (at.focal.map(|f| L::splat(f)), at.centre.map(|c| L::splat(c)));
        let d = L::load(block.inverse_depth.as_ptr().add(lane));
        let [warped_x, warped_y, depth_ratio] = warp::<L>(block, lane, at, d);
        let in_front = depth_ratio.greater(L::splat(NEAREST_DEPTH_RATIO));
        // Lanes that are not in view continue with harmless numbers: 0 · NaN would be NaN.
        let depth_ratio = L::select(in_front, depth_ratio, L::splat(1.0));
        let inverse_ratio = L::splat(1.0).div(depth_ratio);
        let (nx, ny) = (warped_x.mul(inverse_ratio), warped_y.mul(inverse_ratio));
        let (u, v) = (fx.mul_add(nx, cx), fy.mul_add(ny, cy));
        let border = L::splat(BORDER_PX);
        let inside =
            |value: L, bound: f32| L::both(value.at_least(border), L::splat(bound).greater(value));
        let inside = L::both(inside(u, at.upper_bound[0]), inside(v, at.upper_bound[1]));
        let in_view = L::both(in_front, inside);
        (L::select(in_view, u, border), L::select(in_view, v, border), in_view)
    }
}

/// The image between its pixels.
///
/// # Safety
/// As [`whiten`].
#[inline(always)]
unsafe fn sample<L: Lanes>(image: &Image<u16>, u: L, v: L) -> L {
    // SAFETY: this function's own contract.
    unsafe {
        let pixels = L::sample(image.pixels(), image.width(), u, v);
        let above = pixels.upper_right.sub(pixels.upper_left).mul_add(pixels.du, pixels.upper_left);
        let below = pixels.lower_right.sub(pixels.lower_left).mul_add(pixels.du, pixels.lower_left);
        below.sub(above).mul_add(pixels.dv, above)
    }
}

/// The surface around points as the frame sees it: its gradient, n and 1/z̃.
struct Surface<L> {
    ax: L,
    ay: L,
    nx: L,
    ny: L,
    inverse_ratio: L,
}

impl<L: Lanes> Surface<L> {
    /// # Safety
    /// As [`whiten`].
    #[inline(always)]
    unsafe fn of(block: &PointBlock, lane: usize, at: &Evaluation) -> Self {
        // SAFETY: this function's own contract.
        unsafe {
            let load = |column: &[f32; LANES]| L::load(column.as_ptr().add(lane));
            let [r0, r1, _, r3, r4, _, r6, r7, _] = at.rotation.map(|value| L::splat(value));
            let [fx, fy] = at.focal.map(|f| L::splat(f));
            let d = load(&block.surrounding_inverse_depth);
            let [warped_x, warped_y, depth_ratio] = warp::<L>(block, lane, at, d);
            let depth_ratio = depth_ratio.max(L::splat(NEAREST_DEPTH_RATIO));
            let inverse_ratio = L::splat(1.0).div(depth_ratio);
            let (nx, ny) = (warped_x.mul(inverse_ratio), warped_y.mul(inverse_ratio));
            let (m11, m12) = (r0.sub(nx.mul(r6)), r1.sub(nx.mul(r7)));
            let (m21, m22) = (r3.sub(ny.mul(r6)), r4.sub(ny.mul(r7)));
            let determinant = m11.mul(m22).sub(m12.mul(m21)).max(L::splat(SMALLEST_DETERMINANT));
            let scale = depth_ratio.mul(L::splat(at.gain)).div(determinant);
            let keyframe_x = load(&block.gradient_x).mul(fx).mul(scale);
            let keyframe_y = load(&block.gradient_y).mul(fy).mul(scale);
            let ax = m22.mul(keyframe_x).sub(m21.mul(keyframe_y));
            let ay = m11.mul(keyframe_y).sub(m12.mul(keyframe_x));
            Self { ax, ay, nx, ny, inverse_ratio }
        }
    }
}

/// Sums the products of the named columns over a chunk, lane by lane.
macro_rules! sum_products {
    ($lanes:ty, $columns:expr, $sums:expr; loads $($name:ident = $index:expr),*; $($sum:ident = $one:ident[$i:expr] * $other:ident[$j:expr]),* $(,)?) => {
        for lane in (0..LANES).step_by(<$lanes>::N) {
            $(let mut $sum = <$lanes>::load($sums.0[$i][$j].as_ptr().add(lane));)*
            for block in $columns {
                $(let $name = <$lanes>::load(block.0[$index].as_ptr().add(lane));)*
                $($sum = $one.mul_add($other, $sum);)*
            }
            $($sum.store($sums.0[$i][$j].as_mut_ptr().add(lane));)*
        }
    };
}

/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
unsafe fn sum_rows_0_and_1<L: Lanes>(columns: &[Whitened], sums: &mut Sums) {
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        sum_products!(L, columns, sums; loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5;
            aa = a[0] * a[0], ab = a[0] * b[1], ac = a[0] * c[2],
            ad = a[0] * d[3], ae = a[0] * e[4], af = a[0] * f[5],
            bb = b[1] * b[1], bc = b[1] * c[2], bd = b[1] * d[3],
            be = b[1] * e[4], bf = b[1] * f[5]);
    }
}

/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
unsafe fn sum_rows_2_to_5<L: Lanes>(columns: &[Whitened], sums: &mut Sums) {
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        sum_products!(L, columns, sums; loads c = 2, d = 3, e = 4, f = 5;
            cc = c[2] * c[2], cd = c[2] * d[3], ce = c[2] * e[4], cf = c[2] * f[5],
            dd = d[3] * d[3], de = d[3] * e[4], df = d[3] * f[5],
            ee = e[4] * e[4], ef = e[4] * f[5], ff = f[5] * f[5]);
    }
}

/// The products of a column of the brightness with all before it and itself.
///
/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
unsafe fn sum_column<L: Lanes, const COLUMN: usize>(columns: &[Whitened], sums: &mut Sums) {
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        sum_products!(L, columns, sums;
            loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5, g = 6, x = COLUMN;
            ax = a[0] * x[COLUMN], bx = b[1] * x[COLUMN], cx = c[2] * x[COLUMN],
            dx = d[3] * x[COLUMN], ex = e[4] * x[COLUMN], fx = f[5] * x[COLUMN],
            gx = g[6] * x[COLUMN]);
        if COLUMN == 7 {
            sum_products!(L, columns, sums; loads x = 7; xx = x[7] * x[7]);
        }
    }
}

/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
unsafe fn sum_gradient<L: Lanes>(columns: &[Whitened], sums: &mut Sums) {
    // SAFETY: this function's own contract; all pointers go to blocks of sixteen floats.
    unsafe {
        sum_products!(L, columns, sums;
            loads a = 0, b = 1, c = 2, d = 3, e = 4, f = 5, g = 6, h = 7,
                r = RESIDUAL;
            ar = a[0] * r[RESIDUAL], br = b[1] * r[RESIDUAL], cr = c[2] * r[RESIDUAL],
            dr = d[3] * r[RESIDUAL], er = e[4] * r[RESIDUAL], fr = f[5] * r[RESIDUAL],
            gr = g[6] * r[RESIDUAL], hr = h[7] * r[RESIDUAL]);
    }
}

/// Adds up the lanes, in their order, in f64.
///
/// # Safety
/// The CPU has the instructions of `L`.
#[inline(always)]
unsafe fn finish<L: Lanes>(sums: &Sums, statistics: &Statistics<L>) -> NormalEquations {
    let total = |lanes: &[f32; LANES]| lanes.iter().map(|&sum| f64::from(sum)).sum::<f64>();
    let mut equations = NormalEquations::default();
    for i in 0..UNKNOWNS {
        for j in i..UNKNOWNS {
            equations.information[(i, j)] = total(&sums.0[i][j]);
        }
        equations.gradient[i] = total(&sums.0[i][RESIDUAL]);
    }
    equations.information.fill_lower_triangle_with_upper_triangle();
    let (mut energy, mut squared_residual) = ([0.0; LANES], [0.0; LANES]);
    // SAFETY: this function's own contract; N is at most sixteen.
    unsafe {
        statistics.energy.store(energy.as_mut_ptr());
        statistics.squared_residual.store(squared_residual.as_mut_ptr());
    }
    equations.energy = total(&energy);
    equations.squared_residual = total(&squared_residual);
    equations.in_view = statistics.in_view;
    equations.compared = statistics.compared;
    equations.inliers = statistics.inliers;
    equations
}
