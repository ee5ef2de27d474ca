//! Two identical rooms on a repeating corridor, between which no loop may be closed.
//!
//! Everything is repeated one bay further east, the corridor once more: textures, doors, light.

use crate::capture::simulator::flat::{Door, ROOM_M, Side, enclose, living, stage};
use crate::capture::simulator::pattern::Pattern;
use crate::capture::simulator::route::{Route, Waypoint, waypoint};
use crate::capture::simulator::scene::{Builder, Cover, Furnished, picture};

/// Period of the repetition along x, metres.
pub const PERIOD_M: f32 = 4.6;
/// Number of bays of the corridor.
const BAYS: usize = 3;
/// Width of the corridor, metres.
const CORRIDOR_M: f32 = 1.6;

/// From the corridor into the first room, around and out.
const BAY: [Waypoint; 20] = [
    waypoint(0.9, 5.0, -20.0, -8.0),
    waypoint(1.6, 5.0, -38.0, -8.0),
    waypoint(2.3, 4.9, -60.0, -8.0),
    waypoint(2.8, 4.4, -80.0, -8.0),
    waypoint(2.9, 3.7, -95.0, -8.0),
    waypoint(2.7, 3.0, -105.0, -9.0),
    waypoint(2.0, 2.8, -110.0, -10.0),
    waypoint(1.4, 2.4, -95.0, -10.0),
    waypoint(1.2, 1.8, -65.0, -9.0),
    waypoint(1.7, 1.3, -35.0, -8.0),
    waypoint(2.4, 1.2, -5.0, -8.0),
    waypoint(3.0, 1.5, 25.0, -8.0),
    waypoint(3.3, 2.1, 52.0, -8.0),
    waypoint(3.2, 2.8, 72.0, -8.0),
    waypoint(3.0, 3.5, 78.0, -8.0),
    waypoint(3.0, 4.2, 62.0, -8.0),
    waypoint(3.2, 4.8, 38.0, -8.0),
    waypoint(3.8, 5.05, 15.0, -8.0),
    waypoint(4.4, 5.05, 0.0, -8.0),
    waypoint(5.0, 5.05, -10.0, -8.0),
];

/// From the second room to the end of the corridor and back.
const REST: [Waypoint; 23] = [
    waypoint(10.1, 5.0, 0.0, -8.0),
    waypoint(10.9, 4.9, 15.0, -8.0),
    waypoint(11.6, 4.8, 32.0, -8.0),
    waypoint(12.1, 4.7, 52.0, -8.0),
    waypoint(12.5, 4.7, 78.0, -8.0),
    waypoint(12.7, 4.9, 104.0, -8.0),
    waypoint(12.6, 5.2, 130.0, -8.0),
    waypoint(12.2, 5.3, 152.0, -8.0),
    waypoint(11.6, 5.2, 168.0, -8.0),
    waypoint(10.8, 5.1, 178.0, -8.0),
    waypoint(9.9, 5.0, 190.0, -8.0),
    waypoint(8.9, 4.9, 200.0, -8.0),
    waypoint(7.9, 4.9, 190.0, -8.0),
    waypoint(6.9, 5.0, 172.0, -8.0),
    waypoint(5.9, 5.1, 165.0, -8.0),
    waypoint(4.9, 5.1, 175.0, -8.0),
    waypoint(3.9, 5.1, 188.0, -8.0),
    waypoint(2.9, 5.2, 196.0, -8.0),
    waypoint(2.0, 5.3, 212.0, -8.0),
    waypoint(1.4, 5.4, 236.0, -8.0),
    waypoint(0.95, 5.45, 262.0, -8.0),
    waypoint(0.65, 5.2, 288.0, -8.0),
    waypoint(0.65, 4.85, 315.0, -8.0),
];

/// Into the first room and out, into the second and out, to the end of the corridor and back.
static ROUND: [Waypoint; 63] = twins_round();

/// The round; the second room's part is the first one's, shifted by a period.
const fn twins_round() -> [Waypoint; 63] {
    let mut round = [BAY[0]; 63];
    let mut i = 0;
    while i < 20 {
        round[i] = BAY[i];
        round[20 + i] = BAY[i];
        round[20 + i].at[0] += PERIOD_M as f64;
        i += 1;
    }
    let mut i = 0;
    while i < 23 {
        round[40 + i] = REST[i];
        i += 1;
    }
    round
}

static ROUTE: Route = Route { waypoints: &ROUND, turn_deg: 360.0, height_m: 1.4, rounds: 1 };

