//! Tests of the whole simulator.
use super::*;

#[test]
fn dump() {
    let mut sim = Simulator::new(SimulatorParams::default()).unwrap();
    let t = std::time::Instant::now();
    for k in [0usize, 60, 150, 240, 330, 420, 510, 599] {
        let px = sim.render(k, &mut RenderScratch::default());
        save(&format!("/tmp/sim_{k}.png"), 640, 480, &px);
        let d = sim.depth_of(k);
        let px: Vec<u8> = d.pixels().iter().map(|z| (z * 42.0).min(255.0) as u8).collect();
        save(&format!("/tmp/sim_d{k}.png"), 640, 480, &px);
    }
    println!("{:?}", t.elapsed());
}

fn save(path: &str, w: u32, h: u32, px: &[u8]) {
    let mut e = png::Encoder::new(std::fs::File::create(path).unwrap(), w, h);
    e.set_color(png::ColorType::Grayscale);
    e.write_header().unwrap().write_image_data(px).unwrap();
}
