//! Fits the inflation of the covariance on some simulated scenes and validates it on others.
//!
//! The mean normalised squared error of six unknowns with a correct covariance is 6 (3 each for translation and
//! rotation alone), and 95 % of the frames are below 12.6.

use std::error::Error;

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{SensorParams, SimulatorParams};
use semidense::capture::simulator::scene_kind::SceneKind;
use semidense::slam::tracker::TrackerParams;

use crate::sequence::{KeyframeChoice, Recorded, TrackedFrame, track};

/// Parameters of the fit.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Number of frames of each simulated sequence
    #[arg(long, default_value_t = 150)]
    frames: usize,
    /// Tracker parameters, e.g. `alignment.huber=2.0;reference.finest_level=0`
    #[arg(long, default_value = "")]
    set: Vec<String>,
}

/// A simulated sequence, tracked at each of the depth noises (shares of the inverse depth).
struct Case {
    scene: SceneKind,
    seed: u64,
    image_noise: f64,
    depth_noises: &'static [f64],
}

const FIT: [Case; 3] = [
    Case { scene: SceneKind::Room, seed: 11, image_noise: 2.0, depth_noises: &[0.02, 0.1] },
    Case { scene: SceneKind::Corridor, seed: 12, image_noise: 3.0, depth_noises: &[0.05] },
    Case { scene: SceneKind::Plane, seed: 13, image_noise: 1.0, depth_noises: &[0.02, 0.1] },
];

/// Seeds and depth noises not used in the fit; 14 runs of 149 frames.
const VALIDATION: [Case; 7] = [
    Case { scene: SceneKind::Room, seed: 31, image_noise: 2.0, depth_noises: &[0.03, 0.07] },
    Case { scene: SceneKind::Room, seed: 32, image_noise: 4.0, depth_noises: &[0.015, 0.08] },
    Case { scene: SceneKind::Room, seed: 33, image_noise: 1.0, depth_noises: &[0.03, 0.05] },
    Case { scene: SceneKind::Corridor, seed: 34, image_noise: 2.0, depth_noises: &[0.03, 0.07] },
    Case { scene: SceneKind::Corridor, seed: 35, image_noise: 4.0, depth_noises: &[0.015, 0.08] },
    Case { scene: SceneKind::Plane, seed: 36, image_noise: 2.0, depth_noises: &[0.03, 0.07] },
    Case { scene: SceneKind::Plane, seed: 37, image_noise: 3.0, depth_noises: &[0.015, 0.05] },
];

/// Normalised errors (all, translation, rotation) of the tracked frames of one run.
type Normalized = Vec<[f64; 3]>;

pub fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let params: Vec<TrackerParams> = arguments
        .set
        .iter()
        .map(|settings| toml::from_str(&settings.replace(';', "\n")))
        .collect::<Result<_, _>>()?;
    let fit = run_cases(&FIT, &params, arguments)?;
    let validation = run_cases(&VALIDATION, &params, arguments)?;
    for (index, params) in params.iter().enumerate() {
        println!("== {}", arguments.set[index]);
        let factor = mean(&fit[index], 0) / 6.0;
        let inflation = params.alignment.covariance_inflation * factor;
        println!("covariance_inflation fitted: {inflation:.2}");
        print_row("fit, as it is", &fit[index], 1.0);
        print_row("fit, fitted", &fit[index], factor);
        print_row("validation, as it is", &validation[index], 1.0);
        print_row("validation, fitted", &validation[index], factor);
    }
    Ok(())
}

/// All normalised errors over `cases`, for each of `params`.
fn run_cases(
    cases: &[Case],
    params: &[TrackerParams],
    arguments: &Arguments,
) -> Result<Vec<Normalized>, Box<dyn Error>> {
    let mut all = vec![Normalized::new(); params.len()];
    for case in cases {
        let simulator = Simulator::new(SimulatorParams {
            scene: case.scene,
            seed: case.seed,
            frames: arguments.frames,
            rate_hz: 10.0,
            sensor: SensorParams { noise_std_dev: case.image_noise, ..SensorParams::default() },
            ..SimulatorParams::half_size()
        })?;
        let mut recorded = Recorded::new(Box::new(simulator), arguments.frames)?;
        for &depth_noise in case.depth_noises {
            let choice =
                KeyframeChoice { depth_noise, noise_spread: 1.0, min_gradient: 5.0, every: 0 };
            for (params, all) in params.iter().zip(&mut all) {
                let frames = track(&mut recorded, params, &choice)?;
                let claimed = frames.iter().filter(|frame| frame.estimate.state.is_tracked());
                let errors: Normalized = claimed.filter_map(TrackedFrame::normalized).collect();
                let name = format!(
                    "{:?} {} image noise {} depth noise {depth_noise}",
                    case.scene, case.seed, case.image_noise
                );
                print_row(&name, &errors, 1.0);
                all.extend(errors);
            }
        }
    }
    Ok(all)
}

fn mean(errors: &Normalized, part: usize) -> f64 {
    errors.iter().map(|error| error[part]).sum::<f64>() / errors.len().max(1) as f64
}

/// 95 % quantile of χ²₆.
const CHI_SQUARE_BOUND: f64 = 12.6;

fn print_row(name: &str, errors: &Normalized, factor: f64) {
    let below = errors.iter().filter(|error| error[0] / factor < CHI_SQUARE_BOUND).count();
    println!(
        "{name:<52} frames {:5}  NEES {:7.2}  translation {:7.2}  rotation {:7.2}  below {CHI_SQUARE_BOUND}: {:.3}",
        errors.len(),
        mean(errors, 0) / factor,
        mean(errors, 1) / factor,
        mean(errors, 2) / factor,
        below as f64 / errors.len().max(1) as f64
    );
}
