//! Which pixels a frame promises to observe well: the criterion of
//! [`condition`](crate::slam::depth::matching::condition) for a register of pixels at once.
//!
//! Short loops over arrays, which every compiler vectorises; the operations are those of the criterion for a single
//! pixel, so both decide alike to the last bit.

use crate::slam::depth::epipolar::{MIN_DEPTH_RATIO, TwoView};
use crate::slam::depth::gain::{Gain, Uncertainty};
use crate::slam::depth::matching::{DETERMINANT, MARGIN_PX, MatchingParams};
use crate::slam::depth::pattern::PATTERN;

/// Pixels that are tested at once: a register of the widest vector unit.
pub const LANES: usize = 16;

type Lanes = [f32; LANES];

/// The state of [`LANES`] pixels of a row, by quantity.
#[derive(Debug, Clone, Default)]
pub struct PixelLanes {
    /// Column.
    pub u: Lanes,
    /// Inverse depth at the centre of the search.
    pub inverse_depth: Lanes,
    /// Variance of the inverse depth.
    pub variance: Lanes,
    /// Its independent part.
    pub independent: Lanes,
    /// Σ (g_u², g_u g_v, g_v²) over the patch.
    pub structure: [Lanes; 3],
}

/// Positions in the frame of the pixels of a row.
struct Projected {
    u: [f32; LANES],
    v: [f32; LANES],
    /// Depth in the keyframe over depth in the frame.
    depth_ratio: [f32; LANES],
    /// Displacement by the translation, focal lengths.
    parallax: [f32; LANES],
    is_inside: [bool; LANES],
}

/// Directions of the epipolar lines in the keyframe, and the inverse depth per pixel along them.
struct Lines {
    /// Along the line and across it, keyframe pixels per frame pixel.
    along: [[f32; LANES]; 2],
    across: [[f32; LANES]; 2],
    inverse_depth_per_px: [f32; LANES],
    is_regular: [bool; LANES],
}

/// Whether each pixel of row `v` is seen within a frame of `size` (width, height), and one match there promises to
/// reduce its variance to the share `enough` or less.
#[inline(always)]
pub fn worth_observing(
    pixels: &PixelLanes,
    v: f32,
    view: &TwoView,
    size: (usize, usize),
    gain: f32,
    enough: f32,
    params: &MatchingParams,
) -> [bool; LANES] {
    let at = project(pixels, v, view, size);
    let lines = lines(&at, view);
    let mut worth_observing = [false; LANES];
    let samples = PATTERN.len() as f32;
    let pixel_std_dev = params.noise.pixel_std_dev;
    let noise = (1.0 + gain * gain) * pixel_std_dev * pixel_std_dev;
    let least = samples * params.min_line_gradient * params.min_line_gradient;
    let [structure_uu, structure_uv, structure_vv] = &pixels.structure;
    for k in 0..LANES {
        let uu = gain * gain * structure_uu[k];
        let uv = gain * gain * structure_uv[k];
        let vv = gain * gain * structure_vv[k];
        let (a, b) = (lines.along[0][k], lines.along[1][k]);
        let (c, d) = (lines.across[0][k], lines.across[1][k]);
        let measured = uu * a * a + uv * (a * b + b * a) + vv * b * b;
        let by_noise = 0.5 * samples * (gain * pixel_std_dev).powi(2) * (a * a + b * b);
        let information = measured - by_noise;
        let tangent = (uu * a * c + uv * (a * d + b * c) + vv * b * d) / information;
        let geometric = params.line_noise_px * params.line_noise_px * (1.0 + tangent * tangent);
        let photometric = noise * measured / (information * information);
        let slant = params.slant_noise_px * at.parallax[k];
        let sampling = params.sampling_noise_px * params.sampling_noise_px + slant * slant;
        let match_variance = geometric + photometric + sampling;
        let independent = params.independent_line_ratio * geometric
            + photometric / (1.0 + gain * gain)
            + params.sampling_noise_px * params.sampling_noise_px;
        let factor = lines.inverse_depth_per_px[k] * lines.inverse_depth_per_px[k];
        let (variance, known) = (pixels.variance[k], pixels.independent[k]);
        let left = Gain::of(
            Uncertainty { variance, independent: known },
            Uncertainty { variance: factor * match_variance, independent: factor * independent },
        )
        .left;
        worth_observing[k] = at.is_inside[k]
            & lines.is_regular[k]
            & (information >= least)
            & !(left.variance > enough * variance);
    }
    worth_observing
}

#[inline(always)]
fn project(pixels: &PixelLanes, v: f32, view: &TwoView, size: (usize, usize)) -> Projected {
    let (m, kt) = (&view.rotation, &view.translation);
    let zero = [0.0; LANES];
    let mut at = Projected {
        u: zero,
        v: zero,
        depth_ratio: zero,
        parallax: zero,
        is_inside: [false; LANES],
    };
    let right = size.0 as f32 - 1.0 - MARGIN_PX;
    let bottom = size.1 as f32 - 1.0 - MARGIN_PX;
    for k in 0..LANES {
        let (u, d) = (pixels.u[k], pixels.inverse_depth[k]);
        let pr_u = m[0][0] * u + m[0][1] * v + m[0][2];
        let pr_v = m[1][0] * u + m[1][1] * v + m[1][2];
        let pr_z = m[2][0] * u + m[2][1] * v + m[2][2];
        let z = pr_z + kt[2] * d;
        at.depth_ratio[k] = 1.0 / z;
        at.u[k] = (pr_u + kt[0] * d) * at.depth_ratio[k];
        at.v[k] = (pr_v + kt[1] * d) * at.depth_ratio[k];
        let (du, dv) = (at.u[k] - pr_u / pr_z, at.v[k] - pr_v / pr_z);
        at.parallax[k] = (du * du + dv * dv).sqrt() * view.per_focal_length;
        at.is_inside[k] = (z > MIN_DEPTH_RATIO)
            & (at.u[k] >= MARGIN_PX)
            & (at.v[k] >= MARGIN_PX)
            & (at.u[k] < right)
            & (at.v[k] < bottom);
    }
    at
}

