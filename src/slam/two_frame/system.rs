//! Residuals of the points in the current frame, and the normal equations of pose, brightness and
//! inverse depths.
//!
//! With x = K⁻¹p of a sample p of the pattern, q = R x + t d and p' = π(q) (R, t: current_from_first):
//!
//! ```text
//! r = I(p') − (c + b)     c = exp(a + s·x) I₀(p)
//! (α, β) = (g_u f_x, g_v f_y)/q_z      γ = −(α q_x + β q_y)/q_z      j = (α, β, γ)
//! ∂r/∂δ = (d j, q × j)     ∂r/∂d = j·t     ∂r/∂(a, b, s) = (−c, −1, −c x)
//! ```
//!
//! δ = (translation, rotation), `current_from_first ← exp(δ) current_from_first`. The slope s of the gain, over x and y
//! of the rays, models a vignette when the image moves across it. All of it stays finite at d = 0, a point at infinity.
//! Residuals and gradients are those of each sample; the derivatives of the projection are taken at the point itself
//! for its whole pattern (Engel, Koltun, Cremers 2018 §2.3), so that a sample adds to 14 sums and not to 80.

use nalgebra::{SMatrix, SVector};

use crate::slam::depth::pattern::{HUBER_GREY, PATTERN};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::two_frame::lanes::{
    FIRST_SLOPE, LANES, LaneSum, Lanes, NUM_UNKNOWNS, NormalSums, lanes, lanes_of,
};
use crate::slam::two_frame::points::PatchBlock;
use crate::slam::two_frame::sampling_kernel::WindowSampler;
use crate::slam::two_frame::state::State;

/// One level of the current frame and of the points.
#[derive(Debug, Clone, Copy)]
pub struct LevelView<'a> {
    /// The current frame.
    pub image: &'a Image<f32>,
    /// Its intrinsics.
    pub intrinsics: &'a Intrinsics,
    /// The points.
    pub patches: &'a [PatchBlock],
}

/// The part of the normal equations that belongs to the points of a block; all 0 where a point is not visible, except
/// for its energy.
#[derive(Debug, Clone, Copy)]
pub struct SystemBlock {
    /// Σ w ∂r/∂(pose, brightness) ∂r/∂d.
    pub mixed: [Lanes; NUM_UNKNOWNS],
    /// Σ w (∂r/∂d)².
    pub information: Lanes,
    /// Σ w r ∂r/∂d.
    pub gradient: Lanes,
    /// Σ ρ(r), weighted.
    pub energy: Lanes,
    /// Σ of the weights of the samples, without Huber's.
    pub weight: Lanes,
    /// Squared speed of the projection, pixels of the level per unit of inverse depth.
    pub squared_speed: Lanes,
    /// Whether the whole pattern falls into the current frame.
    pub visible: [bool; LANES],
}

/// One point of a [`SystemBlock`].
#[derive(Debug, Clone, Copy)]
pub struct PointSystem {
    /// Σ w ∂r/∂(pose, brightness) ∂r/∂d.
    pub mixed: [f32; NUM_UNKNOWNS],
    /// Σ w (∂r/∂d)².
    pub information: f32,
    /// Σ w r ∂r/∂d.
    pub gradient: f32,
    /// Σ ρ(r), weighted.
    pub energy: f32,
    /// Σ of the weights of the samples.
    pub weight: f32,
    /// Speed of the projection, squared.
    pub squared_speed: f32,
    /// Whether the whole pattern falls into the current frame.
    pub visible: bool,
}

/// Normal equations at one state.
#[derive(Debug, Clone, Default)]
pub struct System {
    /// The points' parts.
    pub blocks: Vec<SystemBlock>,
    /// Number of points.
    pub num_points: usize,
    /// JᵀWJ of pose and brightness.
    pub hessian: SMatrix<f64, NUM_UNKNOWNS, NUM_UNKNOWNS>,
    /// JᵀWr of pose and brightness.
    pub gradient: SVector<f64, NUM_UNKNOWNS>,
    /// Energy of all points; one out of view costs as much as a bad match, so that nothing is gained by
    /// looking away.
    pub energy: f64,
    /// Number of points in view.
    pub num_visible: usize,
    /// Whether the slopes of the gain are among the unknowns; where they are held their rows are zero.
    pub has_slopes: bool,
}

impl System {
    /// Number of free unknowns; these come first.
    pub fn num_unknowns(&self) -> usize {
        if self.has_slopes { NUM_UNKNOWNS } else { FIRST_SLOPE }
    }

