//! The two ways to run.

/// The two ways to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Every frame, in order; capture waits for the map. The same in every run.
    Lockstep,
    /// At the pace of the stamps; the newest frame wins, dropped ones are counted.
    Live,
}
