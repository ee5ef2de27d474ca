//! What the mapper is doing and why, for display.

use std::fmt;

use crate::slam::counted::counted;
use crate::slam::mapper::Mapper;
use crate::slam::mapper::consistency::Contradiction;
use crate::slam::mapper::phase::Phase;
use crate::slam::pose::PoseEstimate;
use crate::slam::two_frame::evidence::Waiting;
use crate::slam::two_frame::{Failure, InitOutcome, InitState};

/// What the mapper is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Situation {
    /// No map yet.
    Starting(StartProgress),
    /// This many keyframes of a map of earlier runs are searched for the camera.
    Localising(usize),
    /// The camera was found there, and nothing has been added yet, or nothing will be.
    Localised(Certainty),
    /// The map is trusted and grows.
    Mapping,
    /// The camera is lost; recent keyframes are searched for it.
    Lost,
    /// The map contradicted itself; earlier keyframes are searched for the camera.
    Rejected(Contradiction),
    /// The camera has been lost for long: a new epoch is being started, and the search continues.
    Restarting(StartProgress),
}

/// Certainty of the camera's pose in a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Certainty {
    /// Share of the keyframe's points in view that the image agrees with, per cent.
    pub inlier_percent: u32,
    /// Standard deviation of the camera's position on the keyframe, thousandths of the mean depth.
    pub position_permille: u32,
}

impl Certainty {
    /// Certainty of a pose on its keyframe, whose unit is the mean depth.
    pub(super) fn of(pose: &PoseEstimate) -> Self {
        /// Indices of the translation's variances in the covariance.
        const VARIANCES: [usize; 3] = [0, 6, 11];
        let variance: f64 = VARIANCES.iter().map(|&place| pose.covariance[place]).sum();
        let std_dev = Some(variance.sqrt()).filter(|of| of.is_finite()).unwrap_or(f64::MAX);
        Self {
            inlier_percent: (100.0 * pose.quality.inlier_ratio).round() as u32,
            position_permille: (1000.0 * std_dev).ceil() as u32,
        }
    }
}

impl fmt::Display for Certainty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let tenths = (self.position_permille / 10, self.position_permille % 10);
        write!(
            f,
            "{} % of the points agree, position within {}.{} % of the mean depth",
            self.inlier_percent, tenths.0, tenths.1
        )
    }
}

impl Mapper {
    /// What the mapper is doing, and why.
    pub fn situation(&self) -> Situation {
        match self.phase {
            Phase::Starting => Situation::Starting(self.start.progress),
            Phase::Mapping => self.certainty().map_or(Situation::Mapping, Situation::Localised),
            Phase::Lost(_) | Phase::Restarting(_) if self.is_localising() => {
                Situation::Localising(self.map.num_with_depth())
            }
            Phase::Lost(_) => Situation::Lost,
            Phase::Rejected(why, _) => Situation::Rejected(why),
            Phase::Restarting(_) => Situation::Restarting(self.start.progress),
        }
    }
}

impl fmt::Display for Situation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Starting(progress) => write!(f, "starting: {progress}"),
            Self::Localising(keyframes) => {
                let keyframes = counted(*keyframes, "keyframe");
                write!(f, "localising: searching {keyframes} of the map for the camera")
            }
            Self::Localised(certainty) => write!(f, "localised in the map: {certainty}"),
            Self::Mapping => f.write_str("mapping"),
            Self::Lost => f.write_str("lost: searching keyframes for the camera"),
            Self::Rejected(why) => write!(f, "map rejected: {why}"),
            Self::Restarting(progress) => write!(f, "lost: starting a new epoch, {progress}"),
        }
    }
}

/// Outcome of one frame while there is no map: why no map started on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum StartFrame {
    /// It is the first frame of a start, or ended one.
    Begun,
    /// It has too little texture, and is dark.
    Dark,
    /// It has too little texture, and is overexposed.
    Overexposed,
    /// It has too little texture, in full light.
    Textureless,
    /// It does not show what the first frame does.
    Unmatched,
    /// It shows the same as the first frame: the camera has not moved.
    Still,
    /// A rotation of the camera explains it.
    Turned,
    /// There is parallax, but too little to prove depth.
    LittleParallax,
}

