//! Ray casting: the surface that every pixel sees, its depth and its brightness.

use crate::capture::simulator::cull::TileLists;
use crate::capture::simulator::edges::Shares;
use crate::capture::simulator::lens::{ALL_LANES, LANES, Lens};
use crate::capture::simulator::scene::Scene;
use crate::capture::simulator::shade::{FaceView, grey};
use crate::capture::simulator::view::{LocalView, Nearest};
use crate::slam::geometry::se3::SE3;
use crate::slam::kernel::{Body, Instructions, Kernel};

/// Reused memory of a renderer: one for each thread.
#[derive(Debug, Default)]
pub struct RenderScratch {
    /// The surface that every pixel sees, and [`LANES`] more.
    surfaces: Vec<f32>,
    /// Depth along the optical axis of every pixel, metres, infinite where there is no surface; and [`LANES`] more.
    depths: Vec<f32>,
    views: Vec<LocalView>,
    lists: TileLists,
    /// Pixels of a row that more than one surface fills.
    is_edge: Vec<bool>,
    shares: Shares,
}

impl RenderScratch {
    /// Writes the depth along the optical axis of every pixel in the last cast, metres (0 where there is no surface).
    pub fn depth_into(&self, depth: &mut [f32]) {
        for (out, &seen) in depth.iter_mut().zip(&self.depths) {
            *out = if seen.is_finite() { seen } else { 0.0 };
        }
    }
}

/// Renders a scene through a lens.
#[derive(Debug)]
pub struct Renderer<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// The rays.
    pub lens: &'a Lens,
    /// The instructions: all give the same bits.
    pub kernel: Kernel,
}

/// The camera pose of every image row, all the same under a global shutter.
#[derive(Clone, Copy)]
struct Shutter<'a> {
    pose_of_row: &'a dyn Fn(usize) -> SE3,
    is_global: bool,
}

impl Renderer<'_> {
    /// Casts the depth of every pixel, without its surface, into `scratch`.
    pub fn cast_depth(&self, pose: &SE3, scratch: &mut RenderScratch) {
        let shutter = Shutter { pose_of_row: &|_| *pose, is_global: true };
        self.kernel.run_eight(Casting { renderer: self, shutter, names_surfaces: false, scratch });
    }

    /// Adds `weight` × brightness (grey levels, not yet quantised) of every pixel to `grey`.
    /// `pose_of_row` gives the camera pose of every image row (all the same under a global shutter).
    pub fn add_grey(
        &self,
        pose_of_row: &dyn Fn(usize) -> SE3,
        is_global: bool,
        weight: f32,
        scratch: &mut RenderScratch,
        grey: &mut [f32],
    ) {
        let shutter = Shutter { pose_of_row, is_global };
        self.kernel.run_eight(Casting { renderer: self, shutter, names_surfaces: true, scratch });
        self.kernel.run_eight(Shading { renderer: self, shutter, weight, scratch, grey });
    }

    /// Computes the blocks as the camera sees them when it takes a row; under a global shutter once, for the first row.
    fn view_blocks(&self, shutter: Shutter<'_>, row: usize, views: &mut Vec<LocalView>) {
        if row > 0 && shutter.is_global {
            return;
        }
        let pose = (shutter.pose_of_row)(row);
        let rotation = pose.rotation_matrix();
        views.clear();
        let blocks = self.scene.blocks.iter();
        views.extend(blocks.map(|b| LocalView::new(b, &rotation, &pose.translation)));
    }
}

/// Casts one ray per pixel.
struct Casting<'a> {
    renderer: &'a Renderer<'a>,
    shutter: Shutter<'a>,
    /// Whether the surfaces are needed too, not only the depths.
    names_surfaces: bool,
    scratch: &'a mut RenderScratch,
}

impl Body for Casting<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, lanes: I) {
        let Self { renderer, shutter, names_surfaces, scratch } = self;
        let lens = renderer.lens;
        let (width, height) = (lens.width, lens.height);
        let RenderScratch { surfaces, depths, views, lists, .. } = scratch;
        surfaces.resize(width * height + LANES, 0.0);
        depths.resize(width * height + LANES, 0.0);
        lists.fill(renderer.scene, lens, shutter.pose_of_row, shutter.is_global);
        for v in 0..height {
            renderer.view_blocks(shutter, v, views);
            // Values written beyond the end of a row are overwritten with those of the next one.
            for u in (0..width).step_by(LANES) {
                let first = v * width + u;
                let at = lens.rays_from(first).at.map(|x| lanes.load(x));
                let mut nearest = Nearest::nothing(lanes);
                // Sorted by nearest depth.
                for near in lists.of_pixel(u, v) {
                    if lanes.splat(near.nearest).greater(nearest.depth).bits() == ALL_LANES {
                        break;
                    }
                    nearest = nearest.or_block(lanes, views, near.block, at);
                }
                depths[first..first + LANES].copy_from_slice(&nearest.depth.to_array::<LANES>());
                if names_surfaces {
                    let seen = nearest.surfaces(lanes, views, at).to_array::<LANES>();
                    surfaces[first..first + LANES].copy_from_slice(&seen);
                }
            }
        }
    }
}

