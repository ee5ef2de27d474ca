//! The flat: four rooms, furnished differently, joined by a corridor and by doors between them.
//!
//! ```text
//!   y 10 ┌────────────┬────────────┐
//!        │  D study   ╎ C kitchen  │      ╎ ╌  doors; the round is A, B, corridor, C, D, corridor, A
//!      6 ├──╌╌────────┴───╌╌───────┤
//!        │        corridor         │
//!      4 ├────────╌╌──┬───────╌╌───┤
//!        │ A living   ╎ B bedroom  │
//!      0 └────────────┴────────────┘
//!        x 0         4.5           9
//! ```

use std::f32::consts::FRAC_PI_2;

use crate::capture::simulator::pattern::Pattern;
use crate::capture::simulator::route::{Route, Waypoint, waypoint};
use crate::capture::simulator::scene::{Builder, Cover, Furnished, Stage, picture};

/// Height of the rooms, metres.
pub const HEIGHT_M: f32 = 2.7;
/// Half the thickness of a wall between two rooms, each of which has its own side, metres.
const WALL_M: f32 = 0.1;
/// Height of a door, metres.
const DOOR_M: f32 = 2.1;
/// Inner size of the four rooms along x and y, metres.
pub const ROOM_M: [f32; 2] = [4.4, 4.0];
/// Origins of the rooms A, B, C and D, metres.
pub const ROOMS_M: [[f32; 2]; 4] = [[0.0, 0.0], [4.6, 0.0], [4.6, 6.0], [0.0, 6.0]];
/// Origin and size of the corridor, metres.
const CORRIDOR_M: ([f32; 2], [f32; 2]) = ([0.0, 4.2], [9.0, 1.6]);

/// A round through all rooms. The camera looks at furniture, mostly across its path.
static ROUND: [Waypoint; 43] = [
    // A, from a step aside in front of the sofa.
    waypoint(3.0, 2.9, -100.0, -9.0),
    waypoint(2.2, 3.0, -105.0, -10.0),
    waypoint(1.4, 2.6, -110.0, -11.0),
    waypoint(1.1, 1.9, -80.0, -9.0),
    waypoint(1.5, 1.3, -42.0, -8.0),
    waypoint(2.3, 1.15, -8.0, -7.0),
    waypoint(3.1, 1.5, 15.0, -7.0),
    waypoint(3.7, 2.2, 20.0, -7.0),
    waypoint(4.5, 2.5, 5.0, -8.0),
    // B.
    waypoint(5.3, 2.5, -15.0, -9.0),
    waypoint(6.0, 2.0, -35.0, -11.0),
    waypoint(6.8, 1.4, -25.0, -10.0),
    waypoint(7.6, 1.4, 12.0, -9.0),
    waypoint(8.0, 2.0, 52.0, -8.0),
    waypoint(7.8, 2.8, 85.0, -7.0),
    waypoint(7.3, 3.4, 100.0, -6.0),
    waypoint(7.1, 4.1, 108.0, -6.0),
    // The corridor.
    waypoint(6.9, 4.8, 122.0, -7.0),
    waypoint(6.3, 5.1, 132.0, -8.0),
    waypoint(5.8, 5.5, 115.0, -8.0),
    waypoint(5.7, 6.1, 90.0, -8.0),
    // C.
    waypoint(5.9, 6.9, 65.0, -9.0),
    waypoint(6.5, 7.4, 50.0, -10.0),
    waypoint(7.3, 7.5, 60.0, -10.0),
    waypoint(7.9, 8.0, 88.0, -9.0),
    waypoint(7.8, 8.7, 122.0, -8.0),
    waypoint(7.0, 9.0, 155.0, -8.0),
    waypoint(6.2, 8.7, 180.0, -8.0),
    waypoint(5.4, 8.2, 186.0, -7.0),
    waypoint(4.5, 8.0, 178.0, -7.0),
    // D.
    waypoint(3.7, 8.1, 168.0, -8.0),
    waypoint(3.0, 8.6, 162.0, -9.0),
    waypoint(2.2, 8.9, 178.0, -9.0),
    waypoint(1.4, 8.7, 210.0, -9.0),
    waypoint(1.0, 8.0, 242.0, -9.0),
    waypoint(1.2, 7.2, 265.0, -8.0),
    waypoint(1.3, 6.5, 278.0, -7.0),
    waypoint(1.3, 5.8, 286.0, -7.0),
    // The corridor, looking through the door of A.
    waypoint(1.6, 5.1, 298.0, -8.0),
    waypoint(2.2, 5.0, 304.0, -9.0),
    waypoint(2.8, 4.6, 290.0, -9.0),
    waypoint(3.0, 3.9, 274.0, -9.0),
    // A again.
    waypoint(3.1, 3.4, 264.0, -9.0),
];

