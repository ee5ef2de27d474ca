//! A tileable drawing surface: smooth noise and shapes with soft edges, wrapped at the borders.

use crate::capture::simulator::random::{Stream, mix2, unit};
use crate::capture::simulator::texture::Texture;

/// Half the width of a drawn edge, texels: two pixels from dark to light keep the texture free of steps that sampling
/// would turn into staircases.
const EDGE_TEXELS: f32 = 1.0;

/// A square of reflectances under construction.
#[derive(Debug, Clone)]
pub struct Canvas {
    size: usize,
    texels: Vec<f32>,
}

/// The outline of a drawn shape, in texels from its centre.
#[derive(Debug, Clone, Copy)]
pub enum Shape {
    /// Rectangle of half sides.
    Rectangle(f32, f32),
    /// Ellipse of half axes.
    Ellipse(f32, f32),
    /// Circle line of a radius and half a width.
    Ring(f32, f32),
    /// Isosceles triangle of half a base and half a height.
    Triangle(f32, f32),
}

impl Shape {
    /// Half sides of the rectangle around the shape.
    fn half_sides(self) -> (f32, f32) {
        match self {
            Self::Rectangle(a, b) | Self::Triangle(a, b) | Self::Ellipse(a, b) => (a, b),
            Self::Ring(radius, half_width) => (radius + half_width, radius + half_width),
        }
    }

    /// Approximate distance to the outline, negative inside.
    fn distance(self, x: f32, y: f32) -> f32 {
        match self {
            Self::Rectangle(a, b) => (x.abs() - a).max(y.abs() - b),
            Self::Ellipse(a, b) => (length(x / a, y / b) - 1.0) * a.min(b),
            Self::Ring(radius, half_width) => (length(x, y) - radius).abs() - half_width,
            Self::Triangle(a, b) => {
                let side = (x.abs() * 2.0 * b + (y - b) * a) / length(2.0 * b, a);
                side.max(-b - y)
            }
        }
    }
}

fn length(x: f32, y: f32) -> f32 {
    (x * x + y * y).sqrt()
}

impl Canvas {
    /// A surface of one reflectance; `size` is a power of two.
    pub fn new(size: usize, value: f32) -> Self {
        Self { size, texels: vec![value; size * size] }
    }

    /// Side in texels.
    pub fn size(&self) -> f32 {
        self.size as f32
    }

    /// Finishes the drawing; reflectances are limited to those of real surfaces.
    pub fn into_texture(mut self) -> Texture {
        self.texels.iter_mut().for_each(|texel| *texel = texel.clamp(0.02, 0.98));
        Texture::new(self.size, self.texels)
    }

    /// Adds noise of several octaves with zero mean: lattices from `cells` per side, each octave twice as fine and
    /// `persistence` times as strong, down to two texels. `stretch` is how many times longer the grain is along x than
    /// along y (a power of two).
    pub fn add_noise(
        &mut self,
        seed: u64,
        cells: usize,
        octaves: u32,
        amplitude: f32,
        persistence: f32,
        stretch: usize,
    ) {
        let mut strength = amplitude;
        for octave in 0..octaves {
            let along_y = cells << octave;
            let along_x = (along_y / stretch).max(1);
            if along_y * 2 > self.size {
                break;
            }
            self.add_octave(mix2(seed, u64::from(octave)), along_x, along_y, strength);
            strength *= persistence;
        }
    }

