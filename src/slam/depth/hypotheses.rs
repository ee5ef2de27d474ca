//! The hypotheses of a depth map by pixel, with lists of the columns of each row that have one or may get one.
//!
//! The lists are made when the map is observed, updated with each observation, and discarded when other code may have
//! changed a hypothesis. Five in six pixels have none: visiting all of them takes as long as a fifth of an observation.

use rayon::prelude::*;

use crate::slam::depth::gain::Uncertainty;
use crate::slam::image::buffer::Image;

/// A Gaussian hypothesis on the inverse depth of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Inverse depth as filtered from observations, 1/keyframe units.
    pub inverse_depth: f32,
    /// Its variance; negative where the pixel has no hypothesis.
    pub variance: f32,
    /// The part of `variance` that differs from one observation to the next; the rest is common to all.
    pub independent: f32,
    /// Inverse depth smoothed over consistent neighbours: what is published and searched around.
    pub smoothed: f32,
    /// Number of confirmations minus failures; at 0 the hypothesis is dropped.
    pub validity: u8,
    /// Whether it comes from earlier frames: those of the previous keyframe, or the two of a start.
    pub propagated: bool,
    /// Failures of a pixel without hypothesis: the more often it failed, the less often it is tried.
    pub failures: u8,
}

impl Hypothesis {
    /// No hypothesis.
    pub const NONE: Self = Self {
        inverse_depth: 0.0,
        variance: -1.0,
        independent: 0.0,
        smoothed: 0.0,
        validity: 0,
        propagated: false,
        failures: 0,
    };

    /// Whether the pixel has a hypothesis.
    #[inline]
    pub fn is_some(&self) -> bool {
        self.variance >= 0.0
    }

    /// Variance and its independent part.
    #[inline(always)]
    pub fn uncertainty(&self) -> Uncertainty {
        Uncertainty { variance: self.variance, independent: self.independent }
    }

    /// Removes the hypothesis and records the failure of this pixel.
    #[inline]
    pub fn reject(&mut self) {
        *self = Self { failures: self.failures.saturating_add(1), ..Self::NONE };
    }
}

/// One hypothesis per pixel.
#[derive(Debug, Clone)]
pub struct Hypotheses {
    image: Image<Hypothesis>,
    lists: Lists,
}

/// Lists of columns by row, stored contiguously for all rows.
#[derive(Debug, Clone, Default)]
struct Lists {
    columns: Vec<u16>,
    counts: Vec<Counts>,
    is_valid: bool,
}

/// Number of listed columns of a row.
#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    /// First: columns with a hypothesis.
    known: u16,
    /// After them: candidates without one.
    unknown: u16,
}

impl PartialEq for Hypotheses {
    fn eq(&self, other: &Self) -> bool {
        self.image == other.image
    }
}

