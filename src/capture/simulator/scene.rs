//! Contents of a scene: textured blocks with fixed lighting, and the space in which a camera may walk.

use crate::capture::simulator::pattern::{Pattern, TEXTURE_SIZE, paint_all};
use crate::capture::simulator::random::Stream;
use crate::capture::simulator::route::Route;
use crate::capture::simulator::texture::Texture;
use crate::slam::kernel::{Floats, Instructions};

/// Texels per metre of a surface at its natural size: 2 mm per texel.
pub const TEXELS_PER_METRE: f32 = 500.0;

/// How one side of a block is covered.
#[derive(Debug, Clone, Copy)]
pub struct Face {
    /// Index into [`Scene::textures`].
    pub texture: usize,
    /// Texels per metre along the two axes of the face.
    pub texels_per_metre: [f32; 2],
    /// Texel at the centre of the face.
    pub offset: [f32; 2],
    /// Contrast: factor on the texture's deviation from its middle.
    pub contrast: f32,
    /// Reflectance in the middle of the texture's range.
    pub middle: f32,
}

/// A box rotated about the vertical, seen from outside, or from inside if hollow.
#[derive(Debug, Clone)]
pub struct Block {
    /// Centre in the world, metres.
    pub centre: [f32; 3],
    /// Half sides, metres.
    pub half: [f32; 3],
    /// Sine and cosine of the turn.
    pub turn: (f32, f32),
    /// Sides in the order −x, +x, −y, +y, −z, +z.
    pub faces: [Face; 6],
    /// A room: seen from inside.
    pub is_hollow: bool,
    /// The lamp of its room, metres: light does not pass through walls.
    pub lamp: [f32; 3],
}

impl Block {
    /// Light on points with this normal, as a factor on reflectance. It depends only on the position, so a surface has
    /// the same brightness from every viewpoint.
    #[inline(always)]
    pub fn light<I: Instructions>(
        &self,
        lanes: I,
        point: [Floats<I>; 3],
        normal: [f32; 3],
    ) -> Floats<I> {
        /// Ambient share of the light.
        const AMBIENT: f32 = 0.62;
        /// Light of the lamp at zero distance, facing it.
        const LAMP: f32 = 0.75;
        /// Distance at which the lamp's light is halved, metres.
        const HALF_DISTANCE_M: f32 = 3.0;
        let number = |x: f32| lanes.splat(x);
        let mut to = point;
        for k in 0..3 {
            to[k] = number(self.lamp[k]) - point[k];
        }
        let squared = to[0] * to[0] + to[1] * to[1] + to[2] * to[2];
        let along = |k: usize| to[k] * number(normal[k]);
        let facing = along(0) + along(1) + along(2);
        let distance = squared.sqrt().max(number(1e-3));
        let cosine = (facing / distance).max(number(0.0));
        let falloff = number(1.0) + squared / number(HALF_DISTANCE_M * HALF_DISTANCE_M);
        number(AMBIENT) + number(LAMP) * cosine / falloff + number(0.06 * normal[0])
    }
}

/// The free space of a scene: the ellipsoid that contains a camera's path, and the camera's directions.
#[derive(Debug, Clone, Copy)]
pub struct Stage {
    /// Centre of the path, metres.
    pub centre: [f64; 3],
    /// Half axes of the path, metres.
    pub reach: [f64; 3],
    /// Start of the path on its round: a range of phases, radians.
    pub start_rad: (f64, f64),
    /// Mean heading (about the vertical from +x towards +y), radians.
    pub heading_rad: f64,
    /// How far the heading swings to either side, radians.
    pub heading_swing_rad: f64,
    /// Mean elevation of the optical axis, radians, negative looks down.
    pub elevation_rad: f64,
    /// How far the elevation swings, radians.
    pub elevation_swing_rad: f64,
    /// Route that a handheld camera walks instead of the ellipsoid.
    pub route: Option<&'static Route>,
}

/// Blocks, their textures and their light. The world is z up, in metres.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Everything visible.
    pub blocks: Vec<Block>,
    /// Textures that the faces refer to.
    pub textures: Vec<Texture>,
}

impl Scene {
    /// Builds a scene of blocks and paints its textures.
    pub fn new(blocks: Vec<Block>, seed: u64) -> Self {
        Self { blocks, textures: paint_all(seed) }
    }
}