    /// One lattice of random values with quintic blending in between.
    fn add_octave(&mut self, seed: u64, cells_x: usize, cells_y: usize, strength: f32) {
        let lattice: Vec<f32> =
            (0..cells_x * cells_y).map(|i| unit(mix2(seed, i as u64)) * 2.0 - 1.0).collect();
        let columns: Vec<(usize, usize, f32)> =
            (0..self.size).map(|u| Self::cell(u, self.size, cells_x)).collect();
        let size = self.size;
        let mut blended = vec![0.0; cells_x];
        for (v, row) in self.texels.chunks_exact_mut(size).enumerate() {
            let (top, bottom, b) = Self::cell(v, size, cells_y);
            let (above, below) = (&lattice[top * cells_x..], &lattice[bottom * cells_x..]);
            for (out, (above, below)) in blended.iter_mut().zip(above.iter().zip(below)) {
                *out = strength * (above + b * (below - above));
            }
            for (out, &(left, right, a)) in row.iter_mut().zip(&columns) {
                *out += blended[left] + a * (blended[right] - blended[left]);
            }
        }
    }

    /// The lattice points before and after a texel, and the blend between them.
    fn cell(texel: usize, size: usize, cells: usize) -> (usize, usize, f32) {
        let place = (texel as f32 + 0.5) * cells as f32 / size as f32;
        let first = place as usize;
        let t = place - first as f32;
        (first % cells, (first + 1) % cells, t * t * t * (t * (t * 6.0 - 15.0) + 10.0))
    }

    /// Paints a shape of one reflectance over the drawing; an `opacity` of 1 hides what is below.
    pub fn draw(
        &mut self,
        shape: Shape,
        centre: [f32; 2],
        angle_rad: f32,
        value: f32,
        opacity: f32,
    ) {
        let (sin, cos) = angle_rad.sin_cos();
        let (a, b) = shape.half_sides();
        let half_u = (a * cos).abs() + (b * sin).abs() + 2.0 * EDGE_TEXELS;
        let half_v = (a * sin).abs() + (b * cos).abs() + 2.0 * EDGE_TEXELS;
        let mask = self.size as i32 - 1;
        let [cu, cv] = centre;
        for v in (cv - half_v) as i32 - 1..=(cv + half_v) as i32 + 1 {
            for u in (cu - half_u) as i32 - 1..=(cu + half_u) as i32 + 1 {
                let (dx, dy) = (u as f32 + 0.5 - cu, v as f32 + 0.5 - cv);
                let distance = shape.distance(cos * dx + sin * dy, cos * dy - sin * dx);
                let cover = (0.5 - 0.5 * distance / EDGE_TEXELS).clamp(0.0, 1.0) * opacity;
                if cover > 0.0 {
                    let at = (v & mask) as usize * self.size + (u & mask) as usize;
                    self.texels[at] += cover * (value - self.texels[at]);
                }
            }
        }
    }

    /// Covers the surface with `count` opaque shapes of all orientations, radii from `smallest` to `largest` texels
    /// with a density ∝ r⁻³: the dead-leaves model, whose edges, occlusions and spectrum are those of natural images
    /// (Lee, Mumford, Huang, IJCV 2001).
    pub fn scatter_leaves(
        &mut self,
        stream: &mut Stream,
        count: usize,
        smallest: f32,
        largest: f32,
    ) {
        // Large first, so that the small ones stay visible.
        let mut radii: Vec<f32> = (0..count)
            .map(|_| {
                let p = stream.uniform(0.0, 1.0);
                let (a, b) = (smallest.powi(-2), largest.powi(-2));
                (a + p * (b - a)).powf(-0.5)
            })
            .collect();
        radii.sort_by(|a, b| b.total_cmp(a));
        for radius in radii {
            let slim = stream.uniform(0.35, 1.0);
            let shape = match stream.index(5) {
                0 | 1 => Shape::Rectangle(radius, radius * slim),
                2 => Shape::Ellipse(radius, radius * slim),
                3 => Shape::Triangle(radius, radius * slim),
                _ => Shape::Ring(radius, (radius * 0.2).max(1.5)),
            };
            let centre = [stream.uniform(0.0, self.size()), stream.uniform(0.0, self.size())];
            let angle = stream.uniform(0.0, std::f32::consts::TAU);
            let value = stream.uniform(0.08, 0.92);
            self.draw(shape, centre, angle, value, 1.0);
        }
    }
}