static ROUTE: Route = Route { waypoints: &ROUND, turn_deg: 360.0, height_m: 1.4, rounds: 2 };

/// Builds the flat; the seed chooses textures and small objects.
pub fn flat(seed: u64) -> Furnished {
    let mut b = Builder::new(seed, [0.0; 3]);
    let plaster = Cover::of(Pattern::Plaster);
    let paper = Cover::of(Pattern::Wallpaper);
    let brick = Cover::of(Pattern::Brick).with_contrast(0.6);
    let fabric = Cover::of(Pattern::Fabric).enlarged(1.5).with_contrast(0.6);
    let planks = Cover::of(Pattern::Planks).with_contrast(0.8);
    let carpet = Cover::of(Pattern::Carpet).with_contrast(0.7);
    let print = Cover::of(Pattern::Cardboard).with_contrast(0.6);
    let doors_a = [Door::new(Side::East, 2.0, 3.0), Door::new(Side::North, 2.5, 3.5)];
    let covers = [plaster, paper, brick, plaster, planks, plaster];
    enclose(&mut b, ROOMS_M[0], ROOM_M, covers, &doors_a);
    living(&mut b);
    let doors_b = [Door::new(Side::West, 2.0, 3.0), Door::new(Side::North, 2.0, 3.0)];
    let lighter = paper.enlarged(1.5).with_middle(0.58);
    let covers = [lighter, fabric, lighter, paper, carpet, plaster];
    enclose(&mut b, ROOMS_M[1], ROOM_M, covers, &doors_b);
    bedroom(&mut b);
    let doors_c = [Door::new(Side::West, 1.5, 2.5), Door::new(Side::South, 0.6, 1.6)];
    let tiles = Cover::of(Pattern::Brick).enlarged(0.6).with_contrast(0.5).with_middle(0.6);
    enclose(&mut b, ROOMS_M[2], ROOM_M, [paper, tiles, plaster, tiles, print, plaster], &doors_c);
    kitchen(&mut b);
    let doors_d = [Door::new(Side::East, 1.5, 2.5), Door::new(Side::South, 0.8, 1.8)];
    let covers = [brick.with_middle(0.44), fabric, paper, plaster, planks.enlarged(0.7), plaster];
    enclose(&mut b, ROOMS_M[3], ROOM_M, covers, &doors_d);
    study(&mut b);
    let doors = [
        Door::new(Side::South, 2.5, 3.5),
        Door::new(Side::South, 6.6, 7.6),
        Door::new(Side::North, 0.8, 1.8),
        Door::new(Side::North, 5.2, 6.2),
    ];
    let covers = [paper, paper, paper.enlarged(0.7), brick, carpet.enlarged(0.7), plaster];
    enclose(&mut b, CORRIDOR_M.0, CORRIDOR_M.1, covers, &doors);
    corridor(&mut b);
    Furnished { blocks: b.blocks, stage: stage(&ROUTE) }
}

/// Position of the camera for motions other than a walk: around the start of the route.
pub fn stage(route: &'static Route) -> Stage {
    let start = &route.waypoints[0];
    Stage {
        centre: [start.at[0], start.at[1], route.height_m],
        reach: [0.4, 0.4, 0.1],
        start_rad: (0.0, std::f64::consts::TAU),
        heading_rad: start.heading_deg.to_radians(),
        heading_swing_rad: 0.5,
        elevation_rad: start.elevation_deg.to_radians(),
        elevation_swing_rad: 0.1,
        route: Some(route),
    }
}

/// A wall of a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// −x.
    West,
    /// +x.
    East,
    /// −y.
    South,
    /// +y.
    North,
}

/// An opening in a wall.
#[derive(Debug, Clone, Copy)]
pub struct Door {
    side: Side,
    /// From the room's corner along the wall, metres.
    from: f32,
    to: f32,
}

impl Door {
    /// A door from `from` to `to` along a wall, metres.
    pub const fn new(side: Side, from: f32, to: f32) -> Self {
        Self { side, from, to }
    }
}