    /// Each point's part.
    pub fn points(&self) -> impl Iterator<Item = PointSystem> {
        (0..self.num_points).map(|i| {
            let (block, l) = (&self.blocks[i / LANES], i % LANES);
            PointSystem {
                mixed: block.mixed.map(|lanes| lanes[l]),
                information: block.information[l],
                gradient: block.gradient[l],
                energy: block.energy[l],
                weight: block.weight[l],
                squared_speed: block.squared_speed[l],
                visible: block.visible[l],
            }
        })
    }

    #[inline(always)]
    pub(super) fn evaluate_blocks<S: WindowSampler>(
        &mut self,
        sampler: S,
        level: &LevelView<'_>,
        state: &State,
    ) {
        let geometry = Geometry::new(level.intrinsics, state);
        self.blocks.clear();
        self.num_points = state.inverse_depths.len();
        self.num_visible = 0;
        let (mut energy, mut sums) = (LaneSum::default(), NormalSums::default());
        for (i, patch) in level.patches.iter().enumerate() {
            let d = lanes_of(&state.inverse_depths, i, 1.0);
            let samples = PatternSums::of(sampler, level.image, &geometry, patch, &d);
            let block = samples.expand(&geometry, patch, &d, &mut sums);
            energy.add(&block.energy);
            self.num_visible += block.visible.iter().filter(|v| **v).count();
            self.blocks.push(block);
        }
        self.energy = energy.total();
        self.has_slopes = state.gain_slopes.is_some();
        for r in 0..NUM_UNKNOWNS {
            self.gradient[r] = sums.row(r);
            for c in 0..=r {
                self.hessian[(r, c)] = sums.entry(r, c);
                self.hessian[(c, r)] = self.hessian[(r, c)];
            }
        }
    }
}

/// Energies of two motions in one frame, over the points that both see: an unseen point tells nothing, and where the
/// images fit badly it would be cheaper than a match.
pub fn compare(one: &System, other: &System) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for (a, b) in one.blocks.iter().zip(&other.blocks) {
        for l in (0..LANES).filter(|&l| a.visible[l] && b.visible[l]) {
            sums[0] += f64::from(a.energy[l]);
            sums[1] += f64::from(b.energy[l]);
        }
    }
    sums
}

/// Energy of a point out of view: every sample at the end of Huber's parabola.
const HIDDEN_ENERGY: f32 = PATTERN.len() as f32 * HUBER_GREY * HUBER_GREY;

/// Pose and camera of one evaluation, in f32 for the samples.
struct Geometry {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    /// Offsets of q for the samples of the pattern.
    offsets: [[f32; 3]; 8],
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    gain: f32,
    offset: f32,
    gain_slopes: Option<[f32; 2]>,
}

impl Geometry {
    fn new(intrinsics: &Intrinsics, state: &State) -> Self {
        let rotation = state.current_from_first.rotation_matrix();
        let translation = state.current_from_first.translation;
        Self {
            rotation: [0, 1, 2].map(|r| [0, 1, 2].map(|c| rotation[(r, c)] as f32)),
            translation: [0, 1, 2].map(|r| translation[r] as f32),
            offsets: PATTERN.map(|(du, dv)| {
                let (x, y) = (f64::from(du) / intrinsics.fx, f64::from(dv) / intrinsics.fy);
                [0, 1, 2].map(|r| (rotation[(r, 0)] * x + rotation[(r, 1)] * y) as f32)
            }),
            fx: intrinsics.fx as f32,
            fy: intrinsics.fy as f32,
            cx: intrinsics.cx as f32,
            cy: intrinsics.cy as f32,
            gain: state.brightness.a.exp() as f32,
            offset: state.brightness.b as f32,
            gain_slopes: state.gain_slopes.map(|slopes| slopes.map(|slope| slope as f32)),
        }
    }

    /// x and y of the rays of points.
    #[inline(always)]
    fn rays(&self, patch: &PatchBlock) -> [Lanes; 2] {
        [lanes(|l| (patch.u[l] - self.cx) / self.fx), lanes(|l| (patch.v[l] - self.cy) / self.fy)]
    }

    /// The gains of points on the rays, and the derivatives of their logarithms by the slopes. The exponential is its
    /// second-order series, which is never below ½.
    #[inline(always)]
    fn gains(&self, rays: &[Lanes; 2]) -> (Lanes, Option<[Lanes; 2]>) {
        let Some([by_x, by_y]) = self.gain_slopes else { return ([self.gain; LANES], None) };
        let [x, y] = rays;
        let grown = lanes(|l| by_x * x[l] + by_y * y[l]);
        let factor = lanes(|l| 1.0 + grown[l] + 0.5 * grown[l] * grown[l]);
        let gain = lanes(|l| self.gain * factor[l]);
        let by_slopes = rays.map(|ray| lanes(|l| ray[l] * (1.0 + grown[l]) / factor[l]));
        (gain, Some(by_slopes))
    }

