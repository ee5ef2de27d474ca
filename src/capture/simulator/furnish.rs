//! The scenes: a furnished room, a plane, a corridor; those with several rooms are in [`flat`] and [`twins`].

use std::f32::consts::FRAC_PI_2;

use crate::capture::simulator::pattern::Pattern;
use crate::capture::simulator::scene::{Builder, Cover, Furnished, Scene, Stage, picture};
use crate::capture::simulator::scene_kind::SceneKind;
use crate::capture::simulator::{flat, twins};

/// Builds a scene and paints its textures, in parallel on the current rayon pool.
pub fn build(kind: SceneKind, seed: u64) -> Scene {
    Scene::new(furnish(kind, seed).blocks, seed)
}

/// Furnishes a scene; the seed chooses textures and small objects, not the positions of furniture.
pub fn furnish(kind: SceneKind, seed: u64) -> Furnished {
    match kind {
        SceneKind::Room => room(seed),
        SceneKind::Plane => plane(seed),
        SceneKind::Corridor => corridor(seed),
        SceneKind::Flat => flat::flat(seed),
        SceneKind::Twins => twins::twins(seed),
    }
}

/// 6 × 5 × 3 m. The camera walks in the west half and looks east.
fn room(seed: u64) -> Furnished {
    let mut b = Builder::new(seed, [2.8, 2.4, 2.75]);
    let wall = Cover::of(Pattern::Plaster);
    let paper = Cover::of(Pattern::Wallpaper).enlarged(1.5);
    let covers = [
        wall,
        paper,
        wall.with_middle(0.52),
        Cover::of(Pattern::Brick).with_contrast(0.6),
        Cover::of(Pattern::Planks).with_contrast(0.8),
        wall.with_middle(0.56),
    ];
    b.shell([6.0, 5.0, 3.0], covers);
    room_floor(&mut b);
    room_east(&mut b);
    room_north(&mut b);
    room_south(&mut b);
    room_west(&mut b);
    let stage = Stage {
        centre: [2.5, 2.5, 1.5],
        reach: [1.3, 1.1, 0.25],
        start_rad: (0.0, std::f64::consts::TAU),
        heading_rad: 0.0,
        heading_swing_rad: 0.87,
        elevation_rad: -0.16,
        elevation_swing_rad: 0.12,
        route: None,
    };
    Furnished { blocks: b.blocks, stage }
}

/// Rug, low table with objects on it, dining table with chairs.
fn room_floor(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    b.place([3.1, 2.6], 0.0, [2.4, 1.7, 0.015], 0.1, Cover::of(Pattern::Carpet));
    b.table([3.2, 2.6], [1.1, 0.6, 0.42], 0.2, wood.with_middle(0.58));
    b.stack([3.0, 2.55], 0.42, &[[0.3, 0.22, 0.05], [0.24, 0.18, 0.04]], Cover::of(Pattern::Cover));
    b.stack([3.5, 2.7], 0.42, &[[0.14, 0.12, 0.16]], Cover::of(Pattern::Poster));
    b.table([4.95, 1.35], [0.9, 1.4, 0.75], 0.08, wood.with_middle(0.66));
    b.stack(
        [4.85, 1.0],
        0.75,
        &[[0.3, 0.24, 0.2], [0.2, 0.2, 0.14]],
        Cover::of(Pattern::Cardboard),
    );
    b.stack([5.05, 1.55], 0.75, &[[0.22, 0.3, 0.05], [0.2, 0.28, 0.04]], Cover::of(Pattern::Text));
    b.stack([4.75, 1.75], 0.75, &[[0.1, 0.1, 0.24]], Cover::of(Pattern::Poster).enlarged(0.5));
    b.chair([4.3, 1.6], 0.1, wood.with_middle(0.5));
    b.chair([4.35, 0.95], -0.3, wood.with_middle(0.55));
    b.chair([5.0, 2.35], -FRAC_PI_2 + 0.3, wood.with_middle(0.45));
    // A floor lamp: a thin pole in front of everything.
    b.place([4.75, 3.2], 0.0, [0.3, 0.3, 0.03], 0.4, wood);
    b.place([4.75, 3.2], 0.03, [0.04, 0.04, 1.4], 0.4, wood.with_middle(0.3));
    b.place(
        [4.75, 3.2],
        1.43,
        [0.34, 0.34, 0.3],
        0.4,
        Cover::of(Pattern::Fabric).with_middle(0.62),
    );
    for x in [1.5, 3.5, 5.2] {
        b.place([x, 2.5], 2.86, [0.16, 5.0, 0.14], 0.0, wood.with_middle(0.42));
    }
}

