//! The map as one surface: size, time, and error against the true surface if a source has depth: `cargo run --release
//! --example surface_figures -- SOURCE [--given-poses] [--resolution R] [--ply FILE] [--keep MAP]`. MAP stores the map
//! of the replay, so that the next call only fuses it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use nalgebra::Vector3;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::service::map_file::{read_map, write_map};
use semidense::service::replay::{PoseOrigin, ReplayConfig, replay};
use semidense::service::results::ply::write_surface;
use semidense::slam::evaluation::surface_error::{SeenPoint, TrueSurface};
use semidense::slam::evaluation::umeyama::{TrajectoryAlignment, umeyama};
use semidense::slam::fusion::{FusionParams, SurfacePoint, fuse};
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::Keyframe;
use semidense::slam::map::Map;
use semidense::slam::trajectory::StampedPose;

type Failure = Box<dyn std::error::Error>;

/// Number of points compared with the true surface: shares are accurate to half a per cent.
const COMPARED: usize = 10_000;

#[derive(Default)]
struct Arguments {
    source: String,
    given_poses: bool,
    params: FusionParams,
    ply: Option<PathBuf>,
    keep: Option<PathBuf>,
}

fn arguments() -> Result<Arguments, Failure> {
    let mut found = Arguments::default();
    let mut given = std::env::args().skip(1);
    while let Some(word) = given.next() {
        let mut value = || given.next().ok_or(format!("{word} needs a value"));
        match word.as_str() {
            "--given-poses" => found.given_poses = true,
            "--resolution" => found.params.resolution = value()?.parse()?,
            "--neighbours" => found.params.max_neighbours = value()?.parse()?,
            "--ply" => found.ply = Some(value()?.into()),
            "--keep" => found.keep = Some(value()?.into()),
            _ => found.source = word,
        }
    }
    Ok(found)
}

fn main() -> Result<(), Failure> {
    let arguments = arguments()?;
    let name = SourceName::parse(arguments.source.as_ref())?;
    let mut source = open(&name, None, &SourceParams::default())?;
    let map = map_of(source.as_mut(), &arguments)?;
    let keyframes: Vec<&Keyframe> = map.keyframes.iter().collect();
    let all: usize = keyframes.iter().map(|keyframe| keyframe.points.len()).sum();
    println!("{} keyframes, {all} points", keyframes.len());
    let mut surface = Vec::new();
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let (begin, begin_cpu) = (Instant::now(), cpu_secs());
        surface = pool.install(|| fuse(&keyframes, &arguments.params, &mut |_, _| ()));
        let (wall, cpu) = (begin.elapsed().as_secs_f64(), cpu_secs() - begin_cpu);
        println!("{threads} threads: {wall:.2} s, {cpu:.2} s of CPU, {} points", surface.len());
    }
    let with_normal = surface.iter().filter(|point| point.normal != [0.0; 3]).count();
    println!("{:.1} % have a normal", 100.0 * with_normal as f64 / surface.len() as f64);
    if let Some(path) = &arguments.ply {
        write_surface(path, &surface)?;
    }
    compare(source.as_mut(), &map, &surface)
}

/// CPU time of all threads of this process, seconds.
fn cpu_secs() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// The map of a replay, or the one stored by an earlier call.
fn map_of(source: &mut dyn FrameSource, arguments: &Arguments) -> Result<Map, Failure> {
    if let Some(path) = arguments.keep.as_deref().filter(|path| Path::exists(path)) {
        return Ok(read_map(path)?);
    }
    let poses = if arguments.given_poses { PoseOrigin::GroundTruth } else { PoseOrigin::Tracker };
    let config = ReplayConfig { poses, ..ReplayConfig::default() };
    source.prepare(&mut |_, _| true)?;
    let record = replay(source, &arguments.source, &config, &mut |_| true)?;
    if let Some(path) = &arguments.keep {
        write_map(path, &record.map, &mut || ())?;
    }
    Ok(record.map)
}