    /// q of points of inverse depth `d` on the rays.
    #[inline(always)]
    fn moved(&self, [x, y]: &[Lanes; 2], d: &Lanes) -> [Lanes; 3] {
        let (m, t) = (&self.rotation, &self.translation);
        [0, 1, 2].map(|r| lanes(|l| m[r][0] * x[l] + m[r][1] * y[l] + m[r][2] + t[r] * d[l]))
    }

    /// Projection of sample `k` of points at `q`: column, row, and its depth ratio.
    #[inline(always)]
    fn project(&self, q: &[Lanes; 3], k: usize) -> [Lanes; 3] {
        let offset = &self.offsets[k];
        let z = lanes(|l| q[2][l] + offset[2]);
        let inverse_z = lanes(|l| 1.0 / z[l]);
        let u = lanes(|l| self.fx * (q[0][l] + offset[0]) * inverse_z[l] + self.cx);
        let v = lanes(|l| self.fy * (q[1][l] + offset[1]) * inverse_z[l] + self.cy);
        [u, v, z]
    }
}

/// Sums over the samples of each point's pattern. w is the weight including Huber's.
struct PatternSums {
    /// ∂ ln c/∂s, of which all derivatives of c by s are multiples; `None` where s is held.
    by_slopes: Option<[Lanes; 2]>,
    /// q of the point itself.
    q: [Lanes; 3],
    /// Σ w (g_u², g_u g_v, g_v²).
    squares: [Lanes; 3],
    /// Σ w g_u (c, 1).
    by_u: [Lanes; 2],
    /// Σ w g_v (c, 1).
    by_v: [Lanes; 2],
    /// Σ w (c², c, 1).
    by_brightness: [Lanes; 3],
    /// Σ w r (g_u, g_v, c, 1).
    residuals: [Lanes; 4],
    energy: Lanes,
    visible: [bool; LANES],
}

impl PatternSums {
    #[inline(always)]
    fn of<S: WindowSampler>(
        sampler: S,
        image: &Image<f32>,
        geometry: &Geometry,
        patch: &PatchBlock,
        d: &Lanes,
    ) -> Self {
        /// Depth ratio below which a point counts as behind the camera.
        const MIN_DEPTH_RATIO: f32 = 0.05;
        // One pixel inside the border, where the central difference is defined.
        let (last_u, last_v) = ((image.width() - 2) as f32, (image.height() - 2) as f32);
        let rays = geometry.rays(patch);
        let (gain, by_slopes) = geometry.gains(&rays);
        let mut sums = Self {
            by_slopes,
            q: geometry.moved(&rays, d),
            squares: [[0.0; LANES]; 3],
            by_u: [[0.0; LANES]; 2],
            by_v: [[0.0; LANES]; 2],
            by_brightness: [[0.0; LANES]; 3],
            residuals: [[0.0; LANES]; 4],
            energy: [0.0; LANES],
            visible: patch.weight.map(|weight| weight > 0.0),
        };
        for k in 0..PATTERN.len() {
            let [u, v, z] = geometry.project(&sums.q, k);
            for l in 0..LANES {
                let is_inside = (u[l] >= 1.0) & (v[l] >= 1.0) & (u[l] < last_u) & (v[l] < last_v);
                sums.visible[l] &= is_inside & (z[l] > MIN_DEPTH_RATIO);
            }
            let c = lanes(|l| gain[l] * patch.intensities[k][l]);
            let [brightness, gu, gv] = sampler.sample(image, &u, &v);
            for l in 0..LANES {
                // NaN: no data.
                sums.visible[l] &= (brightness[l] >= 0.0) & (gu[l] + gv[l] > f32::NEG_INFINITY);
            }
            let r = lanes(|l| brightness[l] - (c[l] + geometry.offset));
            sums.add_sample(&r, [&gu, &gv], &c, &patch.weights[k]);
        }
        sums
    }