/// Builds the rooms and the corridor; the seed chooses textures and small objects, the same in both rooms.
pub fn twins(seed: u64) -> Furnished {
    let mut b = Builder::new(seed, [0.0; 3]);
    let plaster = Cover::of(Pattern::Plaster);
    let paper = Cover::of(Pattern::Wallpaper);
    let brick = Cover::of(Pattern::Brick).with_contrast(0.6);
    let planks = Cover::of(Pattern::Planks).with_contrast(0.8);
    let door = (2.4, 3.4);
    let covers = [plaster, paper, brick, plaster, planks, plaster];
    enclose(&mut b, [0.0, 0.0], ROOM_M, covers, &[Door::new(Side::North, door.0, door.1)]);
    living(&mut b);
    repeat(&mut b, 0, 1);
    let corridor = b.blocks.len();
    // A bay of the corridor has no ends: those are added afterwards.
    bay(&mut b, door);
    repeat(&mut b, corridor, BAYS - 1);
    close(&mut b, door);
    Furnished { blocks: b.blocks, stage: stage(&ROUTE) }
}

/// Repeats everything from the block `first` on, `times` times, each a period further east.
fn repeat(b: &mut Builder, first: usize, times: usize) {
    let originals = b.blocks[first..].to_vec();
    for time in 1..=times {
        let shift = time as f32 * PERIOD_M;
        b.blocks.extend(originals.iter().cloned().map(|mut block| {
            block.centre[0] += shift;
            block.lamp[0] += shift;
            block
        }));
    }
}

/// One bay of the corridor with its door, pictures and a box.
fn bay(b: &mut Builder, door: (f32, f32)) {
    let paper = Cover::of(Pattern::Wallpaper).enlarged(1.3).with_middle(0.55);
    let brick = Cover::of(Pattern::Brick).with_contrast(0.6);
    let carpet = Cover::of(Pattern::Carpet).with_contrast(0.7);
    let wood = Cover::of(Pattern::Veneer);
    let origin = [-0.1, ROOM_M[1] + 0.2];
    let door = Door::new(Side::South, door.0 + 0.1, door.1 + 0.1);
    let covers = [paper, paper, paper, brick, carpet, Cover::of(Pattern::Plaster)];
    let first = b.blocks.len();
    enclose(b, origin, [PERIOD_M, CORRIDOR_M], covers, &[door]);
    // Without the end walls, and without the parts of floor and ceiling below and above them.
    let centre = b.origin[0] + 0.5 * PERIOD_M;
    let mut blocks = b.blocks.split_off(first);
    let is_across = |half: [f32; 3]| half[0] < half[1] && half[1] > 0.5 * CORRIDOR_M;
    blocks.retain(|block| !is_across(block.half));
    for block in &mut blocks {
        if block.half[0] > 0.5 * PERIOD_M {
            (block.centre[0], block.half[0]) = (centre, 0.5 * PERIOD_M);
        }
    }
    b.blocks.extend(blocks);
    picture(b, [1.2, 0.015], 1.5, 0.9, 0.8, 0.0, Pattern::Picture);
    picture(b, [4.1, 0.015], 1.5, 0.6, 0.8, 0.0, Pattern::Text);
    picture(b, [1.0, CORRIDOR_M - 0.015], 1.5, 0.8, 0.8, 0.0, Pattern::Poster);
    picture(b, [3.3, CORRIDOR_M - 0.015], 1.5, 1.0, 0.9, 0.0, Pattern::Picture);
    b.stack([2.2, 1.42], 0.0, &[[0.4, 0.28, 0.4], [0.3, 0.24, 0.3]], Cover::of(Pattern::Cardboard));
    b.place([2.3, 0.5 * CORRIDOR_M], 2.56, [0.14, CORRIDOR_M, 0.12], 0.0, wood.with_middle(0.42));
}

/// The ends of the corridor, and a door leaf in the bay without a room.
fn close(b: &mut Builder, door: (f32, f32)) {
    let (first, last) = (-0.1, BAYS as f32 * PERIOD_M - 0.1);
    let middle = ROOM_M[1] + 0.2 + 0.5 * CORRIDOR_M;
    b.origin = [0.0, 0.0];
    for x in [first - 0.05, last + 0.05] {
        b.lamp[0] = if x < 0.0 { first + 0.5 * PERIOD_M } else { last - 0.5 * PERIOD_M };
        let cover = Cover::of(Pattern::Wallpaper).enlarged(1.3).with_middle(0.55);
        b.place([x, middle], 0.0, [0.1, CORRIDOR_M + 0.4, 2.7], 0.0, cover);
        let inside = if x < 0.0 { first + 0.015 } else { last - 0.015 };
        picture(b, [inside, middle], 1.5, 0.8, 0.9, std::f32::consts::FRAC_PI_2, Pattern::Poster);
    }
    let leaf = (BAYS - 1) as f32 * PERIOD_M + 0.5 * (door.0 + door.1);
    let wood = Cover::of(Pattern::Veneer).with_middle(0.6);
    b.place([leaf, ROOM_M[1] + 0.12], 0.0, [door.1 - door.0, 0.05, 2.1], 0.0, wood);
}
