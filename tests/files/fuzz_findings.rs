//! The seeds and past findings of fuzzing, run through the same functions as in `fuzz/`: each finding is a file in
//! `fuzz/findings/TARGET/`, or a seed where its format is our own.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::{parsers, seeds};

type Target = (&'static str, fn(&[u8]));

/// Every target. New ones are listed here and in `fuzz/Cargo.toml`.
const TARGETS: [Target; 11] = [
    ("trajectory", parsers::trajectory),
    ("rig", parsers::rig),
    ("lists", parsers::lists),
    ("image", parsers::image),
    ("bag", parsers::bag),
    ("configuration", parsers::configuration),
    ("message", parsers::message),
    ("map", parsers::map),
    ("map_folder", parsers::map_folder),
    ("journal", parsers::journal),
    ("pipeline", parsers::pipeline),
];

#[test]
fn every_seed_is_accepted_whole_truncated_and_damaged() {
    let mut seen = BTreeMap::new();
    for seed in seeds::seeds() {
        let (_, run) = TARGETS.iter().find(|(name, _)| *name == seed.target).expect(seed.target);
        *seen.entry(seed.target).or_insert(0) += 1;
        run(&seed.bytes);
        // Some truncations and flipped bytes, spread over the seed.
        for i in 0..20 {
            let place = i * seed.bytes.len() / 20;
            run(&seed.bytes[..place]);
            let mut broken = seed.bytes.clone();
            broken[place] ^= 0xff;
            run(&broken);
        }
    }
    assert_eq!(seen.len(), TARGETS.len(), "a target without a seed: {seen:?}");
}

/// Targets whose input is laid out by our own types: in a file, a finding would test nothing after their next change.
const OWN_FORMATS: [&str; 5] = ["message", "map", "map_folder", "journal", "pipeline"];

#[test]
fn past_findings_stay_fixed() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/findings");
    let mut count = 0;
    for (name, run) in TARGETS {
        for entry in fs::read_dir(folder.join(name)).into_iter().flatten().flatten() {
            assert!(!OWN_FORMATS.contains(&name), "{entry:?}: make it a seed in fuzz/seeds.rs");
            run(&fs::read(entry.path()).unwrap());
            count += 1;
        }
    }
    let there_are = fs::read_dir(&folder).into_iter().flatten().flatten().count();
    assert!(count >= there_are, "findings of a target that does not exist");
}

#[test]
fn every_target_is_in_the_manifest() {
    let manifest =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/Cargo.toml")).unwrap();
    for (name, _) in TARGETS {
        assert!(manifest.contains(&format!("fuzz_targets/{name}.rs")), "{name}");
    }
    assert_eq!(manifest.matches("fuzz_targets/").count(), TARGETS.len());
}
