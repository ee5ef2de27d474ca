//! The printed and grown surfaces of the scenes: wood, plaster, paper, fabric, pictures, brick.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

use rayon::prelude::*;

use crate::capture::simulator::canvas::{Canvas, Shape};
use crate::capture::simulator::random::Stream;
use crate::capture::simulator::texture::Texture;

/// Kinds of surfaces; each is one tileable texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub enum Pattern {
    /// Planks with grain, knots and gaps.
    Planks,
    /// Painted plaster: weak texture.
    Plaster,
    /// Wallpaper with a repeated motif over a mottled ground.
    Wallpaper,
    /// Overlapping shapes of all sizes.
    Picture,
    /// The same with fewer and larger shapes.
    Poster,
    /// Lines of printed words.
    Text,
    /// Cardboard with labels and tape.
    Cardboard,
    /// Woven fabric with a coarse pattern.
    Fabric,
    /// Fine-grained wood of furniture.
    Veneer,
    /// Brick wall.
    Brick,
    /// Carpet with a geometric print.
    Carpet,
    /// Bands and words of a book's cover.
    Cover,
}

/// Draws on the ground of a pattern.
type Draw = fn(&mut Canvas, &mut Stream);

/// All patterns in the order of their discriminants: reflectance of the ground, and the function that draws on it.
const PATTERNS: [(Pattern, f32, Draw); 12] = [
    (Pattern::Planks, 0.5, planks),
    (Pattern::Plaster, 0.66, plaster),
    (Pattern::Wallpaper, 0.62, wallpaper),
    (Pattern::Picture, 0.5, |canvas, stream| leaves(canvas, stream, 1500, 6.0, 220.0)),
    (Pattern::Poster, 0.5, |canvas, stream| leaves(canvas, stream, 500, 14.0, 300.0)),
    (Pattern::Text, 0.82, text),
    (Pattern::Cardboard, 0.48, cardboard),
    (Pattern::Fabric, 0.4, fabric),
    (Pattern::Veneer, 0.42, veneer),
    (Pattern::Brick, 0.7, brick),
    (Pattern::Carpet, 0.35, carpet),
    (Pattern::Cover, 0.5, cover),
];

/// Side of every texture in texels; at 2 mm per texel one tile is 2 m, and a pixel at 1 m is a texel.
pub const TEXTURE_SIZE: usize = 1024;

/// Paints all textures, in parallel on the current rayon pool.
pub fn paint_all(seed: u64) -> Vec<Texture> {
    let painted = PATTERNS.par_iter().map(|&(pattern, ground, draw)| {
        let mut canvas = Canvas::new(TEXTURE_SIZE, ground);
        draw(&mut canvas, &mut Stream::new(seed, 0x7E87_0000 + pattern as u64));
        canvas.into_texture()
    });
    painted.collect()
}

fn planks(canvas: &mut Canvas, stream: &mut Stream) {
    let (size, rows) = (canvas.size(), 16);
    let width = size / rows as f32;
    for row in 0..rows {
        let mut x = stream.uniform(0.0, size);
        for _ in 0..3 {
            let length = size / 3.0;
            let centre = [x + 0.5 * length, (row as f32 + 0.5) * width];
            let value = stream.uniform(0.34, 0.66);
            canvas.draw(Shape::Rectangle(0.5 * length, 0.5 * width), centre, 0.0, value, 1.0);
            canvas.draw(Shape::Rectangle(1.6, 0.5 * width), [x, centre[1]], 0.0, 0.12, 0.9);
            for _ in 0..2 {
                let knot = [
                    centre[0] + stream.uniform(-0.4, 0.4) * length,
                    centre[1] + stream.uniform(-0.3, 0.3) * width,
                ];
                let radius = stream.uniform(2.5, 9.0);
                canvas.draw(Shape::Ellipse(1.8 * radius, radius), knot, 0.0, value - 0.2, 0.8);
            }
            x += length;
        }
        canvas.draw(
            Shape::Rectangle(0.5 * size, 1.4),
            [0.5 * size, row as f32 * width],
            0.0,
            0.12,
            0.9,
        );
    }
    canvas.add_noise(stream.bits(), 64, 4, 0.065, 0.75, 16);
    canvas.add_noise(stream.bits(), 8, 6, 0.05, 0.7, 1);
}