impl Hypotheses {
    /// No hypotheses, for images of this size.
    pub fn none(width: usize, height: usize) -> Self {
        Self { image: Image::filled(width, height, Hypothesis::NONE), lists: Lists::default() }
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[Hypothesis] {
        self.image.pixels()
    }

    /// All pixels, row by row.
    pub fn pixels_mut(&mut self) -> &mut [Hypothesis] {
        self.lists.is_valid = false;
        self.image.pixels_mut()
    }

    /// The pixel at column `u`, row `v`.
    pub fn at(&self, u: usize, v: usize) -> Hypothesis {
        self.image.at(u, v)
    }

    /// Row `v`.
    #[inline]
    pub fn row(&self, v: usize) -> &[Hypothesis] {
        self.image.row(v)
    }

    /// Number of hypotheses.
    pub fn count(&self) -> usize {
        match self.lists.is_valid {
            true => self.lists.counts.iter().map(|counts| usize::from(counts.known)).sum(),
            false => self.pixels().iter().map(|h| usize::from(h.is_some())).sum(),
        }
    }

    /// Number of hypotheses, and of candidates without one.
    pub(super) fn count_known_and_unknown(&self, candidates: &Image<bool>) -> [usize; 2] {
        let pixels = self.pixels().iter().zip(candidates.pixels());
        let unknown = match self.lists.is_valid {
            true => self.lists.counts.iter().map(|counts| usize::from(counts.unknown)).sum(),
            false => {
                pixels.map(|(h, &is_candidate)| usize::from(is_candidate & !h.is_some())).sum()
            }
        };
        [self.count(), unknown]
    }

    /// The columns of row `v` that have a hypothesis, ascending; stored in `memory` if they are not listed.
    #[inline(always)]
    pub(in crate::slam) fn known_columns<'a>(
        &'a self,
        v: usize,
        memory: &'a mut Vec<u16>,
    ) -> &'a [u16] {
        let (width, lists) = (self.image.width(), &self.lists);
        if lists.is_valid {
            return &lists.columns[v * width..][..usize::from(lists.counts[v].known)];
        }
        memory.resize(width, 0);
        let known = list(memory, self.row(v).iter().map(Hypothesis::is_some));
        &memory[..known]
    }

    /// All rows, to be observed; the caller must leave each with up-to-date lists.
    pub(super) fn observed_rows(&mut self) -> impl IndexedParallelIterator<Item = ListedRow<'_>> {
        let (width, height) = (self.image.width(), self.image.height());
        let Self { image, lists: Lists { columns, counts, is_valid } } = self;
        columns.resize(width * height, 0);
        counts.resize(height, Counts::default());
        let are_listed = std::mem::replace(is_valid, true);
        let rows = image.pixels_mut().par_chunks_exact_mut(width);
        let columns = columns.par_chunks_exact_mut(width);
        rows.zip(columns).zip(counts).map(move |((hypotheses, columns), counts)| ListedRow {
            hypotheses,
            lists: RowLists { columns, counts, is_valid: are_listed },
        })
    }

    /// Takes over the memory of the lists of `other`, which no longer needs it.
    pub(in crate::slam) fn take_lists(&mut self, other: &mut Self) {
        std::mem::swap(&mut self.lists, &mut other.lists);
        self.lists.is_valid = false;
        other.lists = Lists::default();
    }
}

/// A row to be observed.
pub(super) struct ListedRow<'a> {
    pub(super) hypotheses: &'a mut [Hypothesis],
    pub(super) lists: RowLists<'a>,
}

/// The lists of one row, each ascending.
pub(super) struct RowLists<'a> {
    columns: &'a mut [u16],
    counts: &'a mut Counts,
    is_valid: bool,
}

impl RowLists<'_> {
    /// Builds the lists of the row unless they are valid.
    #[inline(always)]
    pub(super) fn fill(&mut self, hypotheses: &[Hypothesis], candidates: &[bool]) {
        if !self.is_valid {
            let known = list(self.columns, hypotheses.iter().map(Hypothesis::is_some));
            let pixels = hypotheses.iter().zip(candidates);
            let unknown = list(
                &mut self.columns[known..],
                pixels.map(|(hypothesis, &is_candidate)| is_candidate & !hypothesis.is_some()),
            );
            *self.counts = Counts { known: known as u16, unknown: unknown as u16 };
        }
        self.is_valid = true;
    }

    /// Columns with a hypothesis.
    pub(super) fn known(&self) -> &[u16] {
        &self.columns[..usize::from(self.counts.known)]
    }

    /// Candidates without one.
    pub(super) fn unknown(&self) -> &[u16] {
        &self.columns[usize::from(self.counts.known)..][..usize::from(self.counts.unknown)]
    }

    /// Updates the lists after an observation.
    #[inline(always)]
    pub(super) fn update_lists(
        &mut self,
        changed: &ChangedColumns,
        hypotheses: &[Hypothesis],
        candidates: &[bool],
    ) {
        let Some(columns) = changed.columns.get(..changed.count) else {
            self.is_valid = false;
            return self.fill(hypotheses, candidates);
        };
        for &column in columns {
            let u = usize::from(column);
            self.toggle(column, hypotheses[u].is_some(), candidates[u]);
        }
    }

    /// Moves a column to the other list, or removes it.
    fn toggle(&mut self, column: u16, is_known: bool, is_candidate: bool) {
        let Counts { known, unknown } = *self.counts;
        let (known, all) = (usize::from(known), usize::from(known + unknown));
        let columns = &mut self.columns[..all];
        let among_known = columns[..known].partition_point(|&other| other < column);
        let among_unknown = known + columns[known..].partition_point(|&other| other < column);
        if is_known {
            columns[among_known..=among_unknown].rotate_right(1);
            (self.counts.known, self.counts.unknown) = (known as u16 + 1, unknown - 1);
        } else if is_candidate {
            columns[among_known..among_unknown].rotate_left(1);
            (self.counts.known, self.counts.unknown) = (known as u16 - 1, unknown + 1);
        } else {
            columns[among_known..].rotate_left(1);
            self.counts.known -= 1;
        }
    }
}