    /// Adds a sample of each point, with residual `r`.
    #[inline(always)]
    fn add_sample(&mut self, r: &Lanes, [gu, gv]: [&Lanes; 2], c: &Lanes, weight: &Lanes) {
        let huber = lanes(|l| {
            let size = r[l].abs();
            HUBER_GREY / if size > HUBER_GREY { size } else { HUBER_GREY }
        });
        let w = lanes(|l| huber[l] * weight[l]);
        let (wu, wv) = (lanes(|l| w[l] * gu[l]), lanes(|l| w[l] * gv[l]));
        let (wc, wr) = (lanes(|l| w[l] * c[l]), lanes(|l| w[l] * r[l]));
        add_product(&mut self.squares[0], &wu, gu);
        add_product(&mut self.squares[1], &wu, gv);
        add_product(&mut self.squares[2], &wv, gv);
        add_product(&mut self.by_u[0], &wu, c);
        add(&mut self.by_u[1], &wu);
        add_product(&mut self.by_v[0], &wv, c);
        add(&mut self.by_v[1], &wv);
        add_product(&mut self.by_brightness[0], &wc, c);
        add(&mut self.by_brightness[1], &wc);
        add(&mut self.by_brightness[2], &w);
        add_product(&mut self.residuals[0], &wr, gu);
        add_product(&mut self.residuals[1], &wr, gv);
        add_product(&mut self.residuals[2], &wr, c);
        add(&mut self.residuals[3], &wr);
        for l in 0..LANES {
            self.energy[l] += (2.0 - huber[l]) * wr[l] * r[l];
        }
    }

    /// The normal equations of the block; those of the pose are added to `normal`.
    #[inline(always)]
    fn expand(
        mut self,
        geometry: &Geometry,
        patch: &PatchBlock,
        d: &Lanes,
        normal: &mut NormalSums,
    ) -> SystemBlock {
        self.clear_hidden(patch);
        let visible = self.visible;
        let d = lanes(|l| if visible[l] { d[l] } else { 0.0 });
        let motion = displacement(geometry, &self.q, &d);
        let mixed = self.add_to(normal, &motion);
        let Displacement { speed_u, speed_v, .. } = motion;
        let ([uu, uv, vv], [ru, rv, ..]) = (&self.squares, &self.residuals);
        SystemBlock {
            mixed,
            information: lanes(|l| {
                let squared = (uu[l] * speed_u[l] + 2.0 * uv[l] * speed_v[l]) * speed_u[l]
                    + vv[l] * speed_v[l] * speed_v[l];
                // A sum of squares: rounding of terms that cancel must not make it negative.
                squared.max(0.0)
            }),
            gradient: lanes(|l| ru[l] * speed_u[l] + rv[l] * speed_v[l]),
            energy: self.energy,
            weight: lanes(|l| if visible[l] { patch.weight[l] } else { 0.0 }),
            squared_speed: lanes(|l| speed_u[l] * speed_u[l] + speed_v[l] * speed_v[l]),
            visible,
        }
    }

    /// Clears all but the energy of the points out of view: their lanes may not be finite, and 0 times that is not 0.
    #[inline(always)]
    fn clear_hidden(&mut self, patch: &PatchBlock) {
        let visible = self.visible;
        if visible == [true; LANES] {
            return;
        }
        let groups = [&mut self.squares[..], &mut self.by_u, &mut self.by_v];
        let groups = groups.into_iter().chain([&mut self.by_brightness[..], &mut self.residuals]);
        for sum in groups.flatten() {
            *sum = lanes(|l| if visible[l] { sum[l] } else { 0.0 });
        }
        let hidden = lanes(|l| if patch.weight[l] > 0.0 { HIDDEN_ENERGY } else { 0.0 });
        self.energy = lanes(|l| if visible[l] { self.energy[l] } else { hidden[l] });
        self.q = [
            lanes(|l| if visible[l] { self.q[0][l] } else { 0.0 }),
            lanes(|l| if visible[l] { self.q[1][l] } else { 0.0 }),
            lanes(|l| if visible[l] { self.q[2][l] } else { 1.0 }),
        ];
    }

