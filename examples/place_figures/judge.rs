//! How well a method recognises places.

use crate::footage::Overlap;
use crate::methods::Scores;

/// Keyframes that each see at least this share of the other show the same place.
pub const SAME: f64 = 0.3;
/// Keyframes that share no more than this show different places; those in between do not count.
pub const OTHER: f64 = 0.05;
/// Number of candidates that a verification could check.
pub const FEW: usize = 3;

/// Number of queries with a place that could be found.
pub fn count_revisits(overlaps: &[Vec<Overlap>], gap: usize) -> usize {
    let has = |i: &usize| (0..i.saturating_sub(gap)).any(|j| overlaps[*i][j].least >= SAME);
    (0..overlaps.len()).filter(has).count()
}

/// Prints recall among the keyframes at least `gap` before the query, also by shared view.
pub fn judge(overlaps: &[Vec<Overlap>], scores: &Scores, gap: usize) {
    let mut best: Vec<(f32, f64, f64)> = Vec::new();
    let (mut revisits, mut first, mut few) = (0, 0, 0);
    for (i, row) in overlaps.iter().enumerate() {
        let order = ranked(&scores.of[i], 0..i.saturating_sub(gap));
        if let Some(&j) = order.first() {
            best.push((scores.of[i][j], row[j].least, row[j].most));
        }
        if (0..i.saturating_sub(gap)).any(|j| row[j].least >= SAME) {
            revisits += 1;
            first += usize::from(order.first().is_some_and(|&j| row[j].least >= SAME));
            few += usize::from(order.iter().take(FEW).any(|&j| row[j].least >= SAME));
        }
    }
    let worst_false = best
        .iter()
        .filter(|(_, _, most)| *most <= OTHER)
        .map(|(score, ..)| *score)
        .fold(f32::NEG_INFINITY, f32::max);
    let sure = best.iter().filter(|(score, least, _)| *score > worst_false && *least >= SAME);
    let share = |count: usize| 100.0 * count as f64 / revisits.max(1) as f64;
    println!(
        "  of {revisits}: at 100 % precision {:.0} % (above {worst_false:.3}), first {:.0} %, among {FEW} {:.0} %",
        share(sure.count()),
        share(first),
        share(few)
    );
    by_overlap(overlaps, scores);
}

/// The keyframes of a sequence in descending order of their scores.
fn ranked(scores: &[f32], among: std::ops::Range<usize>) -> Vec<usize> {
    let mut order: Vec<usize> = among.filter(|&j| !scores[j].is_nan()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
    order
}

/// For each band of shared view: of the queries with a keyframe in the band, those with such a keyframe among the
/// first few candidates, where keyframes that share more are excluded.
fn by_overlap(overlaps: &[Vec<Overlap>], scores: &Scores) {
    const BANDS: [(f64, f64); 4] = [(0.3, 0.45), (0.45, 0.6), (0.6, 0.75), (0.75, 0.9)];
    let of = |(from, to): (f64, f64)| {
        let (mut all, mut found) = (0u32, 0u32);
        for (i, row) in overlaps.iter().enumerate() {
            let is_in = |j: &usize| *j != i && (from..to).contains(&row[*j].least);
            if !(0..row.len()).any(|j| is_in(&j)) {
                continue;
            }
            all += 1;
            let mut order = ranked(&scores.of[i], 0..row.len());
            order.retain(|&j| j != i && row[j].least < to && (row[j].most <= OTHER || is_in(&j)));
            found += u32::from(order.iter().take(FEW).any(is_in));
        }
        format!("{from:.2}: {:.0} % of {all}", 100.0 * f64::from(found) / f64::from(all.max(1u32)))
    };
    println!("  among {FEW} by shared view from {}", BANDS.map(of).join(", "));
}