fn plaster(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 4, 8, 0.06, 0.72, 1);
    // Scuffs and small holes: the few things a painted wall offers.
    for _ in 0..60 {
        let centre = [stream.uniform(0.0, canvas.size()), stream.uniform(0.0, canvas.size())];
        let shape = Shape::Ellipse(stream.uniform(2.0, 14.0), stream.uniform(1.5, 4.0));
        let value = stream.uniform(0.35, 0.85);
        canvas.draw(shape, centre, stream.uniform(0.0, PI), value, 0.5);
    }
}

fn wallpaper(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 4, 7, 0.10, 0.7, 1);
    let size = canvas.size();
    // Motifs at jittered places, each a little different, as in a hand-blocked paper.
    for cell in 0..36 {
        let place = |k: usize, jitter: f32| (k as f32 + 0.5 + jitter) * size / 6.0;
        let centre = [
            place(cell % 6, stream.uniform(-0.3, 0.3)),
            place(cell / 6, stream.uniform(-0.3, 0.3)),
        ];
        let turn = stream.uniform(0.0, PI);
        let value = stream.uniform(0.25, 0.5);
        let petals = 3 + stream.index(4);
        let radius = stream.uniform(18.0, 42.0);
        for petal in 0..petals {
            let angle = turn + petal as f32 * TAU / petals as f32;
            let at = [centre[0] + radius * angle.cos(), centre[1] + radius * angle.sin()];
            canvas.draw(Shape::Ellipse(0.6 * radius, 0.25 * radius), at, angle, value, 0.9);
        }
        canvas.draw(Shape::Ellipse(0.3 * radius, 0.3 * radius), centre, 0.0, 0.85, 0.9);
    }
}

fn leaves(canvas: &mut Canvas, stream: &mut Stream, count: usize, smallest: f32, largest: f32) {
    canvas.scatter_leaves(stream, count, smallest, largest);
    canvas.add_noise(stream.bits(), 8, 6, 0.05, 0.7, 1);
}

fn text(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 4, 6, 0.03, 0.7, 1);
    let size = canvas.size();
    let mut v = 30.0;
    while v < size - 20.0 {
        let heading = stream.index(7) == 0;
        let height = if heading { 13.0 } else { 6.0 };
        let mut u = 40.0;
        let end = size - stream.uniform(40.0, 320.0);
        while u < end {
            let width = stream.uniform(8.0, 46.0) * if heading { 1.8 } else { 1.0 };
            let value = stream.uniform(0.08, 0.3);
            let centre = [u + 0.5 * width, v];
            canvas.draw(Shape::Rectangle(0.5 * width, 0.5 * height), centre, 0.0, value, 0.9);
            for _ in 0..(width / 12.0) as usize {
                // Light gaps turn the bar into letters.
                let gap = [u + stream.uniform(0.1, 0.9) * width, v];
                let lean = stream.uniform(-0.5, 0.5);
                canvas.draw(Shape::Rectangle(1.2, 0.6 * height), gap, lean, 0.8, 0.9);
            }
            u += width + if heading { 18.0 } else { 10.0 };
        }
        v += 2.4 * height + if stream.index(6) == 0 { 24.0 } else { 0.0 };
    }
}

fn cardboard(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 8, 6, 0.07, 0.7, 1);
    let size = canvas.size();
    for _ in 0..26 {
        let centre = [stream.uniform(0.0, size), stream.uniform(0.0, size)];
        let turn = stream.uniform(-0.2, 0.2) + FRAC_PI_2 * stream.index(2) as f32;
        let (a, b) = (stream.uniform(26.0, 70.0), stream.uniform(18.0, 46.0));
        canvas.draw(Shape::Rectangle(a, b), centre, turn, stream.uniform(0.7, 0.9), 1.0);
        for line in 0..4 {
            let across = (line as f32 - 1.5) * 0.45 * b;
            let at = [centre[0] - turn.sin() * across, centre[1] + turn.cos() * across];
            let length = stream.uniform(0.3, 0.85) * a;
            canvas.draw(Shape::Rectangle(length, 0.1 * b), at, turn, stream.uniform(0.1, 0.4), 0.9);
        }
    }
    for _ in 0..5 {
        let centre = [stream.uniform(0.0, size), stream.uniform(0.0, size)];
        let turn = stream.uniform(0.0, PI);
        canvas.draw(Shape::Rectangle(240.0, 12.0), centre, turn, 0.66, 0.6);
    }
}