#[inline(always)]
fn lines(at: &Projected, view: &TwoView) -> Lines {
    let (m, kt) = (&view.rotation, &view.translation);
    let zero = [0.0; LANES];
    let mut lines = Lines {
        along: [zero; 2],
        across: [zero; 2],
        inverse_depth_per_px: zero,
        is_regular: [false; LANES],
    };
    for k in 0..LANES {
        let (u, v, s) = (at.u[k], at.v[k], at.depth_ratio[k]);
        let (speed_u, speed_v) = ((kt[0] - kt[2] * u) * s, (kt[1] - kt[2] * v) * s);
        let speed = (speed_u * speed_u + speed_v * speed_v).sqrt();
        let (du, dv) = (speed_u / speed, speed_v / speed);
        let (uu, uv) = ((m[0][0] - u * m[2][0]) * s, (m[0][1] - u * m[2][1]) * s);
        let (vu, vv) = ((m[1][0] - v * m[2][0]) * s, (m[1][1] - v * m[2][1]) * s);
        let determinant = uu * vv - uv * vu;
        let (a, b) = (vv / determinant, -uv / determinant);
        let (c, d) = (-vu / determinant, uu / determinant);
        (lines.along[0][k], lines.along[1][k]) = (a * du + b * dv, c * du + d * dv);
        (lines.across[0][k], lines.across[1][k]) = (-a * dv + b * du, -c * dv + d * du);
        lines.inverse_depth_per_px[k] = 1.0 / speed;
        lines.is_regular[k] = (speed > f32::MIN_POSITIVE) & DETERMINANT.contains(&determinant);
    }
    lines
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;
    use crate::slam::depth::matching::{condition, is_inside};
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;

    #[test]
    fn a_register_of_pixels_decides_like_each_single_pixel() {
        let camera =
            Intrinsics { fx: 200.0, fy: 190.0, cx: 99.5, cy: 74.5, width: 200, height: 150 };
        const ENOUGH: f32 = 0.7;
        let params = MatchingParams::default();
        let (mut kept, mut judged) = (0, 0);
        for i in 0..400usize {
            let vary = |step: usize, scale: f64| ((i * step % 97) as f64 / 48.0 - 1.0) * scale;
            let motion = SE3::exp(&Vector6::new(
                vary(5, 0.2),
                vary(7, 0.2),
                vary(11, 0.4),
                vary(13, 0.2),
                vary(17, 0.2),
                vary(19, 0.8),
            ));
            let view = TwoView::new(&camera, &motion);
            let (v, gain) = (5.0 + (i % 140) as f32, 0.7 + (i % 7) as f32 * 0.1);
            let random = |k: usize, step: usize| ((i * 31 + k * step) % 101) as f32 / 100.0;
            let mut pixels = PixelLanes::default();
            for k in 0..LANES {
                pixels.u[k] = 4.0 + (i * 3 + k * 11) as f32 % 190.0;
                pixels.inverse_depth[k] = 3.0 * random(k, 17);
                pixels.variance[k] = 1e-5 * 1e4f32.powf(random(k, 29));
                pixels.independent[k] = pixels.variance[k] * random(k, 13);
                let (gu, gv) = (30.0 * random(k, 7), 30.0 * random(k, 3));
                let (uu, uv, vv) = (8.0 * gu * gu, 6.0 * gu * gv, 8.0 * gv * gv);
                for (plane, sum) in pixels.structure.iter_mut().zip([uu, uv, vv]) {
                    plane[k] = sum;
                }
            }
            let together = worth_observing(
                &pixels,
                v,
                &view,
                (camera.width, camera.height),
                gain,
                ENOUGH,
                &params,
            );
            for k in 0..LANES {
                let line = view.line(pixels.u[k], v);
                let alone = line
                    .project(pixels.inverse_depth[k])
                    .filter(|p| is_inside(camera.width, camera.height, p.u, p.v))
                    .and_then(|at| {
                        let structure = pixels.structure.map(|plane| plane[k]);
                        condition(&view, &line, &at, &structure, gain, &params)
                    })
                    .is_some_and(|c| {
                        let (variance, independent) = (pixels.variance[k], pixels.independent[k]);
                        let known = Uncertainty { variance, independent };
                        !(Gain::of(known, c.predicted_uncertainty()).left.variance
                            > ENOUGH * variance)
                    });
                assert_eq!(together[k], alone, "motion {i}, pixel {k}");
                kept += usize::from(alone);
                judged += 1;
            }
        }
        assert!(kept > judged / 20 && kept < judged * 19 / 20, "{kept} of {judged}");
    }
}