/// Builds floor, ceiling and walls with doors of a room at `origin` with the inner `size`, and its lamp; objects placed
/// next stand in it. Covers: west, east, south, north, floor, ceiling. The doors of a wall are in order along it.
pub fn enclose(
    b: &mut Builder,
    origin: [f32; 2],
    size: [f32; 2],
    covers: [Cover; 6],
    doors: &[Door],
) {
    (b.origin, b.lamp) =
        (origin, [origin[0] + 0.5 * size[0], origin[1] + 0.5 * size[1], HEIGHT_M - 0.3]);
    let middle = [0.5 * size[0], 0.5 * size[1]];
    let slab = [size[0] + 2.0 * WALL_M, size[1] + 2.0 * WALL_M, WALL_M];
    b.place(middle, -WALL_M, slab, 0.0, covers[4]);
    b.place(middle, HEIGHT_M, slab, 0.0, covers[5]);
    let sides = [Side::West, Side::East, Side::South, Side::North];
    for (side, cover) in sides.into_iter().zip(covers) {
        wall(b, size, side, cover, doors);
    }
}

/// Builds one wall with its doors: pieces next to them, a piece above each, and wooden frames around them.
fn wall(b: &mut Builder, size: [f32; 2], side: Side, cover: Cover, doors: &[Door]) {
    /// Width of a door's frame and how far it protrudes from the wall, metres.
    const FRAME_M: (f32, f32) = (0.08, 0.015);
    let is_along_x = matches!(side, Side::South | Side::North);
    let across = match side {
        Side::West | Side::South => -0.5 * WALL_M,
        Side::East => size[0] + 0.5 * WALL_M,
        Side::North => size[1] + 0.5 * WALL_M,
    };
    let mut piece = |from: f32, to: f32, low: f32, high: f32, thick: f32, cover: Cover| {
        let (middle, length) = (0.5 * (from + to), to - from);
        let (at, size) = match is_along_x {
            true => ([middle, across], [length, thick, high - low]),
            false => ([across, middle], [thick, length, high - low]),
        };
        b.place(at, low, size, 0.0, cover);
    };
    // The walls along y close the corners.
    let (mut from, end) = match is_along_x {
        true => (0.0, size[0]),
        false => (-WALL_M, size[1] + WALL_M),
    };
    let wood = Cover::of(Pattern::Veneer).with_middle(0.6);
    let (width, out) = (FRAME_M.0, WALL_M + 2.0 * FRAME_M.1);
    for door in doors.iter().filter(|door| door.side == side) {
        piece(from, door.from, 0.0, HEIGHT_M, WALL_M, cover);
        piece(door.from, door.to, DOOR_M, HEIGHT_M, WALL_M, cover);
        piece(door.from - width, door.from, 0.0, DOOR_M, out, wood);
        piece(door.to, door.to + width, 0.0, DOOR_M, out, wood);
        piece(door.from - width, door.to + width, DOOR_M, DOOR_M + width, out, wood);
        from = door.to;
    }
    piece(from, end, 0.0, HEIGHT_M, WALL_M, cover);
}

