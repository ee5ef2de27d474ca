//! Whether the machine was fast enough to map the frames of a live run.

use crate::service::results::record::RunMode;

/// The mapper of a live run may leave out one frame in this many. A mapper that keeps up leaves out a few while it
/// makes a keyframe; one that leaves out more than a third lags all the time, and depth and keyframes reach the tracker
/// too late.
const LARGEST_SHARE: u64 = 3;

/// Whether the mapper left out more of a live run than allowed.
pub fn is_overloaded(mode: RunMode, skipped: u64, frames_in: u64) -> bool {
    mode == RunMode::Live && LARGEST_SHARE * skipped > frames_in
}

/// A warning where the mapper of a run left out too many frames, if that is known.
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
    fn a_partly_mapped_live_run_gives_a_warning() {
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