    /// Adds to the normal equations of pose and brightness; returns their products with ∂r/∂d.
    #[inline(always)]
    fn add_to(&self, normal: &mut NormalSums, motion: &Displacement) -> [Lanes; NUM_UNKNOWNS] {
        let Displacement { by_u, by_v, speed_u, speed_v } = motion;
        let [uu, uv, vv] = &self.squares;
        let [ru, rv, rc, r1] = &self.residuals;
        let mut mixed = [[0.0; LANES]; NUM_UNKNOWNS];
        for i in 0..6 {
            let along_u = lanes(|l| uu[l] * by_u[i][l] + uv[l] * by_v[i][l]);
            let along_v = lanes(|l| uv[l] * by_u[i][l] + vv[l] * by_v[i][l]);
            mixed[i] = lanes(|l| along_u[l] * speed_u[l] + along_v[l] * speed_v[l]);
            normal.add_row(i, &lanes(|l| ru[l] * by_u[i][l] + rv[l] * by_v[i][l]));
            for c in 0..=i {
                let entry = lanes(|l| along_u[l] * by_u[c][l] + along_v[l] * by_v[c][l]);
                normal.add_entry(i, c, &entry);
            }
            for b in 0..2 {
                let (u, v) = (&self.by_u[b], &self.by_v[b]);
                let entry = lanes(|l| -(u[l] * by_u[i][l] + v[l] * by_v[i][l]));
                normal.add_entry(6 + b, i, &entry);
                // Slopes scale the first of the two, the gain.
                if b == 0 {
                    for (s, x) in self.by_slopes.iter().flatten().enumerate() {
                        normal.add_entry(FIRST_SLOPE + s, i, &product(x, &entry));
                    }
                }
            }
        }
        for b in 0..2 {
            let (u, v) = (&self.by_u[b], &self.by_v[b]);
            mixed[6 + b] = lanes(|l| -(u[l] * speed_u[l] + v[l] * speed_v[l]));
        }
        normal.add_row(6, &lanes(|l| -rc[l]));
        normal.add_row(7, &lanes(|l| -r1[l]));
        normal.add_entry(6, 6, &self.by_brightness[0]);
        normal.add_entry(7, 6, &self.by_brightness[1]);
        normal.add_entry(7, 7, &self.by_brightness[2]);
        for (s, x) in self.by_slopes.iter().flatten().enumerate() {
            let row = FIRST_SLOPE + s;
            mixed[row] = product(x, &mixed[6]);
            normal.add_row(row, &lanes(|l| -x[l] * rc[l]));
            let by_brightness = [0, 1].map(|b| product(x, &self.by_brightness[b]));
            (0..2).for_each(|b| normal.add_entry(row, 6 + b, &by_brightness[b]));
            for (t, y) in self.by_slopes.iter().flatten().take(s + 1).enumerate() {
                normal.add_entry(row, FIRST_SLOPE + t, &product(y, &by_brightness[0]));
            }
        }
        mixed
    }
}

/// Derivatives of the points' projections.
struct Displacement {
    /// By each unknown of the pose, pixels.
    by_u: [Lanes; 6],
    by_v: [Lanes; 6],
    /// By inverse depth, pixels.
    speed_u: Lanes,
    speed_v: Lanes,
}

/// Derivatives for points at `q` of inverse depth `d`.
#[inline(always)]
fn displacement(geometry: &Geometry, q: &[Lanes; 3], d: &Lanes) -> Displacement {
    let t = &geometry.translation;
    let inverse_z = lanes(|l| 1.0 / q[2][l]);
    let alpha = lanes(|l| geometry.fx * inverse_z[l]);
    let beta = lanes(|l| geometry.fy * inverse_z[l]);
    let gamma_u = lanes(|l| -alpha[l] * q[0][l] * inverse_z[l]);
    let gamma_v = lanes(|l| -beta[l] * q[1][l] * inverse_z[l]);
    let zero = [0.0; LANES];
    let by_u = [
        lanes(|l| d[l] * alpha[l]),
        zero,
        lanes(|l| d[l] * gamma_u[l]),
        lanes(|l| q[1][l] * gamma_u[l]),
        lanes(|l| q[2][l] * alpha[l] - q[0][l] * gamma_u[l]),
        lanes(|l| -q[1][l] * alpha[l]),
    ];
    let by_v = [
        zero,
        lanes(|l| d[l] * beta[l]),
        lanes(|l| d[l] * gamma_v[l]),
        lanes(|l| q[1][l] * gamma_v[l] - q[2][l] * beta[l]),
        lanes(|l| -q[0][l] * gamma_v[l]),
        lanes(|l| q[0][l] * beta[l]),
    ];
    let speed_u = lanes(|l| alpha[l] * t[0] + gamma_u[l] * t[2]);
    let speed_v = lanes(|l| beta[l] * t[1] + gamma_v[l] * t[2]);
    Displacement { by_u, by_v, speed_u, speed_v }
}

#[inline(always)]
fn add(sum: &mut Lanes, value: &Lanes) {
    for l in 0..LANES {
        sum[l] += value[l];
    }
}

#[inline(always)]
fn product(a: &Lanes, b: &Lanes) -> Lanes {
    lanes(|l| a[l] * b[l])
}

#[inline(always)]
fn add_product(sum: &mut Lanes, a: &Lanes, b: &Lanes) {
    for l in 0..LANES {
        sum[l] += a[l] * b[l];
    }
}
