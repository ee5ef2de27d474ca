//! The comparison in lanes: each lane is a point, the samples of its pattern come one after the other.
//!
//! Nothing is summed across lanes and nothing is fused, so that all instruction sets give the same bits.

use crate::slam::image::shared::SharedImage;
use crate::slam::kernel::lanes_kernel::Lanes;
use crate::slam::kernel::{Body, Instructions, Kernel};
use crate::slam::window::comparison::{
    BORDER_PX, Compared, LANES, Lane, POSE, Pair, PairSums, Patterns, Robustness, SAMPLES, fits,
};

/// Smallest z'/z of a point: nearer than a twentieth of its distance it is not seen as it was.
const MIN_DEPTH_RATIO: f32 = 0.05;

impl Kernel {
    /// Compares the points of `patterns` with an observer and adds those that count to the sums of the pair. As many
    /// blocks of `compared` are written as there are patterns; none where the image is smaller than the pair's camera.
    pub fn compare(
        self,
        image: &SharedImage,
        pair: &Pair,
        patterns: &[Patterns],
        robustness: &Robustness,
        compared: &mut [Compared],
        sums: &mut PairSums,
    ) {
        if !fits(image, pair) {
            compared.fill(Compared::NONE);
            return;
        }
        self.run(Comparison { image, pair, patterns, robustness, compared, sums });
    }
}

/// What [`Kernel::compare`] compares.
struct Comparison<'a> {
    image: &'a SharedImage,
    pair: &'a Pair,
    patterns: &'a [Patterns],
    robustness: &'a Robustness,
    compared: &'a mut [Compared],
    sums: &'a mut PairSums,
}

impl Body for Comparison<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let Self { image, pair, patterns, robustness, compared, sums } = self;
        // SAFETY: who made the instructions vouched for them; `compare` above has checked the bounds.
        unsafe { compare::<I::Lanes>(image, pair, patterns, robustness, compared, sums) }
    }
}

/// # Safety
/// The processor has the instructions of `L`; the image is as large as the pair's camera says.
#[inline(always)]
unsafe fn compare<L: Lanes>(
    image: &SharedImage,
    pair: &Pair,
    patterns: &[Patterns],
    robustness: &Robustness,
    compared: &mut [Compared],
    sums: &mut PairSums,
) {
    // SAFETY: this function's own contract; `lane` + N is at most sixteen.
    unsafe {
        for (of, out) in patterns.iter().zip(compared) {
            for lane in (0..LANES).step_by(L::N) {
                let warped = warp::<L>(of, lane, pair, image);
                let seen = weigh::<L>(of, lane, &warped, robustness, &mut out.cost);
                let motion = Motion::of(pair, &warped);
                if pair.wanted.depths {
                    derive_depths(lane, pair, &motion, &seen, out);
                }
                if pair.wanted.poses {
                    derive_poses(lane, &motion, &seen, sums);
                }
            }
        }
    }
}

/// Some points in the observer's image.
struct Warped<L: Lanes> {
    /// All samples are inside the image.
    inside: L::Mask,
    /// X' over its depth.
    x: L,
    y: L,
    /// Inverse depth in the observer over that in the host.
    nearness: L,
    inverse_depth: L,
    observed: [L; SAMPLES],
    gradient_u: [L; SAMPLES],
    gradient_v: [L; SAMPLES],
}

/// What the samples of some points sum to.
struct Weighed<L> {
    /// M.
    uu: L,
    uv: L,
    vv: L,
    /// b.
    right_u: L,
    right_v: L,
}

