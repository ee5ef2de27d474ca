//! The methods compared: each scores the similarity of a query keyframe to every other keyframe.

use std::error::Error;
use std::fs;
use std::path::Path;

use clap::ValueEnum;
use semidense::slam::mapper::appearance::Appearance;
use semidense::slam::places::{Describer, PlaceCandidate, PlaceIndex};

use crate::ferns::Ferns;
use crate::footage::Footage;

/// A method of place recognition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// Binary descriptors in a tree.
    Tree,
    /// Small blurred images.
    Small,
    /// Random ferns.
    Ferns,
}

/// Result of a method.
pub struct Scores {
    /// For each query a score for each keyframe, higher for greater similarity, NaN without one.
    pub of: Vec<Vec<f32>>,
    /// The tree's result when restricted to keyframes that may be found: for each query its candidates, best first.
    /// Empty for other methods.
    pub candidates: Vec<Vec<PlaceCandidate>>,
    /// The cost, as text.
    pub cost: String,
}

/// Runs a method on all pairs; the last `gap` keyframes before a query and all later ones need not be found.
pub fn scores(kind: Kind, footage: &Footage, queries: &[Vec<u8>], gap: usize) -> Scores {
    match kind {
        Kind::Tree => tree(footage, queries, gap),
        Kind::Small => small(footage, queries),
        Kind::Ferns => Ferns::scores(footage, queries),
    }
}

/// CPU time of this thread, seconds, unaffected by other load on the machine.
pub fn busy_secs() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

fn micros(began: f64, count: usize) -> f64 {
    1e6 * (busy_secs() - began) / count.max(1) as f64
}

fn tree(footage: &Footage, queries: &[Vec<u8>], gap: usize) -> Scores {
    let (width, height) = (footage.camera.width, footage.camera.height);
    let count = footage.frames.len();
    let (mut describer, mut index) = (Describer::default(), PlaceIndex::default());
    let began = busy_secs();
    let described: Vec<_> =
        footage.frames.iter().map(|f| describer.describe(&f.pixels, width, height)).collect();
    let describe = micros(began, count);
    let asking: Vec<_> = queries.iter().map(|q| describer.describe(q, width, height)).collect();
    let began = busy_secs();
    for (id, description) in (0..).zip(&described) {
        description.iter().for_each(|description| index.insert(id, description));
    }
    let insert = micros(began, count);
    let began = busy_secs();
    let found_of = |query: usize, is_excluded: &dyn Fn(u64) -> bool| match &asking[query] {
        Some(description) => index.candidates(description, count, is_excluded),
        None => Vec::new(),
    };
    let all: Vec<_> = (0..count).map(|query| found_of(query, &|id| id == query as u64)).collect();
    let query = micros(began, count);
    let row = |found: &Vec<PlaceCandidate>| {
        let mut row = vec![f32::NAN; count];
        found.iter().for_each(|of| row[of.keyframe_id as usize] = of.score);
        row
    };
    let of = all.iter().map(row).collect();
    let may_be_found = |id: u64, query: usize| id as usize + gap < query;
    let candidates =
        (0..count).map(|query| found_of(query, &|id| !may_be_found(id, query))).collect();
    let features: usize = described.iter().flatten().map(|d| d.features().len()).sum();
    let cost = format!(
        "describe {describe:.0} µs, insert {insert:.0} µs, query {query:.0} µs, {} features, {} B a keyframe",
        features / count.max(1),
        index.bytes() / count.max(1)
    );
    Scores { of, candidates, cost }
}

fn small(footage: &Footage, queries: &[Vec<u8>]) -> Scores {
    let (width, height) = (footage.camera.width, footage.camera.height);
    let known: Vec<_> =
        footage.frames.iter().map(|f| Appearance::of(&f.pixels, width, height)).collect();
    let asking: Vec<_> = queries.iter().map(|q| Appearance::of(q, width, height)).collect();
    let began = busy_secs();
    let of = asking
        .iter()
        .map(|ours| {
            let score = |theirs: &Option<Appearance>| match (ours, theirs) {
                (Some(ours), Some(theirs)) => theirs.similarity(ours),
                _ => f32::NAN,
            };
            known.iter().map(score).collect()
        })
        .collect();
    let cost = format!("query {:.0} µs", micros(began, queries.len()));
    Scores { of, candidates: Vec::new(), cost }
}

/// Reads scores from a file with a line for each query.
pub fn read_scores(file: &Path) -> Result<Scores, Box<dyn Error>> {
    let text = fs::read_to_string(file)?;
    let row = |line: &str| line.split_whitespace().map(str::parse).collect::<Result<Vec<f32>, _>>();
    let of = text.lines().map(row).collect::<Result<_, _>>()?;
    Ok(Scores { of, candidates: Vec::new(), cost: String::new() })
}