/// A: a sofa, shelves, a low table on a rug.
pub fn living(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    let fabric = Cover::of(Pattern::Fabric);
    b.place([2.2, 2.0], 0.0, [2.0, 1.5, 0.015], 0.1, Cover::of(Pattern::Carpet));
    b.table([2.2, 2.05], [1.0, 0.55, 0.42], 0.2, wood.with_middle(0.58));
    b.stack([2.1, 2.0], 0.42, &[[0.3, 0.22, 0.05], [0.24, 0.18, 0.04]], Cover::of(Pattern::Cover));
    b.stack([2.5, 2.1], 0.42, &[[0.14, 0.12, 0.16]], Cover::of(Pattern::Poster));
    b.place([2.2, 0.42], 0.0, [1.9, 0.8, 0.42], 0.0, fabric);
    b.place([2.2, 0.13], 0.42, [1.9, 0.22, 0.42], 0.0, fabric);
    for x in [1.2, 3.2] {
        b.place([x, 0.42], 0.0, [0.18, 0.8, 0.6], 0.0, fabric.with_middle(0.44));
    }
    b.place([1.7, 0.32], 0.42, [0.42, 0.16, 0.4], 0.25, Cover::of(Pattern::Carpet).enlarged(0.5));
    b.place([2.7, 0.32], 0.42, [0.4, 0.16, 0.38], -0.2, Cover::of(Pattern::Poster).enlarged(0.7));
    picture(b, [1.6, 0.015], 1.75, 0.8, 0.6, 0.0, Pattern::Poster);
    picture(b, [2.7, 0.015], 1.8, 0.9, 0.8, 0.0, Pattern::Picture);
    b.stack([3.9, 0.4], 0.0, &[[0.5, 0.45, 0.4], [0.4, 0.36, 0.34]], Cover::of(Pattern::Cardboard));
    b.bookshelf([0.2, 2.2], [1.5, 0.32, 2.0], 5, -FRAC_PI_2, wood);
    b.place([0.35, 0.5], 0.0, [0.45, 0.6, 0.8], 0.0, wood.with_middle(0.45));
    b.stack([0.35, 0.5], 0.8, &[[0.2, 0.26, 0.3]], Cover::of(Pattern::Picture).enlarged(0.4));
    picture(b, [4.385, 1.0], 1.6, 1.1, 0.9, FRAC_PI_2, Pattern::Picture);
    b.place([4.2, 1.2], 0.0, [0.36, 1.2, 0.6], 0.0, wood.with_middle(0.5));
    b.stack([4.2, 0.9], 0.6, &[[0.2, 0.3, 0.22], [0.16, 0.2, 0.1]], Cover::of(Pattern::Cardboard));
    picture(b, [1.0, 3.985], 1.6, 0.9, 0.7, 0.0, Pattern::Text);
    b.bookshelf([1.2, 3.82], [1.4, 0.32, 0.85], 2, 0.0, wood.with_middle(0.6));
    picture(b, [4.0, 3.985], 1.6, 0.4, 0.6, 0.0, Pattern::Poster);
}

/// B: a bed, a wardrobe, a dresser.
fn bedroom(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    let fabric = Cover::of(Pattern::Fabric);
    b.place([3.3, 0.75], 0.0, [2.0, 1.4, 0.3], 0.0, wood.with_middle(0.42));
    b.place([3.25, 0.75], 0.3, [1.9, 1.34, 0.2], 0.0, fabric.with_middle(0.62).enlarged(0.7));
    b.place([2.9, 0.75], 0.5, [1.1, 1.36, 0.04], 0.0, Cover::of(Pattern::Carpet).enlarged(0.6));
    for y in [0.4, 1.1] {
        b.place([4.0, y], 0.5, [0.36, 0.5, 0.14], 0.1, Cover::of(Pattern::Wallpaper).enlarged(0.4));
    }
    b.place([4.33, 0.75], 0.0, [0.08, 1.5, 1.0], 0.0, wood.with_middle(0.5));
    picture(b, [4.385, 0.8], 1.7, 1.2, 0.8, FRAC_PI_2, Pattern::Poster);
    b.place([4.15, 1.85], 0.0, [0.4, 0.45, 0.5], 0.0, wood);
    b.stack([4.15, 1.85], 0.5, &[[0.16, 0.16, 0.3]], Cover::of(Pattern::Text).enlarged(0.5));
    b.place([4.1, 3.1], 0.0, [0.55, 1.2, 2.1], 0.0, Cover::of(Pattern::Planks).enlarged(0.5));
    b.stack([4.1, 3.0], 2.1, &[[0.4, 0.6, 0.25]], Cover::of(Pattern::Cardboard));
    b.place([0.3, 0.9], 0.0, [0.5, 1.3, 0.85], 0.0, wood.with_middle(0.55));
    b.stack([0.3, 0.6], 0.85, &[[0.2, 0.3, 0.2], [0.18, 0.2, 0.12]], Cover::of(Pattern::Cover));
    b.stack([0.3, 1.2], 0.85, &[[0.14, 0.14, 0.35]], Cover::of(Pattern::Picture).enlarged(0.4));
    picture(b, [0.015, 1.0], 1.6, 0.8, 0.9, FRAC_PI_2, Pattern::Picture);
    picture(b, [1.3, 0.015], 1.6, 0.8, 0.8, 0.0, Pattern::Text);
    picture(b, [2.6, 0.015], 1.7, 0.9, 0.7, 0.0, Pattern::Picture);
    picture(b, [3.7, 0.015], 1.6, 0.5, 0.8, 0.0, Pattern::Poster);
    b.chair([1.2, 0.6], 1.2, wood.with_middle(0.5));
    picture(b, [1.2, 3.985], 1.6, 1.0, 0.8, 0.0, Pattern::Poster);
    b.stack([0.5, 3.5], 0.0, &[[0.6, 0.5, 0.5], [0.5, 0.4, 0.4]], Cover::of(Pattern::Cardboard));
    picture(b, [3.5, 3.985], 1.6, 0.5, 0.7, 0.0, Pattern::Text);
}