/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn warp<L: Lanes>(
    of: &Patterns,
    lane: usize,
    pair: &Pair,
    image: &SharedImage,
) -> Warped<L> {
    // SAFETY: this function's own contract.
    unsafe {
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let depth = load::<L>(&of.inverse_depth, lane);
        let ray = [load::<L>(&of.ray[0], lane), load::<L>(&of.ray[1], lane)];
        let c0 = turned::<L>(pair, 0, ray, depth);
        let c1 = turned::<L>(pair, 1, ray, depth);
        let c2 = turned::<L>(pair, 2, ray, depth);
        let mut inside = c2.at_least(L::splat(MIN_DEPTH_RATIO));
        let nearness = one.div(L::select(inside, c2, one));
        let (fx, fy) = (L::splat(pair.focal[0]), L::splat(pair.focal[1]));
        let (cx, cy) = (L::splat(pair.centre[0]), L::splat(pair.centre[1]));
        let first = L::splat(BORDER_PX);
        let (last_u, last_v) = (L::splat(pair.last[0]), L::splat(pair.last[1]));
        let mut positions = [(zero, zero); SAMPLES];
        for k in 0..SAMPLES {
            // 1/(z + o) = n / (1 + e), e = o n, a hundredth at most: exact to e³.
            let e = nearness.mul(L::splat(-pair.offsets[2][k]));
            let near = nearness.add(nearness.mul(e.add(e.mul(e))));
            let u = fx.mul(c0.add(L::splat(pair.offsets[0][k])).mul(near)).add(cx);
            let v = fy.mul(c1.add(L::splat(pair.offsets[1][k])).mul(near)).add(cy);
            inside = L::both(inside, L::both(u.at_least(first), last_u.at_least(u)));
            inside = L::both(inside, L::both(v.at_least(first), last_v.at_least(v)));
            positions[k] = (u, v);
        }
        let (mut observed, mut gradient_u, mut gradient_v) =
            ([zero; SAMPLES], [zero; SAMPLES], [zero; SAMPLES]);
        for k in 0..SAMPLES {
            let (u, v) = positions[k];
            let at = L::sample_bytes(image.pixels(), image.width(), u, v);
            let upper = at.upper_right.sub(at.upper_left);
            let lower = at.lower_right.sub(at.lower_left);
            let top = at.upper_left.add(at.du.mul(upper));
            let bottom = at.lower_left.add(at.du.mul(lower));
            gradient_v[k] = bottom.sub(top);
            observed[k] = top.add(at.dv.mul(gradient_v[k]));
            gradient_u[k] = upper.add(at.dv.mul(lower.sub(upper)));
        }
        // Elsewhere harmless numbers: 0 · NaN would be NaN.
        Warped {
            inside,
            x: L::select(inside, c0.mul(nearness), zero),
            y: L::select(inside, c1.mul(nearness), zero),
            nearness: L::select(inside, nearness, zero),
            inverse_depth: L::select(inside, depth, zero),
            observed,
            gradient_u,
            gradient_v,
        }
    }
}

/// A coordinate of X' d at the pattern's centre.
///
/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn turned<L: Lanes>(pair: &Pair, row: usize, ray: [L; 2], depth: L) -> L {
    let ([a, b, c], t) = (pair.rotation[row], pair.translation[row]);
    // SAFETY: this function's own contract.
    unsafe {
        let turned = L::splat(a).mul(ray[0]).add(L::splat(b).mul(ray[1])).add(L::splat(c));
        turned.add(depth.mul(L::splat(t)))
    }
}

/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn weigh<L: Lanes>(
    of: &Patterns,
    lane: usize,
    warped: &Warped<L>,
    robustness: &Robustness,
    costs: &mut Lane,
) -> Weighed<L> {
    // SAFETY: this function's own contract.
    unsafe {
        let (zero, two) = (L::splat(0.0), L::splat(2.0));
        let largest = L::splat(robustness.huber_grey);
        let observed_mean = mean::<L>(&warped.observed);
        let (mean_u, mean_v) = (mean::<L>(&warped.gradient_u), mean::<L>(&warped.gradient_v));
        let mut energy = zero;
        let (mut uu, mut uv, mut vv) = (zero, zero, zero);
        let (mut right_u, mut right_v) = (zero, zero);
        for k in 0..SAMPLES {
            let shape = load::<L>(&of.shape[k], lane);
            let residual = warped.observed[k].sub(observed_mean.mul(shape));
            let size = residual.max(zero.sub(residual));
            let huber = largest.div(size.max(largest));
            let weight = load::<L>(&of.weight[k], lane).mul(huber);
            let weighted = weight.mul(residual);
            energy = energy.add(weighted.mul(residual).mul(two.sub(huber)));
            let u = warped.gradient_u[k].sub(shape.mul(mean_u));
            let v = warped.gradient_v[k].sub(shape.mul(mean_v));
            let along = weight.mul(u);
            uu = uu.add(along.mul(u));
            uv = uv.add(along.mul(v));
            vv = vv.add(weight.mul(v).mul(v));
            right_u = right_u.add(weighted.mul(u));
            right_v = right_v.add(weighted.mul(v));
        }
        let same = L::both(warped.inside, L::splat(robustness.most_energy).at_least(energy));
        let cost = L::select(same, energy, L::splat(f32::INFINITY));
        store(L::select(warped.inside, cost, L::splat(f32::NAN)), costs, lane);
        Weighed {
            uu: L::select(same, uu, zero),
            uv: L::select(same, uv, zero),
            vv: L::select(same, vv, zero),
            right_u: L::select(same, right_u, zero),
            right_v: L::select(same, right_v, zero),
        }
    }
}

/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn mean<L: Lanes>(of: &[L; SAMPLES]) -> L {
    // SAFETY: this function's own contract.
    unsafe {
        let even = of[0].add(of[4]).add(of[2].add(of[6]));
        let odd = of[1].add(of[5]).add(of[3].add(of[7]));
        even.add(odd).mul(L::splat(1.0 / SAMPLES as f32))
    }
}

/// ∂π/∂p and ∂π/∂d at the pattern's centre, column and row of the image.
struct Motion<L> {
    u: [L; POSE],
    v: [L; POSE],
    depth_u: L,
    depth_v: L,
}