/// Prints errors before and after fusion against the true surface; nothing without ground truth.
fn compare(
    source: &mut dyn FrameSource,
    map: &Map,
    surface: &[SurfacePoint],
) -> Result<(), Failure> {
    let poses = source.ground_truth().to_vec();
    let pose_at = |nanos: i64| poses.iter().find(|pose| (pose.nanos - nanos).abs() < 20_000_000);
    let (mut estimate, mut matched) = (Vec::new(), Vec::new());
    let mut truth = TrueSurface::default();
    let k = source.intrinsics();
    for keyframe in &map.keyframes {
        let Some(pose) = pose_at(keyframe.capture_nanos) else { continue };
        let place = keyframe.map_from_keyframe.rigid;
        estimate.push(StampedPose { nanos: keyframe.capture_nanos, world_from_camera: place });
        matched.push(*pose);
        if let Some(depth) = source.depth_at(keyframe.capture_nanos)? {
            truth.add(&depth, &k, &pose.world_from_camera);
        }
    }
    if matched.is_empty() {
        return Ok(());
    }
    let world_from_map = umeyama(&estimate, &matched, TrajectoryAlignment::Sim3)?;
    let seen = |at: Vector3<f64>| {
        let distances = matched.iter().map(|pose| (at - pose.world_from_camera.translation).norm());
        SeenPoint { position: at, distance: distances.fold(f64::INFINITY, f64::min) }
    };
    let before: Vec<SeenPoint> = all_points(map, &world_from_map).map(seen).collect();
    let evenly = one_a_cell(&before);
    let position = |point: &SurfacePoint| Vector3::from(point.position.map(f64::from));
    let after: Vec<SeenPoint> =
        surface.iter().map(|p| seen(world_from_map * position(p))).collect();
    for (name, points) in
        [("all points", &before), ("all, one a cell", &evenly), ("the surface", &after)]
    {
        let some = sample(points, COMPARED);
        println!("{name}: {} points, {:?}", points.len(), truth.errors(&some));
    }
    println!("the first {COMPARED}: {:?}", truth.errors(&after[..COMPARED.min(after.len())]));
    let shown = truth.shown(&sample(&before, COMPARED / 2), &after);
    println!("of what the right ones of all points show the surface shows {shown:.4}");
    Ok(())
}

fn sample(points: &[SeenPoint], count: usize) -> Vec<SeenPoint> {
    points.iter().step_by(points.len().div_ceil(count).max(1)).copied().collect()
}

/// One point for each cell as wide as the surface's: the one with the lowest pseudo-random number.
fn one_a_cell(points: &[SeenPoint]) -> Vec<SeenPoint> {
    const SHARE: f64 = 0.005;
    const SCATTER: u64 = 0x9E37_79B9_7F4A_7C15;
    let mut cells: HashMap<(i32, [i32; 3]), (u64, SeenPoint)> = HashMap::new();
    for (i, point) in (0u64..).zip(points) {
        let level = (2.0 * (SHARE * point.distance).log2()).floor();
        let side = (0.5 * level).exp2();
        let cell = [0, 1, 2].map(|c| (point.position[c] / side).floor() as i32);
        let rank = i.wrapping_mul(SCATTER);
        let first = cells.entry((level as i32, cell)).or_insert((rank, *point));
        if rank < first.0 {
            *first = (rank, *point);
        }
    }
    let mut ranked: Vec<_> = cells.into_values().collect();
    ranked.sort_by_key(|(rank, _)| *rank);
    ranked.into_iter().map(|(_, point)| point).collect()
}

fn all_points<'a>(
    map: &'a Map,
    world_from_map: &'a Sim3,
) -> impl Iterator<Item = Vector3<f64>> + 'a {
    map.keyframes.iter().flat_map(move |keyframe| {
        let k = &keyframe.intrinsics;
        let is_known = |p: &f32, d: f32| d > 0.0 && p.sqrt() <= 0.1 * d;
        let usable = keyframe.points.iter().filter(move |p| is_known(&p.variance, p.inverse_depth));
        usable.map(move |p| {
            let (x, y) = ((f64::from(p.u) - k.cx) / k.fx, (f64::from(p.v) - k.cy) / k.fy);
            let in_keyframe = Vector3::new(x, y, 1.0) / f64::from(p.inverse_depth);
            *world_from_map * (keyframe.map_from_keyframe * in_keyframe)
        })
    })
}
