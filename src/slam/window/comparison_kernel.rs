//! The comparison in lanes: each lane holds a point, and the samples of its pattern follow one after the other.
//!
//! Nothing is summed across lanes and nothing is fused, so that all instruction sets give the same bits.

use crate::slam::image::shared::SharedImage;
use crate::slam::kernel::lanes_kernel::{Lanes, Mask, Register};
use crate::slam::kernel::{Body, Floats, Instructions, Kernel};
use crate::slam::window::comparison::{
    BORDER_PX, Compared, LANES, Lane, POSE, Pair, PairSums, Patterns, Robustness, SAMPLES, fits,
};

/// Smallest z'/z of a point: from nearer than a twentieth of its distance it does not look the same.
const MIN_DEPTH_RATIO: f32 = 0.05;

impl Kernel {
    /// Compares the points of `patterns` with an observer and adds the inliers to the sums of the pair. Writes one
    /// block of `compared` per pattern; all are [`Compared::NONE`] where the image is smaller than the pair's camera.
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

/// The arguments of [`Kernel::compare`].
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
    fn run<I: Instructions>(self, lanes: I) {
        let Self { image, pair, patterns, robustness, compared, sums } = self;
        for (of, out) in patterns.iter().zip(compared) {
            for lane in (0..LANES).step_by(I::N) {
                let warped = warp(lanes, of, lane, pair, image);
                let seen = weigh(lanes, of, lane, &warped, robustness, &mut out.cost);
                let motion = Motion::of(lanes, pair, &warped);
                if pair.wanted.depths {
                    derive_depths(lanes, lane, pair, &motion, &seen, out);
                }
                if pair.wanted.poses {
                    derive_poses(lanes, lane, &motion, &seen, sums);
                }
            }
        }
    }
}

/// Points projected into the observer's image.
struct Warped<R: Register> {
    /// Whether all samples are inside the image.
    inside: Mask<R>,
    /// X' over its depth.
    x: Lanes<R>,
    y: Lanes<R>,
    /// Inverse depth in the observer over that in the host.
    nearness: Lanes<R>,
    inverse_depth: Lanes<R>,
    observed: [Lanes<R>; SAMPLES],
    gradient_u: [Lanes<R>; SAMPLES],
    gradient_v: [Lanes<R>; SAMPLES],
}

/// Sums over the samples of each point.
struct Weighed<R> {
    /// M.
    uu: Lanes<R>,
    uv: Lanes<R>,
    vv: Lanes<R>,
    /// b.
    right_u: Lanes<R>,
    right_v: Lanes<R>,
}

#[inline(always)]
fn warp<I: Instructions>(
    lanes: I,
    of: &Patterns,
    lane: usize,
    pair: &Pair,
    image: &SharedImage,
) -> Warped<I::Register> {
    let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
    let depth = lanes.load(&of.inverse_depth[lane..]);
    let ray = [lanes.load(&of.ray[0][lane..]), lanes.load(&of.ray[1][lane..])];
    let c0 = turned(lanes, pair, 0, ray, depth);
    let c1 = turned(lanes, pair, 1, ray, depth);
    let c2 = turned(lanes, pair, 2, ray, depth);
    let mut inside = c2.at_least(lanes.splat(MIN_DEPTH_RATIO));
    let nearness = one / inside.select(c2, one);
    let (fx, fy) = (lanes.splat(pair.focal[0]), lanes.splat(pair.focal[1]));
    let (cx, cy) = (lanes.splat(pair.centre[0]), lanes.splat(pair.centre[1]));
    let first = lanes.splat(BORDER_PX);
    let (last_u, last_v) = (lanes.splat(pair.last[0]), lanes.splat(pair.last[1]));
    let mut positions = [(zero, zero); SAMPLES];
    for k in 0..SAMPLES {
        // 1/(z + o) = n / (1 + e), e = o n, a hundredth at most: exact to e³.
        let e = nearness * lanes.splat(-pair.offsets[2][k]);
        let near = nearness + nearness * (e + e * e);
        let u = fx * ((c0 + lanes.splat(pair.offsets[0][k])) * near) + cx;
        let v = fy * ((c1 + lanes.splat(pair.offsets[1][k])) * near) + cy;
        inside = inside & u.at_least(first) & last_u.at_least(u);
        inside = inside & v.at_least(first) & last_v.at_least(v);
        positions[k] = (u, v);
    }
    let [mut observed, mut gradient_u, mut gradient_v] = [[zero; SAMPLES]; 3];
    for k in 0..SAMPLES {
        let (u, v) = positions[k];
        let at = Lanes::sample(image.pixels(), image.width(), u, v);
        inside = inside & at.has_data().greater(zero);
        let upper = at.upper_right - at.upper_left;
        let lower = at.lower_right - at.lower_left;
        let top = at.upper_left + at.du * upper;
        let bottom = at.lower_left + at.du * lower;
        gradient_v[k] = bottom - top;
        observed[k] = top + at.dv * gradient_v[k];
        gradient_u[k] = upper + at.dv * (lower - upper);
    }
    // Harmless numbers outside: 0 · NaN would be NaN.
    Warped {
        inside,
        x: inside.select(c0 * nearness, zero),
        y: inside.select(c1 * nearness, zero),
        nearness: inside.select(nearness, zero),
        inverse_depth: inside.select(depth, zero),
        observed,
        gradient_u,
        gradient_v,
    }
}

