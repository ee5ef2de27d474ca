//! Writes the seeds to `fuzz/corpus/TARGET/`, where cargo-fuzz expects them.

use std::fs;
use std::path::Path;

use semidense_fuzz::seeds::seeds;

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for (index, seed) in seeds().into_iter().enumerate() {
        let folder = corpus.join(seed.target);
        fs::create_dir_all(&folder)?;
        fs::write(folder.join(format!("seed-{index:02}")), seed.bytes)?;
    }
    Ok(())
}