/// Columns whose hypothesis was created or removed by an observation.
pub(super) struct ChangedColumns {
    columns: [u16; Self::MAX_COLUMNS],
    count: usize,
}

impl ChangedColumns {
    /// With more changes the row is listed anew.
    const MAX_COLUMNS: usize = 32;

    pub(super) fn none() -> Self {
        Self { columns: [0; Self::MAX_COLUMNS], count: 0 }
    }

    #[inline(always)]
    pub(super) fn push(&mut self, column: u16) {
        if let Some(to) = self.columns.get_mut(self.count) {
            *to = column;
        }
        self.count += 1;
    }
}

/// Lists the positions where `is_listed`, without branches, which would be unpredictable; returns their number.
/// `columns` has room for all of them.
#[inline(always)]
fn list(columns: &mut [u16], is_listed: impl Iterator<Item = bool>) -> usize {
    let mut count = 0;
    for (u, is_listed) in is_listed.enumerate() {
        // Past the capacity only unlisted positions remain.
        if let Some(to) = columns.get_mut(count) {
            *to = u as u16;
        }
        count += usize::from(is_listed);
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::test_scene::Random;

    const WIDTH: usize = 90;
    const HEIGHT: usize = 40;

    fn some(variance: f32) -> Hypothesis {
        Hypothesis { variance, ..Hypothesis::NONE }
    }

    #[test]
    fn lists_follow_created_and_removed_hypotheses() {
        let mut random = Random::new(5);
        let mut hypotheses = Hypotheses::none(WIDTH, HEIGHT);
        let candidates: Vec<bool> = (0..WIDTH * HEIGHT).map(|_| random.uniform() < 0.4).collect();
        for round in 0..30 {
            // Alternately few changes, and more than are recorded.
            let share = [0.02, 0.9][round % 2];
            let seeds: Vec<u64> = (0..HEIGHT).map(|v| (round * HEIGHT + v) as u64).collect();
            hypotheses.observed_rows().zip(&seeds).enumerate().for_each(|(v, (row, seed))| {
                let ListedRow { hypotheses, mut lists } = row;
                let candidates = &candidates[v * WIDTH..][..WIDTH];
                lists.fill(hypotheses, candidates);
                let (mut random, mut changed) = (Random::new(*seed), ChangedColumns::none());
                for u in lists.known().to_vec() {
                    if random.uniform() < share {
                        hypotheses[usize::from(u)] = Hypothesis::NONE;
                        changed.push(u);
                    }
                }
                for u in lists.unknown().to_vec() {
                    if random.uniform() < share {
                        hypotheses[usize::from(u)] = some(1.0);
                        changed.push(u);
                    }
                }
                lists.update_lists(&changed, hypotheses, candidates);
            });
            check(&mut hypotheses, &candidates);
            // Also where there is no candidate, set by hand.
            let any = (random.uniform() * (WIDTH * HEIGHT) as f64) as usize;
            hypotheses.pixels_mut()[any] = some(0.0);
            assert!(!hypotheses.lists.is_valid);
        }
    }

    /// Updated lists equal those built anew.
    fn check(hypotheses: &mut Hypotheses, candidates: &[bool]) {
        assert!(hypotheses.lists.is_valid);
        let mut anew = hypotheses.clone();
        anew.pixels_mut();
        assert_eq!(hypotheses.count(), anew.count());
        let lists = |row: ListedRow<'_>, v: usize| {
            let ListedRow { hypotheses, mut lists } = row;
            lists.fill(hypotheses, &candidates[v * WIDTH..][..WIDTH]);
            (lists.known().to_vec(), lists.unknown().to_vec())
        };
        let mut memory = Vec::new();
        for v in 0..HEIGHT {
            assert_eq!(
                hypotheses.known_columns(v, &mut memory),
                anew.clone().known_columns(v, &mut Vec::new())
            );
        }
        let all = |of: &mut Hypotheses| -> Vec<_> {
            of.observed_rows().enumerate().map(|(v, row)| lists(row, v)).collect()
        };
        assert_eq!(all(hypotheses), all(&mut anew));
    }
}
