//! Brightness of a face where rays meet it, many at a time.

use crate::capture::simulator::lens::Ray;
use crate::capture::simulator::scene::{Block, Face, Scene};
use crate::capture::simulator::texture::{Footprint, Texture};
use crate::capture::simulator::view::{LocalView, NO_SURFACE};
use crate::slam::kernel::{Floats, Instructions};

/// Side of the square that a pixel averages over, pixels: its own area and the blur of a good lens, which keeps detail
/// finer than the pixels out of the image.
pub const PIXEL_WIDTH: f32 = 1.4;
/// Brightness where there is no surface.
const SKY_GREY: f32 = 128.0;

/// A face as one camera sees it: everything that does not change from ray to ray.
#[derive(Debug, Clone, Copy)]
pub struct FaceView<'a> {
    block: &'a Block,
    face: &'a Face,
    texture: &'a Texture,
    view: &'a LocalView,
    axis: usize,
    /// +1 on the positive side of the axis.
    sign: f32,
    /// Image axes of the face, and the direction of the second: upright on walls, x and y on floors.
    right: usize,
    down: usize,
    flip: f32,
}

impl<'a> FaceView<'a> {
    /// Returns the view of a surface by its number; `None` for no surface.
    #[inline(always)]
    pub fn new(scene: &'a Scene, views: &'a [LocalView], surface: f32) -> Option<Self> {
        if surface == NO_SURFACE {
            return None;
        }
        let number = surface as usize;
        let (index, side) = (number >> 3, number & 7);
        let block = &scene.blocks[index];
        let face = &block.faces[side];
        let axis = side / 2;
        let (right, down, flip) = match axis {
            0 => (1, 2, -1.0),
            1 => (0, 2, -1.0),
            _ => (0, 1, 1.0),
        };
        let sign = if side & 1 == 1 { 1.0 } else { -1.0 };
        let (texture, view) = (&scene.textures[face.texture], &views[index]);
        Some(Self { block, face, texture, view, axis, sign, right, down, flip })
    }

    /// Brightness over the footprints of rays, grey levels; only the first `wanted` matter.
    #[inline(always)]
    pub fn grey<I: Instructions>(
        &self,
        lanes: I,
        wanted: usize,
        ray: &Ray<Floats<I>>,
    ) -> Floats<I> {
        let number = |x: f32| lanes.splat(x);
        let Self { view, face, axis, right, down, .. } = *self;
        let mut d = [number(0.0); 3];
        for k in 0..3 {
            d[k] = view.direction(lanes, k, ray.at);
        }
        // The plane of the face, which the ray meets even where another surface hides it.
        let depth = number(self.sign * view.half[axis] - view.origin[axis]) / d[axis];
        let mut point = d;
        for k in 0..3 {
            point[k] = number(view.origin[k]) + depth * d[k];
        }
        let density = [face.texels_per_metre[0], self.flip * face.texels_per_metre[1]];
        let centre = [
            number(face.offset[0]) + number(density[0]) * point[right],
            number(face.offset[1]) + number(density[1]) * point[down],
        ];
        let [du, dv] = [self.step(lanes, ray.du, d, depth), self.step(lanes, ray.dv, d, depth)];
        let [wide, high] = [number(PIXEL_WIDTH * density[0]), number(PIXEL_WIDTH * density[1])];
        let du = [wide * du[0], high * du[1]];
        let dv = [wide * dv[0], high * dv[1]];
        let texel = self.texture.sample(lanes, wanted, &Footprint { centre, du, dv });
        let deviation = number(face.contrast) * (texel - number(0.5));
        let reflectance = (number(face.middle) + deviation).max(number(0.02));
        let reflectance = reflectance.min(number(0.98));
        number(255.0) * reflectance * self.light(lanes, point)
    }

    /// How far the points that rays of direction `d` meet at `depth` move along the face when `d` changes, metres.
    #[inline(always)]
    fn step<I: Instructions>(
        &self,
        lanes: I,
        change: [Floats<I>; 2],
        d: [Floats<I>; 3],
        depth: Floats<I>,
    ) -> [Floats<I>; 2] {
        let mut turned = d;
        for k in 0..3 {
            let [x, y] = [lanes.splat(self.view.rows[k][0]), lanes.splat(self.view.rows[k][1])];
            turned[k] = x * change[0] + y * change[1];
        }
        // Along the face: the depth changes so that the point stays on the plane.
        let slide = turned[self.axis] / d[self.axis];
        let (right, down) = (self.right, self.down);
        [depth * (turned[right] - slide * d[right]), depth * (turned[down] - slide * d[down])]
    }

    /// Light on points of the face.
    #[inline(always)]
    fn light<I: Instructions>(&self, lanes: I, point: [Floats<I>; 3]) -> Floats<I> {
        let (block, number) = (self.block, |x: f32| lanes.splat(x));
        let (sin, cos) = block.turn;
        let [x, y, z] = point;
        let in_world = [
            number(block.centre[0]) + number(cos) * x - number(sin) * y,
            number(block.centre[1]) + number(sin) * x + number(cos) * y,
            number(block.centre[2]) + z,
        ];
        let outward = if block.is_hollow { -self.sign } else { self.sign };
        let normal = match self.axis {
            0 => [cos * outward, sin * outward, 0.0],
            1 => [-sin * outward, cos * outward, 0.0],
            _ => [0.0, 0.0, outward],
        };
        block.light(lanes, in_world, normal)
    }
}

/// Brightness of a surface, or of the sky for `None`.
#[inline(always)]
pub fn grey<I: Instructions>(
    lanes: I,
    face: Option<&FaceView<'_>>,
    wanted: usize,
    ray: &Ray<Floats<I>>,
) -> Floats<I> {
    match face {
        Some(face) => face.grey(lanes, wanted, ray),
        None => lanes.splat(SKY_GREY),
    }
}
