//! Figures of the similarities measured between keyframes: every pair of a map, with and without a common view
//! according to ground truth.
//!
//! ```text
//! cargo run --release --example loop_figures -- tum:DIR
//! ```

use std::error::Error;
use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use nalgebra::Vector3;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::service::config::Config;
use semidense::service::corrected::Corrections;
use semidense::service::replay::{DepthOrigin, PoseOrigin, ReplayConfig, replay};
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::graph::constraint::{
    ConstraintParams, ConstraintSolver, KeyframeView, Measurement, Refusal, Start,
};
use semidense::slam::keyframe::Keyframe;
use semidense::slam::trajectory::StampedPose;

/// Every pair of keyframes of a map, measured from the true rotation.
#[derive(Debug, Parser)]
struct Arguments {
    /// Source with ground truth and depth images.
    source: SourceName,
    /// Number of frames to read.
    #[arg(long)]
    frames: Option<usize>,
    /// Use every n-th keyframe.
    #[arg(long, default_value_t = 1)]
    stride: usize,
    /// Compare with the map of the run, which was estimated jointly, for sources whose ground truth is worse.
    #[arg(long)]
    against_map: bool,
    /// Only print the outcomes of the run's own search for loops.
    #[arg(long)]
    searches: bool,
    /// Print a line for each pair.
    #[arg(long)]
    all: bool,
    /// Start around the truth instead: share accepted over the error of the start.
    #[arg(long)]
    basin: bool,
}

