//! From light to bytes: vignette, exposure, noise, quantisation.

use rayon::prelude::*;

use crate::capture::simulator::params::SensorParams;
use crate::capture::simulator::random::{Normal, mix2};

/// A sensor of one size.
#[derive(Debug)]
pub struct Sensor {
    params: SensorParams,
    seed: u64,
    normal: Normal,
    /// Share of light that reaches each pixel; empty without vignette.
    vignette: Vec<f32>,
}

impl Sensor {
    /// A sensor for images of this size; `seed` chooses its noise.
    pub fn new(params: &SensorParams, seed: u64, width: usize, height: usize) -> Self {
        let vignette =
            if params.vignette > 0.0 { vignette(params.vignette, width, height) } else { vec![] };
        Self {
            params: params.clone(),
            seed: mix2(seed, 0x5E50),
            normal: Normal::default(),
            vignette,
        }
    }

    /// Gain and offset (grey levels) of the exposure at a time from the start: 1 and 0 at the start.
    pub fn exposure(&self, time_s: f64) -> (f64, f64) {
        let phase = std::f64::consts::TAU * time_s / self.params.exposure_period_s;
        let gain = (self.params.gain_amplitude * phase.sin()).exp();
        // A different rate, so that gain and offset do not change in step.
        (gain, self.params.offset_amplitude * (1.618 * phase).sin())
    }

    /// Quantises the light of frame `sequence` taken at `time_s`, with noise that depends only on seed, frame and
    /// pixel.
    pub fn read_out(&self, sequence: u64, time_s: f64, light: &mut [f32], pixels: &mut [u8]) {
        let (gain, offset) = self.exposure(time_s);
        let (gain, offset) = (gain as f32, offset as f32);
        for (value, share) in light.iter_mut().zip(&self.vignette) {
            *value *= share;
        }
        let noise = self.params.noise_std_dev as f32;
        let key = mix2(self.seed, sequence);
        // One hash serves two pixels, 24 bits each.
        for (pair, (out, light)) in pixels.chunks_mut(2).zip(light.chunks(2)).enumerate() {
            let mut bits = if noise > 0.0 { mix2(key, pair as u64) } else { 0 };
            for (out, &light) in out.iter_mut().zip(light) {
                let error = if noise > 0.0 { noise * self.normal.sample(bits) } else { 0.0 };
                *out = (gain * light + offset + error + 0.5).clamp(0.0, 255.0) as u8;
                bits >>= 24;
            }
        }
    }
}

/// 1 in the centre, `1 − loss` in the corner, falling with the fourth power of the radius.
fn vignette(loss: f64, width: usize, height: usize) -> Vec<f32> {
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let corner = cx * cx + cy * cy;
    (0..width * height)
        .into_par_iter()
        .map(|i| {
            let (x, y) = ((i % width) as f64 - cx, (i / width) as f64 - cy);
            let squared = (x * x + y * y) / corner;
            (1.0 - loss * squared * squared) as f32
        })
        .collect()
}
