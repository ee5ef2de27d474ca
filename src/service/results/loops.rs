//! Figures of the search for loops.

use serde::{Deserialize, Serialize};

use crate::service::adjustments::SearchRecord;
use crate::service::results::times::Percentiles;
use crate::slam::loops::SearchOutcome;

/// The search for loops in a run; all `None` where a run does not report it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct LoopSummary {
    /// Keyframes that were searched for in older ones.
    pub loop_searches: Option<u64>,
    /// Pairs of keyframes that were compared.
    pub loop_pairs: Option<u64>,
    /// Loops that moved the map.
    pub loops_closed: Option<u64>,
    /// Loops that the map already satisfied.
    pub loops_held: Option<u64>,
    /// Epochs that were joined to others.
    pub epochs_joined: Option<u64>,
    /// Places that looked alike but were farther off than the map can have drifted.
    pub loops_against_drift: Option<u64>,
    /// Places that no second pair confirmed.
    pub loops_unconfirmed: Option<u64>,
    /// Places that contradicted other loops.
    pub loops_inconsistent: Option<u64>,
    /// Keyframes whose candidates were other places.
    pub loops_refused: Option<u64>,
    /// CPU time of a search.
    pub loop_search_ms: Option<Percentiles>,
    /// CPU time of all searches per keyframe of the run, milliseconds.
    pub loop_search_ms_per_keyframe: Option<f64>,
}

impl LoopSummary {
    /// Summarises the searches of a run that made `keyframes` keyframes.
    pub fn of(records: Option<&[SearchRecord]>, keyframes: usize) -> Self {
        let Some(records) = records else { return Self::default() };
        let count = |is: fn(&SearchOutcome) -> bool| {
            Some(records.iter().filter(|record| is(&record.report.outcome)).count() as u64)
        };
        let nanos: u64 = records.iter().map(|record| record.nanos).sum();
        Self {
            loop_searches: count(|outcome| *outcome != SearchOutcome::Proposed),
            loop_pairs: Some(records.iter().map(|of| u64::from(of.report.compared)).sum()),
            loops_closed: count(|outcome| *outcome == SearchOutcome::Closed),
            loops_held: count(|outcome| *outcome == SearchOutcome::AlreadyConsistent),
            epochs_joined: count(|outcome| *outcome == SearchOutcome::Joined),
            loops_against_drift: count(|outcome| matches!(outcome, SearchOutcome::AgainstDrift(_))),
            loops_unconfirmed: count(|outcome| *outcome == SearchOutcome::Unconfirmed),
            loops_inconsistent: count(|outcome| *outcome == SearchOutcome::Inconsistent),
            loops_refused: count(|outcome| matches!(outcome, SearchOutcome::Refused(_))),
            loop_search_ms: Percentiles::of(records.iter().map(|record| record.nanos)),
            loop_search_ms_per_keyframe: (keyframes > 0)
                .then(|| 1e-6 * nanos as f64 / keyframes as f64),
        }
    }
}