/// The wall at x = 6: a full bookshelf, pictures, a sideboard.
fn room_east(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    b.bookshelf([5.8, 3.4], [1.5, 0.32, 2.0], 5, FRAC_PI_2, wood.with_middle(0.55));
    b.stack([5.8, 3.1], 2.0, &[[0.3, 0.4, 0.25]], Cover::of(Pattern::Cardboard));
    picture(b, [5.985, 1.5], 1.75, 1.3, 0.95, FRAC_PI_2, Pattern::Picture);
    picture(b, [5.985, 0.45], 1.6, 0.5, 0.7, FRAC_PI_2, Pattern::Text);
    picture(b, [5.985, 2.4], 2.3, 0.4, 0.4, FRAC_PI_2, Pattern::Poster);
    b.place([5.75, 1.4], 0.0, [0.4, 1.5, 0.7], 0.0, wood.with_middle(0.48));
    b.stack([5.75, 0.9], 0.7, &[[0.2, 0.26, 0.3]], Cover::of(Pattern::Picture).enlarged(0.4));
    b.stack(
        [5.45, 4.55],
        0.0,
        &[[0.6, 0.5, 0.45], [0.5, 0.42, 0.4], [0.36, 0.32, 0.3]],
        Cover::of(Pattern::Cardboard),
    );
}

/// The wall at y = 5: a low cabinet with things on it under pictures.
fn room_north(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    b.bookshelf([3.4, 4.8], [1.8, 0.36, 0.85], 2, 0.0, wood.with_middle(0.6));
    b.stack(
        [2.9, 4.78],
        0.85,
        &[[0.3, 0.2, 0.22], [0.2, 0.14, 0.12]],
        Cover::of(Pattern::Cardboard),
    );
    b.stack([3.8, 4.78], 0.85, &[[0.2, 0.2, 0.34]], Cover::of(Pattern::Poster).enlarged(0.5));
    picture(b, [3.3, 4.985], 1.75, 0.9, 0.7, 0.0, Pattern::Picture);
    picture(b, [4.5, 4.985], 1.6, 0.7, 1.0, 0.0, Pattern::Poster);
    picture(b, [2.2, 4.985], 1.7, 0.6, 0.8, 0.0, Pattern::Text);
    b.chair([1.9, 4.3], -1.2, wood.with_middle(0.5));
}

/// The wall at y = 0: a sofa with cushions under pictures.
fn room_south(b: &mut Builder) {
    let fabric = Cover::of(Pattern::Fabric);
    b.place([2.9, 0.5], 0.0, [2.0, 0.85, 0.42], 0.0, fabric);
    b.place([2.9, 0.16], 0.42, [2.0, 0.24, 0.42], 0.0, fabric);
    for x in [1.85, 3.95] {
        b.place([x, 0.5], 0.0, [0.18, 0.85, 0.6], 0.0, fabric.with_middle(0.44));
    }
    b.place([2.3, 0.4], 0.42, [0.42, 0.16, 0.4], 0.25, Cover::of(Pattern::Carpet).enlarged(0.5));
    b.place([3.4, 0.4], 0.42, [0.4, 0.16, 0.38], -0.2, Cover::of(Pattern::Poster).enlarged(0.7));
    picture(b, [2.4, 0.015], 1.75, 0.8, 0.6, 0.0, Pattern::Poster);
    picture(b, [3.5, 0.015], 1.8, 0.9, 0.8, 0.0, Pattern::Picture);
    picture(b, [4.7, 0.015], 1.7, 0.6, 0.9, 0.0, Pattern::Text);
    b.stack([4.75, 0.3], 0.0, &[[0.5, 0.4, 0.35]], Cover::of(Pattern::Cardboard));
}