/// A coordinate of X' d at the pattern's centre.
#[inline(always)]
fn turned<I: Instructions>(
    lanes: I,
    pair: &Pair,
    row: usize,
    ray: [Floats<I>; 2],
    depth: Floats<I>,
) -> Floats<I> {
    let [a, b, c] = pair.rotation[row].map(|x| lanes.splat(x));
    a * ray[0] + b * ray[1] + c + depth * lanes.splat(pair.translation[row])
}

#[inline(always)]
fn weigh<I: Instructions>(
    lanes: I,
    of: &Patterns,
    lane: usize,
    warped: &Warped<I::Register>,
    robustness: &Robustness,
    costs: &mut Lane,
) -> Weighed<I::Register> {
    let (zero, two) = (lanes.splat(0.0), lanes.splat(2.0));
    let largest = lanes.splat(robustness.huber_grey);
    let observed_mean = mean(lanes, &warped.observed);
    let (mean_u, mean_v) = (mean(lanes, &warped.gradient_u), mean(lanes, &warped.gradient_v));
    let mut energy = zero;
    let (mut uu, mut uv, mut vv) = (zero, zero, zero);
    let (mut right_u, mut right_v) = (zero, zero);
    for k in 0..SAMPLES {
        let shape = lanes.load(&of.shape[k][lane..]);
        let residual = warped.observed[k] - observed_mean * shape;
        let size = residual.max(zero - residual);
        let huber = largest / size.max(largest);
        let weight = lanes.load(&of.weight[k][lane..]) * huber;
        let weighted = weight * residual;
        energy = energy + weighted * residual * (two - huber);
        let u = warped.gradient_u[k] - shape * mean_u;
        let v = warped.gradient_v[k] - shape * mean_v;
        let along = weight * u;
        uu = uu + along * u;
        uv = uv + along * v;
        vv = vv + weight * v * v;
        right_u = right_u + weighted * u;
        right_v = right_v + weighted * v;
    }
    let same = warped.inside & lanes.splat(robustness.most_energy).at_least(energy);
    let cost = same.select(energy, lanes.splat(f32::INFINITY));
    warped.inside.select(cost, lanes.splat(f32::NAN)).store(&mut costs[lane..]);
    Weighed {
        uu: same.select(uu, zero),
        uv: same.select(uv, zero),
        vv: same.select(vv, zero),
        right_u: same.select(right_u, zero),
        right_v: same.select(right_v, zero),
    }
}

#[inline(always)]
fn mean<I: Instructions>(lanes: I, of: &[Floats<I>; SAMPLES]) -> Floats<I> {
    let even = of[0] + of[4] + (of[2] + of[6]);
    let odd = of[1] + of[5] + (of[3] + of[7]);
    (even + odd) * lanes.splat(1.0 / SAMPLES as f32)
}