/// Places blocks in a scene, each with a different cut of the textures.
#[derive(Debug)]
pub struct Builder {
    /// Everything placed so far.
    pub blocks: Vec<Block>,
    /// Random choices of the scene.
    pub stream: Stream,
    /// Origin of the positions passed in, in the world, metres.
    pub origin: [f32; 2],
    /// The lamp of the blocks placed, metres in the world.
    pub lamp: [f32; 3],
}

/// How a block is covered.
#[derive(Debug, Clone, Copy)]
pub struct Cover {
    /// Pattern of all sides.
    pub pattern: Pattern,
    /// Texels per metre; fewer make the pattern larger.
    pub density: f32,
    /// Factor on the pattern's contrast.
    pub contrast: f32,
    /// Middle reflectance.
    pub middle: f32,
}

impl Cover {
    /// A cover at its natural size and contrast.
    pub fn of(pattern: Pattern) -> Self {
        Self { pattern, density: TEXELS_PER_METRE, contrast: 1.0, middle: 0.5 }
    }

    /// The same with another middle reflectance.
    pub fn with_middle(self, middle: f32) -> Self {
        Self { middle, ..self }
    }

    /// The same with another contrast.
    pub fn with_contrast(self, contrast: f32) -> Self {
        Self { contrast, ..self }
    }

    /// The same with a pattern `factor` times as large.
    pub fn enlarged(self, factor: f32) -> Self {
        Self { density: self.density / factor, ..self }
    }
}

impl Builder {
    /// An empty scene with one lamp.
    pub fn new(seed: u64, lamp: [f32; 3]) -> Self {
        Self { blocks: Vec::new(), stream: Stream::new(seed, 0x5CE7), origin: [0.0; 2], lamp }
    }

    /// A face cut at random from a pattern.
    pub fn face(&mut self, cover: Cover) -> Face {
        let size = TEXTURE_SIZE as f32;
        Face {
            texture: cover.pattern as usize,
            texels_per_metre: [cover.density; 2],
            offset: [self.stream.uniform(0.0, size), self.stream.uniform(0.0, size)],
            contrast: cover.contrast,
            middle: cover.middle,
        }
    }

    /// A block standing on height `base` with `size` (x, y, z), turned by `turn_rad`.
    pub fn place(&mut self, at: [f32; 2], base: f32, size: [f32; 3], turn_rad: f32, cover: Cover) {
        let faces = std::array::from_fn(|_| self.face(cover));
        self.blocks.push(Block {
            centre: [self.origin[0] + at[0], self.origin[1] + at[1], base + 0.5 * size[2]],
            half: [0.5 * size[0], 0.5 * size[1], 0.5 * size[2]],
            turn: turn_rad.sin_cos(),
            faces,
            is_hollow: false,
            lamp: self.lamp,
        });
    }

    /// The shell of a room from the origin to `size`; covers as in [`Block::faces`].
    pub fn shell(&mut self, size: [f32; 3], covers: [Cover; 6]) {
        let faces = covers.map(|cover| self.face(cover));
        let half = size.map(|s| 0.5 * s);
        let lamp = self.lamp;
        let turn = (0.0, 1.0);
        self.blocks.push(Block { centre: half, half, turn, faces, is_hollow: true, lamp });
    }