/// C: worktops with things on them, a table with chairs.
fn kitchen(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    let top = Cover::of(Pattern::Planks).enlarged(0.4).with_middle(0.4);
    b.place([2.4, 3.7], 0.0, [3.6, 0.55, 0.85], 0.0, wood.with_middle(0.62));
    b.place([2.4, 3.69], 0.85, [3.64, 0.6, 0.04], 0.0, top);
    b.place([4.1, 2.2], 0.0, [0.55, 2.2, 0.85], 0.0, wood.with_middle(0.62));
    b.place([4.09, 2.2], 0.85, [0.6, 2.3, 0.04], 0.0, top);
    for (k, x) in [0.9f32, 1.4, 2.0, 2.7, 3.3].into_iter().enumerate() {
        let pattern = [Pattern::Text, Pattern::Poster, Pattern::Cardboard][k % 3];
        let size = [0.16 + 0.03 * k as f32, 0.18, 0.34 - 0.05 * k as f32];
        b.stack([x, 3.75], 0.89, &[size], Cover::of(pattern).enlarged(0.5));
    }
    for (k, y) in [1.4f32, 1.9, 2.6, 3.1].into_iter().enumerate() {
        let pattern = [Pattern::Cover, Pattern::Picture][k % 2];
        b.stack([4.15, y], 0.89, &[[0.18, 0.22, 0.2], [0.12, 0.12, 0.14]], Cover::of(pattern));
    }
    b.place([1.4, 3.83], 1.6, [1.6, 0.3, 0.6], 0.0, Cover::of(Pattern::Planks).enlarged(0.5));
    picture(b, [3.2, 3.985], 1.7, 1.0, 0.7, 0.0, Pattern::Poster);
    b.place([4.08, 0.45], 0.0, [0.6, 0.6, 1.9], 0.0, Cover::of(Pattern::Cover).enlarged(2.0));
    picture(b, [4.385, 2.3], 1.75, 1.4, 0.7, FRAC_PI_2, Pattern::Text);
    b.table([2.3, 0.75], [1.1, 0.75, 0.74], 0.05, wood.with_middle(0.66));
    b.stack([2.1, 0.7], 0.74, &[[0.3, 0.24, 0.2], [0.2, 0.2, 0.1]], Cover::of(Pattern::Cardboard));
    b.stack([2.6, 0.8], 0.74, &[[0.2, 0.28, 0.04]], Cover::of(Pattern::Text));
    b.chair([3.2, 0.8], 3.0, wood.with_middle(0.45));
    picture(b, [2.6, 0.015], 1.6, 1.0, 0.8, 0.0, Pattern::Picture);
    picture(b, [0.015, 3.2], 1.6, 0.8, 0.8, FRAC_PI_2, Pattern::Picture);
    picture(b, [0.015, 0.8], 1.6, 0.8, 0.9, FRAC_PI_2, Pattern::Poster);
    b.stack([0.3, 0.8], 0.0, &[[0.4, 0.6, 0.4], [0.3, 0.4, 0.3]], Cover::of(Pattern::Cardboard));
}