fn fabric(canvas: &mut Canvas, stream: &mut Stream) {
    let size = canvas.size();
    for stripe in 0..24 {
        let across = (stripe as f32 + stream.uniform(0.2, 0.8)) * size / 24.0;
        let half = stream.uniform(4.0, 14.0);
        let value = stream.uniform(0.2, 0.75);
        canvas.draw(Shape::Rectangle(half, 0.5 * size), [across, 0.5 * size], 0.0, value, 0.5);
        let value = stream.uniform(0.2, 0.75);
        canvas.draw(Shape::Rectangle(0.5 * size, half), [0.5 * size, across], 0.0, value, 0.5);
    }
    canvas.add_noise(stream.bits(), 32, 5, 0.08, 0.7, 1);
}

fn veneer(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 16, 6, 0.08, 0.7, 8);
    for _ in 0..40 {
        let centre = [stream.uniform(0.0, canvas.size()), stream.uniform(0.0, canvas.size())];
        let shape = Shape::Ellipse(stream.uniform(10.0, 50.0), stream.uniform(2.0, 6.0));
        canvas.draw(shape, centre, stream.uniform(-0.1, 0.1), stream.uniform(0.2, 0.32), 0.7);
    }
}

fn brick(canvas: &mut Canvas, stream: &mut Stream) {
    canvas.add_noise(stream.bits(), 32, 4, 0.06, 0.7, 1);
    let (width, height) = (128.0, 42.666_668);
    for row in 0..24 {
        for column in 0..8 {
            let centre =
                [(column as f32 + 0.5 * (row % 2) as f32) * width, (row as f32 + 0.5) * height];
            let turn = stream.uniform(-0.01, 0.01);
            let value = stream.uniform(0.24, 0.52);
            let shape = Shape::Rectangle(0.5 * width - 4.0, 0.5 * height - 4.0);
            canvas.draw(shape, centre, turn, value, 1.0);
        }
    }
    canvas.add_noise(stream.bits(), 16, 6, 0.05, 0.65, 1);
}

fn carpet(canvas: &mut Canvas, stream: &mut Stream) {
    let size = canvas.size();
    for cell in 0..64 {
        let centre = [(cell % 8) as f32 * size / 8.0 + 64.0, (cell / 8) as f32 * size / 8.0 + 64.0];
        let value = stream.uniform(0.2, 0.8);
        let turn = FRAC_PI_4 + stream.uniform(-0.15, 0.15);
        let half = stream.uniform(34.0, 56.0);
        canvas.draw(Shape::Rectangle(half, half), centre, turn, value, 1.0);
        let inner = stream.uniform(0.15, 0.85);
        canvas.draw(Shape::Ring(0.5 * half, 0.12 * half), centre, 0.0, inner, 1.0);
        let shape = Shape::Triangle(0.3 * half, 0.3 * half);
        canvas.draw(shape, centre, stream.uniform(0.0, TAU), stream.uniform(0.1, 0.9), 1.0);
    }
    canvas.add_noise(stream.bits(), 64, 4, 0.08, 0.8, 1);
}

fn cover(canvas: &mut Canvas, stream: &mut Stream) {
    let size = canvas.size();
    let mut v = 0.0;
    while v < size {
        let band = stream.uniform(12.0, 60.0);
        let value = stream.uniform(0.1, 0.85);
        let centre = [0.5 * size, v + 0.5 * band];
        canvas.draw(Shape::Rectangle(0.5 * size, 0.5 * band), centre, 0.0, value, 1.0);
        let mut u = stream.uniform(0.0, 30.0);
        while u < size {
            let width = stream.uniform(6.0, 34.0);
            let ink = if value > 0.45 { 0.1 } else { 0.85 };
            let height = stream.uniform(0.15, 0.35) * band;
            let at = [u, v + stream.uniform(0.3, 0.7) * band];
            canvas.draw(
                Shape::Rectangle(0.5 * width, height),
                at,
                stream.uniform(-0.3, 0.3),
                ink,
                0.8,
            );
            u += width + stream.uniform(10.0, 60.0);
        }
        v += band;
    }
    canvas.add_noise(stream.bits(), 16, 6, 0.05, 0.7, 1);
}
