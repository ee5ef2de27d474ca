//! Ray casting: which surface every pixel sees, how far away, and how bright.

use nalgebra::{Matrix3, Vector3};

use crate::capture::simulator::cull::{NearBlock, TileLists};
use crate::capture::simulator::lens::{Lens, NEAREST_M, Ray};
use crate::capture::simulator::scene::{Block, Scene};
use crate::capture::simulator::texture::Footprint;
use crate::slam::geometry::se3::SE3;

/// Side of the grid of rays cast through a pixel that an edge crosses.
const EDGE_GRID: usize = 4;
/// Side of the square that a pixel averages over, pixels: its own area and the blur of a good lens,
/// which keeps what is finer than the pixels out of the image.
const PIXEL_WIDTH: f32 = 1.4;
/// Brightness where no surface is.
const SKY_GREY: f32 = 128.0;
/// A pixel that sees nothing.
const NO_SURFACE: u32 = u32::MAX;

/// What a ray meets.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Depth along the optical axis, metres; infinite where nothing is.
    pub depth: f32,
    /// Block × 8 + face, all ones where nothing is.
    pub surface: u32,
}

/// A block as one camera sees it: everything that does not change from ray to ray.
#[derive(Debug, Clone, Copy)]
pub struct LocalView {
    /// Camera centre in the block's axes, from its centre.
    origin: [f32; 3],
    /// Rows of the rotation from camera to block.
    rows: [[f32; 3]; 3],
    half: [f32; 3],
    is_hollow: bool,
}

impl LocalView {
    /// A block seen from a camera pose, metres.
    pub fn new(block: &Block, rotation: &Matrix3<f64>, camera_in_world: &Vector3<f64>) -> Self {
        let (sin, cos) = (f64::from(block.turn.0), f64::from(block.turn.1));
        let block_from_world = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
        let centre = Vector3::from(block.centre.map(f64::from));
        let origin = block_from_world * (camera_in_world - centre);
        let m = block_from_world * rotation;
        Self {
            origin: [origin.x as f32, origin.y as f32, origin.z as f32],
            rows: std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)] as f32)),
            half: block.half,
            is_hollow: block.is_hollow,
        }
    }

    #[inline]
    fn direction(&self, x: f32, y: f32) -> [f32; 3] {
        let row = |r: &[f32; 3]| r[0] * x + r[1] * y + r[2];
        [row(&self.rows[0]), row(&self.rows[1]), row(&self.rows[2])]
    }

    /// Depth at which the ray enters (a hollow block: leaves); infinite where it misses.
    #[inline]
    fn depth(&self, x: f32, y: f32) -> f32 {
        let d = self.direction(x, y);
        let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
        for k in 0..3 {
            let inverse = 1.0 / d[k];
            let middle = -self.origin[k] * inverse;
            let reach = (self.half[k] * inverse).abs();
            enter = enter.max(middle - reach);
            leave = leave.min(middle + reach);
        }
        let depth = if self.is_hollow { leave } else { enter };
        if enter < leave && depth > NEAREST_M { depth } else { f32::INFINITY }
    }

    /// The face a ray meets at `depth`: 2 × axis, plus 1 on the positive side.
    #[inline]
    fn face(&self, x: f32, y: f32, depth: f32) -> u32 {
        let d = self.direction(x, y);
        let mut best = (f32::NEG_INFINITY, 0);
        for k in 0..3 {
            let place = self.origin[k] + depth * d[k];
            let outside = place.abs() - self.half[k];
            if outside > best.0 {
                best = (outside, 2 * k as u32 + u32::from(place > 0.0));
            }
        }
        best.1
    }
}

/// Reused memory of a renderer: one for each thread.
#[derive(Debug, Default)]
pub struct RenderScratch {
    hits: Vec<Hit>,
    locals: Vec<LocalView>,
    lists: TileLists,
}

/// Renders a scene through a lens.
#[derive(Debug)]
pub struct Renderer<'a> {
    /// What is seen.
    pub scene: &'a Scene,
    /// Through which rays.
    pub lens: &'a Lens,
}