impl<L: Lanes> Motion<L> {
    /// # Safety
    /// As [`compare`].
    #[inline(always)]
    unsafe fn of(pair: &Pair, warped: &Warped<L>) -> Self {
        // SAFETY: this function's own contract.
        unsafe {
            let (zero, one) = (L::splat(0.0), L::splat(1.0));
            let (fx, fy) = (L::splat(pair.focal[0]), L::splat(pair.focal[1]));
            let [tx, ty, tz] = pair.translation;
            let (x, y, depth) = (warped.x, warped.y, warped.inverse_depth);
            let (along_u, along_v) = (fx.mul(warped.nearness), fy.mul(warped.nearness));
            let (moved_u, moved_v) = (depth.mul(along_u), depth.mul(along_v));
            let both = x.mul(y);
            let u = [
                moved_u,
                zero,
                zero.sub(moved_u.mul(x)),
                zero.sub(fx.mul(both)),
                fx.mul(one.add(x.mul(x))),
                zero.sub(fx.mul(y)),
            ];
            let v = [
                zero,
                moved_v,
                zero.sub(moved_v.mul(y)),
                zero.sub(fy.mul(one.add(y.mul(y)))),
                fy.mul(both),
                fy.mul(x),
            ];
            let depth_u = along_u.mul(L::splat(tx).sub(x.mul(L::splat(tz))));
            let depth_v = along_v.mul(L::splat(ty).sub(y.mul(L::splat(tz))));
            Self { u, v, depth_u, depth_v }
        }
    }

    /// A row of (∂π/∂p)ᵀ times (a, b).
    ///
    /// # Safety
    /// As [`compare`].
    #[inline(always)]
    unsafe fn along(&self, row: usize, a: L, b: L) -> L {
        // SAFETY: this function's own contract.
        unsafe {
            match row {
                0 => self.u[0].mul(a),
                1 => self.v[1].mul(b),
                _ => self.u[row].mul(a).add(self.v[row].mul(b)),
            }
        }
    }
}

/// The sums of the points.
///
/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn derive_depths<L: Lanes>(
    lane: usize,
    pair: &Pair,
    motion: &Motion<L>,
    weighed: &Weighed<L>,
    out: &mut Compared,
) {
    // SAFETY: this function's own contract.
    unsafe {
        let (u, v) = (motion.depth_u, motion.depth_v);
        let a = weighed.uu.mul(u).add(weighed.uv.mul(v));
        let b = weighed.uv.mul(u).add(weighed.vv.mul(v));
        store(u.mul(a).add(v.mul(b)), &mut out.depth, lane);
        store(u.mul(weighed.right_u).add(v.mul(weighed.right_v)), &mut out.depth_right, lane);
        if !pair.wanted.poses {
            return;
        }
        let mut mixed = [L::splat(0.0); POSE];
        for row in 0..POSE {
            mixed[row] = motion.along(row, a, b);
            store(mixed[row], &mut out.observer[row], lane);
        }
        if pair.wanted.host {
            for column in 0..POSE {
                let mut carried = L::splat(0.0);
                for row in 0..POSE {
                    carried = carried.add(L::splat(pair.by_host[row][column]).mul(mixed[row]));
                }
                store(carried, &mut out.host[column], lane);
            }
        }
    }
}

/// The sums of the pair.
///
/// # Safety
/// As [`compare`].
#[inline(always)]
unsafe fn derive_poses<L: Lanes>(
    lane: usize,
    motion: &Motion<L>,
    weighed: &Weighed<L>,
    sums: &mut PairSums,
) {
    // SAFETY: this function's own contract.
    unsafe {
        let mut entry = 0;
        for row in 0..POSE {
            // A column of M ∂π/∂p.
            let (u, v) = (motion.u[row], motion.v[row]);
            let a = weighed.uu.mul(u).add(weighed.uv.mul(v));
            let b = weighed.uv.mul(u).add(weighed.vv.mul(v));
            for column in row..POSE {
                add(motion.along(column, a, b), &mut sums.pose[entry], lane);
                entry += 1;
            }
            let right = motion.along(row, weighed.right_u, weighed.right_v);
            add(right, &mut sums.right[row], lane);
        }
    }
}

/// # Safety
/// As [`compare`]; `lane` + N is at most sixteen.
#[inline(always)]
unsafe fn load<L: Lanes>(from: &Lane, lane: usize) -> L {
    // SAFETY: this function's own contract.
    unsafe { L::load(from.as_ptr().add(lane)) }
}

/// # Safety
/// As [`load`].
#[inline(always)]
unsafe fn store<L: Lanes>(value: L, to: &mut Lane, lane: usize) {
    // SAFETY: this function's own contract.
    unsafe { value.store(to.as_mut_ptr().add(lane)) }
}

/// # Safety
/// As [`load`].
#[inline(always)]
unsafe fn add<L: Lanes>(value: L, to: &mut Lane, lane: usize) {
    // SAFETY: this function's own contract.
    unsafe { store(load::<L>(to, lane).add(value), to, lane) }
}