impl StartFrame {
    /// The outcome of the frame `pixels` in a start.
    pub(super) fn of(outcome: &InitOutcome, is_first: bool, pixels: &[u8]) -> Self {
        /// Motion of the image that noise does not cause, pixels.
        const MIN_MOTION_PX: f64 = 1.0;
        match outcome.state {
            InitState::Waiting(Waiting::Texture) => Self::without_texture(pixels),
            InitState::Waiting(_) if is_first => Self::Begun,
            InitState::Waiting(Waiting::Match) | InitState::Failed(Failure::Mismatch) => {
                Self::Unmatched
            }
            InitState::Waiting(Waiting::Significance) if outcome.rotation_px < MIN_MOTION_PX => {
                Self::Still
            }
            InitState::Waiting(Waiting::Significance) => Self::Turned,
            InitState::Waiting(_) => Self::LittleParallax,
            InitState::Proven | InitState::Failed(_) => Self::Begun,
        }
    }

    fn without_texture(pixels: &[u8]) -> Self {
        /// Mean grey levels below and above which a sensor shows nothing.
        const DARK: usize = 20;
        const OVEREXPOSED: usize = 235;
        let sum: usize = pixels.iter().map(|&pixel| usize::from(pixel)).sum();
        match sum / pixels.len().max(1) {
            ..=DARK => Self::Dark,
            OVEREXPOSED.. => Self::Overexposed,
            _ => Self::Textureless,
        }
    }
}

/// Progress of a two-frame start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StartProgress {
    /// What it waits for; `None` before its first frame.
    pub waiting: Option<Waiting>,
    /// Number of times that it has begun again.
    pub failures: u32,
    /// Reason for the last time.
    pub last_failure: Option<Failure>,
}

impl StartProgress {
    /// Takes in the outcome of a frame.
    pub(super) fn observe(&mut self, state: InitState) {
        match state {
            InitState::Waiting(waiting) => self.waiting = Some(waiting),
            InitState::Failed(failure) => {
                self.waiting = None;
                self.failures += 1;
                self.last_failure = Some(failure);
            }
            InitState::Proven => *self = Self::default(),
        }
    }
}

impl fmt::Display for StartProgress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.waiting {
            None => "waiting for a frame",
            Some(Waiting::Texture) => "waiting for texture",
            Some(Waiting::Match) => "waiting for a frame that shows the same scene as the first",
            Some(Waiting::Significance) => "waiting for parallax: a rotation explains the images",
            Some(Waiting::NegativeDepth) => "waiting for parallax: depths are contradictory",
            Some(Waiting::Rival) => "waiting for parallax: two motions explain the images",
            Some(Waiting::Translation) => "waiting for translation",
            Some(Waiting::Accuracy) => "waiting for parallax: depths are uncertain",
            Some(Waiting::Confirmation) => "waiting for confirmation",
        })?;
        let why = match self.last_failure {
            None => return Ok(()),
            Some(Failure::TooLong) => "too many frames passed without proof",
            Some(Failure::Mismatch) => "the view changed too much",
            Some(Failure::WrongSize) => "a frame had another size",
        };
        write!(f, "; restarted {}, last because {why}", counted(self.failures, "time"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_start_reports_what_it_waits_for_and_why_it_began_again() {
        let mut progress = StartProgress::default();
        progress.observe(InitState::Waiting(Waiting::Translation));
        assert_eq!(Situation::Starting(progress).to_string(), "starting: waiting for translation");
        progress.observe(InitState::Failed(Failure::TooLong));
        progress.observe(InitState::Waiting(Waiting::Texture));
        let text = Situation::Restarting(progress).to_string();
        assert!(text.starts_with("lost: starting a new epoch, waiting for texture"), "{text}");
        assert!(
            text.ends_with("restarted 1 time, last because too many frames passed without proof")
        );
        progress.observe(InitState::Proven);
        assert_eq!(progress, StartProgress::default());
    }
}
