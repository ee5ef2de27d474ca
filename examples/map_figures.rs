//! Size of a large map on disk and time to start in it: `cargo run --release --example map_figures -- MAP_DIR
//! NUM_KEYFRAMES`. The keyframes of a map are repeated until there are that many.

use std::path::Path;
use std::time::Instant;

use semidense::service::map_folder::depth_file::MapDetail;
use semidense::service::map_folder::reading::load;
use semidense::service::map_folder::write_new;
use semidense::slam::keyframe::Keyframe;
use semidense::slam::map::Map;
use semidense::slam::mapper::prior::MapUse;
use semidense::slam::mapper::{Mapper, MapperParams};

/// Number of loads, of which the fastest and the slowest are printed.
const REPETITIONS: usize = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, count] = &arguments[..] else { return Err("MAP_DIR NUM_KEYFRAMES".into()) };
    let count: usize = count.parse()?;
    let few = load(Path::new(folder), usize::MAX)?;
    let camera = few.manifest.camera;
    // Describes the keyframes that have no description yet.
    let mut mapper = Mapper::new(camera, MapperParams::default())?;
    mapper.start_in_map(few.map, MapUse::Extend)?;
    for detail in [MapDetail::Full, MapDetail::Small] {
        let folder = tempfile::tempdir()?;
        let again = mapper.map().keyframes.iter().cycle().take(count);
        let numbered = (0..).zip(again).map(|(keyframe_id, of)| {
            let description = of.description.clone();
            Keyframe { keyframe_id, description, ..of.clone() }
        });
        let map = Map { keyframes: numbered.collect(), ..Map::default() };
        write_new(folder.path(), &camera, detail, &map, 1, &mut || ())?;
        drop(map);
        for _ in 0..REPETITIONS {
            let begin = Instant::now();
            let loaded = load(folder.path(), usize::MAX)?;
            let read = begin.elapsed();
            let bytes = loaded.manifest.depth_bytes();
            let described = loaded.map.keyframes.iter().filter(|of| of.description.is_some());
            let described = described.count();
            let mut mapper = Mapper::new(camera, MapperParams::default())?;
            mapper.start_in_map(loaded.map, MapUse::Extend)?;
            println!(
                "{detail:?}: {count} keyframes, {described} described, {:.1} MB, read {:.2} s, with what they look like {:.2} s",
                1e-6 * bytes as f64,
                read.as_secs_f64(),
                begin.elapsed().as_secs_f64()
            );
        }
    }
    Ok(())
}