    /// A table, chair seat or shelf board on four legs.
    pub fn table(&mut self, at: [f32; 2], size: [f32; 3], turn_rad: f32, top: Cover) {
        const BOARD_M: f32 = 0.04;
        const LEG_M: f32 = 0.05;
        self.place(at, size[2] - BOARD_M, [size[0], size[1], BOARD_M], turn_rad, top);
        let (sin, cos) = turn_rad.sin_cos();
        for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let (x, y) = (sx * 0.5 * (size[0] - LEG_M), sy * 0.5 * (size[1] - LEG_M));
            let leg = [at[0] + cos * x - sin * y, at[1] + sin * x + cos * y];
            self.place(leg, 0.0, [LEG_M, LEG_M, size[2] - BOARD_M], turn_rad, top);
        }
    }

    /// A chair whose back is on the side away from its heading.
    pub fn chair(&mut self, at: [f32; 2], turn_rad: f32, cover: Cover) {
        self.table(at, [0.42, 0.42, 0.45], turn_rad, cover);
        let (sin, cos) = turn_rad.sin_cos();
        let back = [at[0] - cos * 0.19, at[1] - sin * 0.19];
        for (base, height) in [(0.52, 0.12), (0.72, 0.16)] {
            self.place(back, base, [0.03, 0.42, height], turn_rad, cover);
        }
        for side in [-0.19, 0.19] {
            let post = [back[0] - sin * side, back[1] + cos * side];
            self.place(post, 0.45, [0.04, 0.04, 0.45], turn_rad, cover);
        }
    }

    /// A row of books from `from` along the unit vector (`cos`, `sin`) of `turn_rad`.
    pub fn books(&mut self, from: [f32; 2], base: f32, length: f32, height: f32, turn_rad: f32) {
        let (sin, cos) = turn_rad.sin_cos();
        let mut along = 0.0;
        while along < length - 0.05 {
            let thick = self.stream.uniform(0.025, 0.06);
            let tall = height * self.stream.uniform(0.62, 0.95);
            let deep = self.stream.uniform(0.16, 0.22);
            let middle = self.stream.uniform(0.3, 0.62);
            let pattern = [Pattern::Cover, Pattern::Cover, Pattern::Fabric, Pattern::Text]
                [self.stream.index(4)];
            let place = along + 0.5 * thick;
            let at = [from[0] + cos * place, from[1] + sin * place];
            let cover = Cover::of(pattern).with_middle(middle).with_contrast(0.6);
            self.place(at, base, [thick * 0.94, deep, tall], turn_rad, cover);
            along += thick;
            if self.stream.index(7) == 0 {
                along += self.stream.uniform(0.03, 0.12);
            }
        }
    }

    /// An open shelf of `boards` storeys with books, its length along `turn_rad`.
    pub fn bookshelf(
        &mut self,
        at: [f32; 2],
        size: [f32; 3],
        boards: usize,
        turn_rad: f32,
        cover: Cover,
    ) {
        const BOARD_M: f32 = 0.03;
        let (sin, cos) = turn_rad.sin_cos();
        let storey = (size[2] - BOARD_M) / boards as f32;
        for board in 0..=boards {
            let base = board as f32 * storey;
            self.place(at, base, [size[0], size[1], BOARD_M], turn_rad, cover);
        }
        for side in [-0.5, 0.5] {
            let along = side * (size[0] + BOARD_M);
            let post = [at[0] + cos * along, at[1] + sin * along];
            self.place(post, 0.0, [BOARD_M, size[1], size[2]], turn_rad, cover);
        }
        for board in 0..boards {
            let start = self.stream.uniform(0.0, 0.1);
            let along = start - 0.5 * size[0];
            let from = [at[0] + cos * along, at[1] + sin * along];
            let base = board as f32 * storey + BOARD_M;
            let length = (size[0] - start) * self.stream.uniform(0.7, 1.0);
            self.books(from, base, length, storey - BOARD_M, turn_rad);
        }
    }

    /// A stack of boxes, each smaller and turned differently.
    pub fn stack(&mut self, at: [f32; 2], base: f32, sizes: &[[f32; 3]], cover: Cover) {
        let mut height = base;
        for &size in sizes {
            let turn = self.stream.uniform(-0.5, 0.5);
            let middle = self.stream.uniform(0.4, 0.6);
            self.place(at, height, size, turn, cover.with_middle(middle));
            height += size[2];
        }
    }
}

/// A scene without its textures.
#[derive(Debug, Clone)]
pub struct Furnished {
    /// Everything visible.
    pub blocks: Vec<Block>,
    /// Where a camera may walk.
    pub stage: Stage,
}

/// A framed picture on a wall that runs along `turn_rad`, centred on height `z`.
pub fn picture(
    b: &mut Builder,
    at: [f32; 2],
    z: f32,
    width: f32,
    height: f32,
    turn_rad: f32,
    pattern: Pattern,
) {
    let (frame, depth) = (0.04, 0.025);
    let wood = Cover::of(Pattern::Veneer).with_middle(0.3);
    let size = [width + 2.0 * frame, depth, height + 2.0 * frame];
    b.place(at, z - 0.5 * size[2], size, turn_rad, wood);
    let size = [width, depth + 0.006, height];
    b.place(at, z - 0.5 * height, size, turn_rad, Cover::of(pattern));
}