impl Renderer<'_> {
    /// Casts one ray a pixel. `pose_of_row` gives the camera pose of every image row (all the same
    /// under a global shutter).
    fn cast(
        &self,
        pose_of_row: &dyn Fn(usize) -> SE3,
        is_global: bool,
        scratch: &mut RenderScratch,
    ) {
        let (width, height) = (self.lens.width, self.lens.height);
        scratch.hits.clear();
        scratch.hits.reserve(width * height);
        scratch.lists.fill(self.scene, self.lens, pose_of_row, is_global);
        for v in 0..height {
            if v == 0 || !is_global {
                self.view_blocks(&pose_of_row(v), &mut scratch.locals);
            }
            for u in 0..width {
                let [x, y] = self.lens.rays[v * width + u].at;
                let near = scratch.lists.of_pixel(u, v);
                scratch.hits.push(first_hit(&scratch.locals, near, x, y));
            }
        }
    }

    fn view_blocks(&self, pose: &SE3, locals: &mut Vec<LocalView>) {
        let rotation = pose.rotation_matrix();
        locals.clear();
        locals.extend(
            self.scene.blocks.iter().map(|b| LocalView::new(b, &rotation, &pose.translation)),
        );
    }

    /// Depth along the optical axis of every pixel, metres (0 where nothing is).
    pub fn depth_into(&self, pose: &SE3, scratch: &mut RenderScratch, depth: &mut [f32]) {
        self.cast(&|_| *pose, true, scratch);
        for (out, hit) in depth.iter_mut().zip(&scratch.hits) {
            *out = if hit.depth.is_finite() { hit.depth } else { 0.0 };
        }
    }

    /// Adds `weight` × brightness (grey levels, not yet quantised) of every pixel to `grey`.
    pub fn add_grey(
        &self,
        pose_of_row: &dyn Fn(usize) -> SE3,
        is_global: bool,
        weight: f32,
        scratch: &mut RenderScratch,
        grey: &mut [f32],
    ) {
        self.cast(pose_of_row, is_global, scratch);
        let (width, height) = (self.lens.width, self.lens.height);
        for v in 0..height {
            if v == 0 || !is_global {
                self.view_blocks(&pose_of_row(v), &mut scratch.locals);
            }
            for u in 0..width {
                let at = v * width + u;
                let ray = &self.lens.rays[at];
                let around = neighbourhood(&scratch.hits, width, height, u, v);
                let value = if around.iter().any(|hit| hit.surface != around[0].surface) {
                    self.edge_grey(ray, around, &scratch.locals)
                } else {
                    self.grey(ray, around[0].surface, &scratch.locals)
                };
                grey[at] += weight * value;
            }
        }
    }

    /// Mean over a pixel that more than one surface fills: a grid of rays counts each surface's
    /// share among those of the pixel and its neighbours, and each is sampled once, in its middle.
    fn edge_grey(&self, ray: &Ray, around: [Hit; 5], locals: &[LocalView]) -> f32 {
        const STEP: f32 = 1.0 / EDGE_GRID as f32;
        const RAYS: usize = EDGE_GRID * EDGE_GRID;
        let (blocks, num_blocks) = blocks_of(&around);
        let mut shares = [Share::default(); RAYS];
        let mut num_shares = 0;
        for i in 0..RAYS {
            let a = PIXEL_WIDTH * (((i % EDGE_GRID) as f32 + 0.5) * STEP - 0.5);
            let b = PIXEL_WIDTH * (((i / EDGE_GRID) as f32 + 0.5) * STEP - 0.5);
            let [x, y] = ray.shifted(a, b);
            let surface = first_of(locals, &blocks[..num_blocks], x, y);
            let known = shares[..num_shares].iter().position(|s| s.surface == surface);
            let share = &mut shares[known.unwrap_or(num_shares)];
            num_shares += usize::from(known.is_none());
            *share = Share { surface, count: share.count + 1.0, a: share.a + a, b: share.b + b };
        }
        let mut sum = 0.0;
        for share in &shares[..num_shares] {
            let at = ray.shifted(share.a / share.count, share.b / share.count);
            let side = (share.count / RAYS as f32).sqrt();
            let part = Ray { at, du: ray.du.map(|d| side * d), dv: ray.dv.map(|d| side * d) };
            sum += share.count * self.grey(&part, share.surface, locals);
        }
        sum / RAYS as f32
    }

    /// Brightness of a surface over the footprint of a ray, grey levels.
    #[inline]
    fn grey(&self, ray: &Ray, surface: u32, locals: &[LocalView]) -> f32 {
        if surface == NO_SURFACE {
            return SKY_GREY;
        }
        let (index, side) = ((surface >> 3) as usize, (surface & 7) as usize);
        let (local, block) = (&locals[index], &self.scene.blocks[index]);
        let axis = side / 2;
        let d = local.direction(ray.at[0], ray.at[1]);
        let sign = if side & 1 == 1 { 1.0 } else { -1.0 };
        // The plane of the face, which the ray meets even where another surface hides it.
        let depth = (sign * local.half[axis] - local.origin[axis]) / d[axis];
        let point: [f32; 3] = std::array::from_fn(|k| local.origin[k] + depth * d[k]);
        // Image axes of the face: upright on walls, x and y on floors.
        let (right, down, flip) = match axis {
            0 => (1, 2, -1.0),
            1 => (0, 2, -1.0),
            _ => (0, 1, 1.0),
        };
        let step = |change: [f32; 2]| {
            let turned: [f32; 3] = std::array::from_fn(|k| {
                local.rows[k][0] * change[0] + local.rows[k][1] * change[1]
            });
            // Along the face: the depth changes so that the point stays on the plane.
            let slide = turned[axis] / d[axis];
            [depth * (turned[right] - slide * d[right]), depth * (turned[down] - slide * d[down])]
        };
        let face = &block.faces[side];
        let density = [face.texels_per_metre[0], flip * face.texels_per_metre[1]];
        let (du, dv) = (step(ray.du), step(ray.dv));
        let footprint = Footprint {
            centre: [
                face.offset[0] + density[0] * point[right],
                face.offset[1] + density[1] * point[down],
            ],
            du: std::array::from_fn(|k| PIXEL_WIDTH * density[k] * du[k]),
            dv: std::array::from_fn(|k| PIXEL_WIDTH * density[k] * dv[k]),
        };
        let texel = self.scene.textures[face.texture].sample(&footprint);
        let reflectance = (face.middle + face.contrast * (texel - 0.5)).clamp(0.02, 0.98);
        let (sin, cos) = block.turn;
        let in_world = [
            block.centre[0] + cos * point[0] - sin * point[1],
            block.centre[1] + sin * point[0] + cos * point[1],
            block.centre[2] + point[2],
        ];
        let outward = if block.is_hollow { -sign } else { sign };
        let normal = match axis {
            0 => [cos * outward, sin * outward, 0.0],
            1 => [-sin * outward, cos * outward, 0.0],
            _ => [0.0, 0.0, outward],
        };
        255.0 * reflectance * block.light(in_world, normal)
    }
}