/// Computes the brightness of the surfaces that were cast.
struct Shading<'a> {
    renderer: &'a Renderer<'a>,
    shutter: Shutter<'a>,
    weight: f32,
    scratch: &'a mut RenderScratch,
    grey: &'a mut [f32],
}

impl Body for Shading<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, lanes: I) {
        let Self { renderer, shutter, weight, scratch, grey } = self;
        let Renderer { scene, lens, .. } = *renderer;
        let RenderScratch { surfaces, views, is_edge, shares, .. } = scratch;
        for v in 0..lens.height {
            renderer.view_blocks(shutter, v, views);
            let image = Seen { surfaces, width: lens.width, height: lens.height };
            image.mark_edges(v, is_edge);
            let mut first = v * lens.width;
            for run in is_edge.chunk_by(|a, b| a == b) {
                let pixels = first..first + run.len();
                first = pixels.end;
                if run[0] {
                    for pixel in pixels {
                        let around = image.around(pixel - v * lens.width, v);
                        shares.divide(lanes, views, around, &lens.ray(pixel), pixel);
                    }
                } else {
                    let face = FaceView::new(scene, views, surfaces[pixels.start]);
                    add_face(lanes, lens, face.as_ref(), pixels.start, weight, &mut grey[pixels]);
                }
            }
            if !shutter.is_global || v + 1 == lens.height || shares.are_enough() {
                shares.add_to(lanes, scene, views, weight, grey);
            }
        }
    }
}

/// Adds `weight` × the brightness of a face to the pixels from `first` on, all of which see it alone.
#[inline(always)]
fn add_face<I: Instructions>(
    lanes: I,
    lens: &Lens,
    face: Option<&FaceView<'_>>,
    first: usize,
    weight: f32,
    out: &mut [f32],
) {
    for (part, out) in out.chunks_mut(LANES).enumerate() {
        let rays = lens.rays_from(first + part * LANES);
        let ray = rays.map(|numbers| lanes.load(numbers));
        let values = grey(lanes, face, out.len(), &ray).to_array::<LANES>();
        for (out, value) in out.iter_mut().zip(values) {
            *out += weight * value;
        }
    }
}

/// The surfaces that an image shows.
#[derive(Clone, Copy)]
struct Seen<'a> {
    surfaces: &'a [f32],
    width: usize,
    height: usize,
}

impl Seen<'_> {
    /// The surface of a pixel, then those of its neighbours (its own again outside the image).
    #[inline(always)]
    fn around(&self, u: usize, v: usize) -> [f32; 5] {
        let at = v * self.width + u;
        let or_self = |inside: bool, other: usize| self.surfaces[if inside { other } else { at }];
        [
            self.surfaces[at],
            or_self(u > 0, at.wrapping_sub(1)),
            or_self(u + 1 < self.width, at + 1),
            or_self(v > 0, at.wrapping_sub(self.width)),
            or_self(v + 1 < self.height, at + self.width),
        ]
    }

    /// Marks the pixels of a row whose surface differs from that of a neighbour.
    #[inline(always)]
    fn mark_edges(&self, v: usize, is_edge: &mut Vec<bool>) {
        let row = |v: usize| &self.surfaces[v * self.width..][..self.width];
        let here = row(v);
        let (above, below) = (row(v.saturating_sub(1)), row((v + 1).min(self.height - 1)));
        is_edge.clear();
        let columns = here.iter().zip(above).zip(below);
        is_edge.extend(columns.map(|((here, above), below)| (here != above) | (here != below)));
        for (is_edge, pair) in is_edge.iter_mut().zip(here.windows(2)) {
            *is_edge |= pair[0] != pair[1];
        }
        for (is_edge, pair) in is_edge[1..].iter_mut().zip(here.windows(2)) {
            *is_edge |= pair[0] != pair[1];
        }
    }
}