/// The wall at x = 0: a door, a shelf, a picture.
fn room_west(b: &mut Builder) {
    let wood = Cover::of(Pattern::Veneer);
    b.place([0.02, 1.0], 0.0, [0.05, 0.95, 2.1], 0.0, wood.with_middle(0.6));
    b.bookshelf([0.2, 3.2], [1.4, 0.32, 1.8], 4, -FRAC_PI_2, wood);
    picture(b, [0.015, 2.1], 1.7, 0.7, 0.9, FRAC_PI_2, Pattern::Picture);
    b.stack([0.4, 4.5], 0.0, &[[0.5, 0.45, 0.4], [0.4, 0.36, 0.34]], Cover::of(Pattern::Cardboard));
}

/// A large printed table top seen from above.
fn plane(seed: u64) -> Furnished {
    let mut b = Builder::new(seed, [0.0, 0.0, 3.0]);
    b.place(
        [0.0, 0.0],
        -0.1,
        [40.0, 40.0, 0.1],
        0.0,
        Cover::of(Pattern::Poster).with_contrast(0.8),
    );
    let stage = Stage {
        centre: [0.0, 0.0, 1.5],
        reach: [1.3, 1.1, 0.2],
        start_rad: (0.0, std::f64::consts::TAU),
        heading_rad: 0.0,
        heading_swing_rad: 0.5,
        elevation_rad: -1.25,
        elevation_swing_rad: 0.1,
        route: None,
    };
    Furnished { blocks: b.blocks, stage }
}

/// 24 × 2.4 × 2.6 m with doors, pictures and boxes along the walls.
fn corridor(seed: u64) -> Furnished {
    let mut b = Builder::new(seed, [12.0, 1.2, 2.4]);
    let (length, width) = (24.0, 2.4);
    let wall = Cover::of(Pattern::Wallpaper).with_middle(0.54);
    let covers = [
        wall,
        wall,
        wall,
        Cover::of(Pattern::Brick).with_contrast(0.6),
        Cover::of(Pattern::Carpet).with_contrast(0.7),
        Cover::of(Pattern::Plaster),
    ];
    b.shell([length, width, 2.6], covers);
    for k in 0..12 {
        let x = 1.0 + 2.0 * k as f32;
        let pattern = [Pattern::Picture, Pattern::Poster, Pattern::Text][k % 3];
        let across = if k % 2 == 0 { 0.015 } else { width - 0.015 };
        picture(&mut b, [x, across], 1.5, 0.7, 0.8, 0.0, pattern);
        let door = if k % 2 == 0 { width - 0.02 } else { 0.02 };
        let cover = Cover::of(Pattern::Veneer).with_middle(0.6);
        b.place([x, door], 0.0, [0.9, 0.06, 2.05], 0.0, cover);
        let side = if b.stream.index(2) == 0 { 0.25 } else { width - 0.25 };
        b.stack(
            [x + 1.0, side],
            0.0,
            &[[0.4, 0.32, 0.4], [0.3, 0.26, 0.3]],
            Cover::of(Pattern::Cardboard),
        );
        b.place([x + 0.5, 0.5 * width], 2.5, [0.14, width, 0.1], 0.0, cover.with_middle(0.45));
    }
    let stage = Stage {
        centre: [10.0, 1.2, 1.45],
        reach: [8.0, 0.25, 0.12],
        // Near the west end and walking east.
        start_rad: (-1.2, -1.0),
        heading_rad: 0.0,
        heading_swing_rad: 0.35,
        elevation_rad: -0.08,
        elevation_swing_rad: 0.08,
        route: None,
    };
    Furnished { blocks: b.blocks, stage }
}