/// D: a desk, book shelves, boxes.
fn study(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    b.bookshelf([0.2, 2.0], [2.2, 0.32, 2.2], 6, -FRAC_PI_2, wood.with_middle(0.4));
    b.table([2.3, 3.6], [1.7, 0.65, 0.74], 0.0, wood.with_middle(0.6));
    b.place([2.3, 3.8], 0.84, [0.6, 0.06, 0.4], 0.05, Cover::of(Pattern::Text).enlarged(0.8));
    b.stack([1.7, 3.65], 0.74, &[[0.3, 0.22, 0.06], [0.26, 0.2, 0.05]], Cover::of(Pattern::Cover));
    b.stack([2.9, 3.7], 0.74, &[[0.2, 0.2, 0.3]], Cover::of(Pattern::Picture).enlarged(0.5));
    picture(b, [1.6, 3.985], 1.75, 0.9, 0.7, 0.0, Pattern::Picture);
    picture(b, [2.9, 3.985], 1.7, 0.8, 0.8, 0.0, Pattern::Poster);
    picture(b, [0.7, 3.985], 1.6, 0.5, 0.8, 0.0, Pattern::Text);
    b.place([0.5, 3.55], 0.0, [0.6, 0.5, 1.1], 0.0, Cover::of(Pattern::Planks).enlarged(0.4));
    b.stack([3.9, 3.6], 0.0, &[[0.6, 0.5, 0.6], [0.5, 0.4, 0.4]], Cover::of(Pattern::Cardboard));
    b.chair([2.6, 2.9], FRAC_PI_2 + 0.3, wood.with_middle(0.3));
    b.bookshelf([3.0, 0.2], [1.9, 0.32, 1.2], 3, 0.0, wood.with_middle(0.5));
    b.stack([2.5, 0.2], 1.2, &[[0.3, 0.24, 0.3]], Cover::of(Pattern::Poster).enlarged(0.6));
    picture(b, [3.2, 0.015], 1.8, 0.9, 0.6, 0.0, Pattern::Poster);
    picture(b, [0.35, 0.015], 1.6, 0.45, 0.7, 0.0, Pattern::Picture);
    b.stack([0.35, 0.35], 0.0, &[[0.45, 0.4, 0.5], [0.3, 0.3, 0.3]], Cover::of(Pattern::Cover));
    picture(b, [4.385, 0.8], 1.6, 0.9, 0.9, FRAC_PI_2, Pattern::Text);
    b.place([2.0, 1.9], 0.0, [1.8, 1.4, 0.015], -0.1, Cover::of(Pattern::Wallpaper));
}

/// Pictures, a bench, boxes and a coat stand.
fn corridor(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    picture(b, [4.2, 0.015], 1.5, 0.9, 0.8, 0.0, Pattern::Picture);
    picture(b, [5.5, 0.015], 1.5, 0.7, 0.9, 0.0, Pattern::Text);
    picture(b, [1.6, 0.015], 1.5, 0.9, 0.9, 0.0, Pattern::Poster);
    picture(b, [8.3, 0.015], 1.5, 0.7, 0.8, 0.0, Pattern::Poster);
    picture(b, [2.6, 1.585], 1.5, 0.8, 0.9, 0.0, Pattern::Picture);
    picture(b, [4.1, 1.585], 1.5, 1.0, 0.8, 0.0, Pattern::Poster);
    picture(b, [7.3, 1.585], 1.5, 1.0, 0.9, 0.0, Pattern::Text);
    picture(b, [0.015, 0.8], 1.5, 0.8, 0.9, FRAC_PI_2, Pattern::Poster);
    picture(b, [8.985, 0.8], 1.5, 0.8, 0.9, FRAC_PI_2, Pattern::Picture);
    b.place([4.6, 0.2], 0.0, [1.2, 0.32, 0.45], 0.0, wood.with_middle(0.5));
    b.stack([4.3, 0.2], 0.45, &[[0.3, 0.24, 0.2]], Cover::of(Pattern::Fabric));
    b.place([3.4, 1.42], 0.0, [0.9, 0.3, 0.8], 0.0, wood.with_middle(0.6));
    b.stack([3.2, 1.42], 0.8, &[[0.2, 0.2, 0.25]], Cover::of(Pattern::Cardboard));
    b.stack([8.6, 1.25], 0.0, &[[0.5, 0.4, 0.5], [0.4, 0.3, 0.3]], Cover::of(Pattern::Cardboard));
    b.place([0.9, 0.2], 0.0, [0.5, 0.3, 0.7], 0.0, Cover::of(Pattern::Planks).enlarged(0.4));
    b.stack([2.1, 0.2], 0.0, &[[0.4, 0.3, 0.4], [0.3, 0.3, 0.3]], Cover::of(Pattern::Cover));
    b.place([0.3, 0.3], 0.0, [0.04, 0.04, 1.7], 0.4, wood.with_middle(0.3));
    b.place([0.3, 0.3], 1.0, [0.35, 0.3, 0.6], 0.4, Cover::of(Pattern::Fabric));
    for x in [1.0, 3.0, 5.0, 7.0] {
        b.place([x, 0.8], 2.56, [0.14, 1.6, 0.12], 0.0, wood.with_middle(0.42));
    }
}
