//! Whether the machine had time to map the frames of a live run.

use crate::service::results::record::RunMode;

/// One frame in so many may be left out by the mapper of a live run. A mapper that keeps up leaves out a few while it
/// makes a keyframe; one that leaves out more than a third is behind all the time, and depth and keyframes come too late
/// for the tracker.
const LARGEST_SHARE: u64 = 3;

/// Whether the mapper left out more of a live run than it may.
pub fn is_overloaded(mode: RunMode, skipped: u64, frames_in: u64) -> bool {
    mode == RunMode::Live && LARGEST_SHARE * skipped > frames_in
}

/// A warning where the mapper of a run left out too many frames, where that is known.
pub fn mapping_warning(mode: RunMode, skipped: Option<u64>, frames_in: u64) -> Option<String> {
    let skipped = skipped.filter(|skipped| is_overloaded(mode, *skipped, frames_in))?;
    Some(format!(
        "the machine was too slow: {skipped} of {frames_in} frames were not mapped; see `semidense doctor`"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_live_run_that_was_mapped_in_part_says_so() {
        let warning = |mode, skipped| mapping_warning(mode, skipped, 600);
        let slow = warning(RunMode::Live, Some(330)).unwrap();
        assert!(
            slow.contains("330 of 600 frames were not mapped; see `semidense doctor`"),
            "{slow}"
        );
        assert!(warning(RunMode::Live, Some(201)).is_some());
        assert_eq!(warning(RunMode::Live, Some(200)), None);
        assert_eq!(warning(RunMode::Live, None), None);
        assert_eq!(warning(RunMode::Lockstep, Some(330)), None);
    }
}