/// A keyframe with its true pose and unit.
struct Placed {
    keyframe: Keyframe,
    world_from_keyframe: Sim3,
    view: KeyframeView,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("loop_figures: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let mut source = open(&arguments.source, None, &SourceParams::default())?;
    let config = Config::default();
    let config = ReplayConfig {
        map: Default::default(),
        tracker: config.tracking,
        mapper: config.mapping,
        poses: PoseOrigin::Tracker,
        initial_depth: DepthOrigin::Images,
        max_frames: arguments.frames,
        strict: true,
        corrections: Corrections::default(),
        mask: None,
    };
    let name = arguments.source.to_string();
    let record = replay(source.as_mut(), &name, &config, &mut |_| true)?;
    if arguments.searches {
        for search in record.searches.iter().flatten() {
            let (millis, report) = (1e-6 * search.nanos as f64, search.report);
            let place = |id: u64| {
                let keyframe = record.map.get(id)?;
                let nearest = |p: &&StampedPose| p.nanos.abs_diff(keyframe.capture_nanos);
                Some(record.ground_truth.iter().min_by_key(nearest)?.world_from_camera)
            };
            let pair = report.measured.map(|(i, j, _)| [i, j]);
            let pair = pair.or(report.other.map(|other| [report.keyframe_id, other]));
            let apart = pair.and_then(|[i, j]| Some(place(j)?.inverse() * place(i)?));
            let apart = apart.map(|apart| [apart.translation.norm(), apart.rotation.angle()]);
            let found = report.measured.map(|(_, _, j_from_i)| {
                [j_from_i.rigid.translation.norm(), j_from_i.rigid.rotation.angle(), j_from_i.scale]
            });
            println!(
                "frame {} {millis:.0} ms {} {pair:?} likeness {} truth {apart:.2?} measured {found:.2?} {:?}",
                search.sequence, report.keyframe_id, report.likeness, report.outcome
            );
        }
        return Ok(());
    }
    let solver = ConstraintSolver::new(ConstraintParams::default());
    let mut placed = Vec::new();
    let begin = Instant::now();
    for keyframe in record.map.keyframes.iter().step_by(arguments.stride) {
        let truth =
            record.ground_truth.iter().min_by_key(|p| p.nanos.abs_diff(keyframe.capture_nanos));
        let Some(truth) = truth else { continue };
        let world_from_keyframe = if arguments.against_map {
            keyframe.map_from_keyframe
        } else {
            let Some(unit) = unit_m(source.as_mut(), keyframe) else { continue };
            Sim3::new(truth.world_from_camera, unit)
        };
        placed.push(Placed {
            view: solver.view(keyframe),
            keyframe: keyframe.clone(),
            world_from_keyframe,
        });
    }
    println!(
        "{} keyframes, prepared in {:.1} ms each",
        placed.len(),
        1e3 * begin.elapsed().as_secs_f64() / placed.len().max(1) as f64
    );
    if arguments.basin {
        basin(&solver, &placed);
        return Ok(());
    }
    pairs(&solver, &placed, arguments.all);
    Ok(())
}

/// Length of the keyframe's unit: the median ratio of true depth to its own.
fn unit_m(source: &mut dyn FrameSource, keyframe: &Keyframe) -> Option<f64> {
    let depth = source.depth_at(keyframe.capture_nanos).ok().flatten()?;
    let at = |u: u16, v: u16| depth.at(usize::from(u), usize::from(v));
    let mut ratios: Vec<f32> = keyframe
        .points
        .iter()
        .map(|p| at(p.u, p.v) * p.inverse_depth)
        .filter(|ratio| ratio.is_finite() && *ratio > 0.0)
        .collect();
    if ratios.len() < 100 {
        return None;
    }
    ratios.sort_by(f32::total_cmp);
    Some(f64::from(ratios[ratios.len() / 2]))
}

/// Share of the points of one keyframe that the other sees, according to ground truth.
fn overlap(i: &Placed, j: &Placed) -> f64 {
    let world_from_j = SE3 { ..j.world_from_keyframe.rigid };
    i.keyframe.usage(&i.world_from_keyframe.inverse_transform_pose(&world_from_j))
}

fn truth(i: &Placed, j: &Placed) -> Sim3 {
    j.world_from_keyframe.inverse() * i.world_from_keyframe
}

/// Errors of a measurement: translation in metres, rotation in degrees, scale, normalised square.
fn errors(i: &Placed, j: &Placed, found: &Measurement) -> [f64; 4] {
    let truth = truth(i, j);
    let error = (found.j_from_i * truth.inverse()).log();
    let rigid =
        (found.j_from_i.rigid.translation - truth.rigid.translation) * j.world_from_keyframe.scale;
    let nees =
        found.covariance.try_inverse().map_or(f64::NAN, |inverse| error.dot(&(inverse * error)));
    [rigid.norm(), error.fixed_rows::<3>(3).norm().to_degrees(), error[6], nees]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn pairs(solver: &ConstraintSolver, placed: &[Placed], prints_all: bool) {
    /// Classes of the smaller of both shares in view.
    const CLASSES: [f64; 6] = [0.0, 0.05, 0.3, 0.5, 0.7, 0.85];
    /// Errors above which a measurement is of a different place: metres, degrees.
    const FALSE_M: f64 = 0.2;
    const FALSE_DEG: f64 = 8.0;
    let mut classes = vec![(0, 0, 0, Vec::new(), Vec::new()); CLASSES.len()];
    let mut millis: [Vec<f64>; 2] = Default::default();
    let mut refusals = std::collections::BTreeMap::<(usize, String), u32>::new();
    for (a, i) in placed.iter().enumerate() {
        for (b, j) in placed.iter().enumerate().skip(a + 1) {
            let seen = overlap(i, j).min(overlap(j, i));
            let class = CLASSES.iter().rposition(|&from| seen >= from).unwrap_or(0);
            let begin = Instant::now();
            let rotation = truth(i, j).rigid.rotation;
            let found = solver.measure(&i.view, &j.view, Start::Rotation(rotation));
            millis[usize::from(found.is_ok())].push(1e3 * begin.elapsed().as_secs_f64());
            let of = &mut classes[class];
            of.0 += 1;
            match found {
                Ok(found) => {
                    let errors = errors(i, j, &found);
                    of.1 += 1;
                    let is_false = errors[0] > FALSE_M || errors[1] > FALSE_DEG;
                    of.2 += u32::from(is_false);
                    of.3.push(errors);
                    of.4.push(found.reciprocal_chi2);
                    if prints_all || is_false {
                        let figures = found.alignments.map(|a| {
                            [
                                a.usage,
                                a.inlier_share,
                                a.agreement.share,
                                f64::from(a.agreement.tiles),
                                a.depth_share,
                                a.depth_inlier_share,
                                a.log_gain,
                                a.distance,
                            ]
                        });
                        println!(
                            "{a} {b} seen {seen:.2} errors {errors:.3?} chi2 {:.1} {figures:.2?}{}",
                            found.reciprocal_chi2,
                            if is_false { " FALSE" } else { "" }
                        );
                    }
                }
                Err(refusal) => {
                    let name = match refusal {
                        Refusal::NotReciprocal(_) => "NotReciprocal".to_string(),
                        other => format!("{other:?}"),
                    };
                    if prints_all && seen > 0.5 {
                        println!("{a} {b} seen {seen:.2} refused {refusal:?}");
                    }
                    *refusals.entry((class, name)).or_default() += 1;
                }
            }
        }
    }
    for (from, (all, accepted, wrong, errors, chi2)) in CLASSES.into_iter().zip(classes) {
        let of = |k: usize| median(errors.iter().map(|e: &[f64; 4]| e[k].abs()).collect());
        println!(
            "seen from {from:.2}: {all} pairs, {accepted} accepted, {wrong} false; median error {:.3} m, {:.2}°, scale {:.3}, NEES {:.1}, reciprocal {:.1}",
            of(0),
            of(1),
            of(2),
            of(3),
            median(chi2)
        );
    }
    println!("refusals {refusals:?}");
    let [refused, accepted] = millis.map(|mut all| {
        all.sort_by(f64::total_cmp);
        (all.get(all.len() / 2).copied(), all.get(all.len() * 95 / 100).copied())
    });
    println!("ms, median and 95 %: accepted {accepted:.1?}, refused {refused:.1?}");
}

/// Starts around the truth for pairs that see at least half of each other.
fn basin(solver: &ConstraintSolver, placed: &[Placed]) {
    let mut good = Vec::new();
    for (a, i) in placed.iter().enumerate() {
        for j in placed.iter().skip(a + 2).step_by(3) {
            if overlap(i, j).min(overlap(j, i)) < 0.5 || good.len() > 40 {
                continue;
            }
            let truth = truth(i, j);
            if solver.measure(&i.view, &j.view, Start::Similarity(truth)).is_ok() {
                good.push((i, j, truth));
            }
        }
    }
    let share = |twist: &dyn Fn(f64) -> [f64; 7]| {
        let accepted = good.iter().enumerate().filter(|(k, (i, j, truth))| {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            let start = Sim3::exp(&twist(sign).into()) * *truth;
            solver.measure(&i.view, &j.view, Start::Similarity(start)).is_ok()
        });
        accepted.count() as f64 / good.len().max(1) as f64
    };
    println!("{} pairs that are accepted from the truth", good.len());
    for by in [0.05, 0.1, 0.2, 0.3, 0.4] {
        let axis = Vector3::x() * by;
        println!(
            "aside by {by} mean depths: {:.2}; ahead {:.2}",
            share(&|s| [axis.x * s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
            share(&|s| [0.0, 0.0, axis.x * s, 0.0, 0.0, 0.0, 0.0])
        );
    }
    for degrees in [2.0f64, 5.0, 10.0, 15.0, 20.0] {
        let by = degrees.to_radians();
        println!(
            "panned by {degrees}°: {:.2}; rolled {:.2}",
            share(&|s| [0.0, 0.0, 0.0, 0.0, s * by, 0.0, 0.0]),
            share(&|s| [0.0, 0.0, 0.0, 0.0, 0.0, s * by, 0.0])
        );
    }
    for factor in [1.2f64, 1.5, 2.0, 3.0] {
        println!(
            "scale wrong by {factor}: {:.2}",
            share(&|s| [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, s * factor.ln()])
        );
    }
}