/// What a surface fills of a pixel.
#[derive(Debug, Clone, Copy, Default)]
struct Share {
    surface: u32,
    /// Rays that meet it.
    count: f32,
    /// Sums of their places in the pixel.
    a: f32,
    b: f32,
}

/// The nearest surface along a ray among the blocks `near`, which are sorted by nearest depth.
#[inline]
fn first_hit(locals: &[LocalView], near: &[NearBlock], x: f32, y: f32) -> Hit {
    let (mut depth, mut block) = (f32::INFINITY, 0);
    for candidate in near {
        if candidate.nearest > depth {
            break;
        }
        let met = locals[candidate.block as usize].depth(x, y);
        if met < depth {
            (depth, block) = (met, candidate.block);
        }
    }
    if depth == f32::INFINITY {
        return Hit { depth, surface: NO_SURFACE };
    }
    Hit { depth, surface: block * 8 + locals[block as usize].face(x, y, depth) }
}

/// The surface that a ray meets first among a few blocks.
#[inline]
fn first_of(locals: &[LocalView], blocks: &[u32], x: f32, y: f32) -> u32 {
    let (mut depth, mut block) = (f32::INFINITY, NO_SURFACE);
    for &index in blocks {
        let met = locals[index as usize].depth(x, y);
        if met < depth {
            (depth, block) = (met, index);
        }
    }
    if block == NO_SURFACE {
        return NO_SURFACE;
    }
    block * 8 + locals[block as usize].face(x, y, depth)
}

/// The different blocks among some hits, and how many those are.
#[inline]
fn blocks_of(around: &[Hit; 5]) -> ([u32; 5], usize) {
    let (mut blocks, mut count) = ([0; 5], 0);
    for hit in around.iter().filter(|hit| hit.surface != NO_SURFACE) {
        let block = hit.surface >> 3;
        if !blocks[..count].contains(&block) {
            blocks[count] = block;
            count += 1;
        }
    }
    (blocks, count)
}

/// What a pixel sees, then what its neighbours see (itself again outside the image).
#[inline]
fn neighbourhood(hits: &[Hit], width: usize, height: usize, u: usize, v: usize) -> [Hit; 5] {
    let at = v * width + u;
    let or_self = |inside: bool, other: usize| hits[if inside { other } else { at }];
    [
        hits[at],
        or_self(u > 0, at.wrapping_sub(1)),
        or_self(u + 1 < width, at + 1),
        or_self(v > 0, at.wrapping_sub(width)),
        or_self(v + 1 < height, at + width),
    ]
}