/// ∂π/∂p and ∂π/∂d at the pattern's centre, column and row of the image.
struct Motion<R> {
    u: [Lanes<R>; POSE],
    v: [Lanes<R>; POSE],
    depth_u: Lanes<R>,
    depth_v: Lanes<R>,
}

impl<R: Register> Motion<R> {
    #[inline(always)]
    fn of<I: Instructions<Register = R>>(lanes: I, pair: &Pair, warped: &Warped<R>) -> Self {
        let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
        let (fx, fy) = (lanes.splat(pair.focal[0]), lanes.splat(pair.focal[1]));
        let [tx, ty, tz] = pair.translation.map(|x| lanes.splat(x));
        let (x, y, depth) = (warped.x, warped.y, warped.inverse_depth);
        let (along_u, along_v) = (fx * warped.nearness, fy * warped.nearness);
        let (moved_u, moved_v) = (depth * along_u, depth * along_v);
        let both = x * y;
        let u = [
            moved_u,
            zero,
            zero - moved_u * x,
            zero - fx * both,
            fx * (one + x * x),
            zero - fx * y,
        ];
        let v = [zero, moved_v, zero - moved_v * y, zero - fy * (one + y * y), fy * both, fy * x];
        Self { u, v, depth_u: along_u * (tx - x * tz), depth_v: along_v * (ty - y * tz) }
    }

    /// A row of (∂π/∂p)ᵀ times (a, b).
    #[inline(always)]
    fn along(&self, row: usize, a: Lanes<R>, b: Lanes<R>) -> Lanes<R> {
        match row {
            0 => self.u[0] * a,
            1 => self.v[1] * b,
            _ => self.u[row] * a + self.v[row] * b,
        }
    }
}

/// Writes the sums of the points.
#[inline(always)]
fn derive_depths<I: Instructions>(
    lanes: I,
    lane: usize,
    pair: &Pair,
    motion: &Motion<I::Register>,
    weighed: &Weighed<I::Register>,
    out: &mut Compared,
) {
    let (u, v) = (motion.depth_u, motion.depth_v);
    let a = weighed.uu * u + weighed.uv * v;
    let b = weighed.uv * u + weighed.vv * v;
    (u * a + v * b).store(&mut out.depth[lane..]);
    (u * weighed.right_u + v * weighed.right_v).store(&mut out.depth_right[lane..]);
    if !pair.wanted.poses {
        return;
    }
    let mut mixed = [lanes.splat(0.0); POSE];
    for row in 0..POSE {
        mixed[row] = motion.along(row, a, b);
        mixed[row].store(&mut out.observer[row][lane..]);
    }
    if pair.wanted.host {
        for column in 0..POSE {
            let mut carried = lanes.splat(0.0);
            for row in 0..POSE {
                carried = carried + lanes.splat(pair.by_host[row][column]) * mixed[row];
            }
            carried.store(&mut out.host[column][lane..]);
        }
    }
}

/// Adds to the sums of the pair.
#[inline(always)]
fn derive_poses<I: Instructions>(
    lanes: I,
    lane: usize,
    motion: &Motion<I::Register>,
    weighed: &Weighed<I::Register>,
    sums: &mut PairSums,
) {
    let add = |value: Floats<I>, to: &mut Lane| {
        (lanes.load(&to[lane..]) + value).store(&mut to[lane..]);
    };
    let mut entry = 0;
    for row in 0..POSE {
        // A column of M ∂π/∂p.
        let (u, v) = (motion.u[row], motion.v[row]);
        let a = weighed.uu * u + weighed.uv * v;
        let b = weighed.uv * u + weighed.vv * v;
        for column in row..POSE {
            add(motion.along(column, a, b), &mut sums.pose[entry]);
            entry += 1;
        }
        add(motion.along(row, weighed.right_u, weighed.right_v), &mut sums.right[row]);
    }
}
