//! Time to undo the rolling shutter of a 640×480 image: `cargo bench --bench rolling_shutter`, on the simulated room.

use std::time::Instant;

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::slam::rolling_shutter::RollingShutter;

const FRAMES: usize = 60;
const READOUT_S: f64 = 0.02;

fn main() {
    let params = SimulatorParams { frames: FRAMES, ..SimulatorParams::default() };
    let mut source = Simulator::new(params).expect("valid parameters");
    let intrinsics = source.intrinsics();
    let mut shutter = RollingShutter::new(&FrameSource::camera(&source), &intrinsics, READOUT_S);
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    let mut millis: Vec<f64> = Vec::new();
    while let Ok(Some(stamp)) = source.next_into(&mut pixels) {
        let began = Instant::now();
        shutter.undo(stamp.capture_nanos, &mut pixels);
        millis.push(1e3 * began.elapsed().as_secs_f64());
    }
    millis.sort_by(f64::total_cmp);
    println!("median {:.2} ms, worst {:.2} ms", millis[FRAMES / 2], millis[FRAMES - 1]);
}
