//! Parameters of the fusion of keyframes into one surface.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Parameters of the fusion.
#[derive(Debug, Clone, PartialEq)]
pub struct FusionParams {
    /// Distance between the points.
    pub resolution: MapResolution,
    /// Largest σ/d of a point that counts.
    pub max_relative_std_dev: f64,
    /// Number of other keyframes that a point is compared with. 10: half of them have the largest overlap, the others
    /// are spread over the run; with 24 the simulated room has the same error.
    pub max_neighbours: usize,
    /// Standard deviations of both by which depths that agree may differ. 2: with 3, a third more points of the
    /// simulated room are off by 3 %, as more errors are confirmed.
    pub tolerance: f64,
    /// Share of the distance by which depths may differ in addition. 0.01: poses and units of keyframes are no more
    /// accurate than that over the length of a room.
    pub floor: f64,
    /// Keyframes that must contradict a point before it is removed. 2: one may be wrong itself.
    pub min_contradictions: u8,
    /// Ratio of the keyframes that see through a point to those whose depth agrees, from which it is removed. 0.5:
    /// those that agree have their depth from each other, those that see through it do not.
    pub contradiction_ratio: f64,
    /// Fewest pixels with depth that agrees, of the 48 of the square around. 8: half of a square that an edge crosses.
    pub min_support: u32,
    /// Least share of the pixels around with depth that agrees. 0.7: at a step in depth half of them do.
    pub support_ratio: f64,
    /// Fewest other points within four sides of a point's cell. 8: those of an edge that continues to both sides.
    pub min_company: usize,
}

impl FusionParams {
    /// For the spread points of the interval filter, of which a square around one holds few or none.
    pub fn of_spread_points(self) -> Self {
        Self { min_support: 0, support_ratio: 0.0, min_company: 0, ..self }
    }
}

impl Default for FusionParams {
    fn default() -> Self {
        Self {
            resolution: MapResolution::default(),
            max_relative_std_dev: 0.1,
            max_neighbours: 10,
            tolerance: 2.0,
            floor: 0.01,
            min_contradictions: 2,
            contradiction_ratio: 0.5,
            min_support: 8,
            support_ratio: 0.7,
            min_company: 8,
        }
    }
}

/// Smallest cell in standard deviations along the ray: across the ray a point is accurate to a pixel, so that print on
/// a far wall stays legible, and along it the wall is no more than a few cells thick.
const SIGMA_RATIO: f64 = 0.6;

/// Distance between the points of a map; never below 0.6 of their standard deviation or the width of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum MapResolution {
    /// The same everywhere, map units.
    Length(f64),
    /// A share of the distance from the camera: near surfaces are finer.
    Relative(f64),
}

/// A resolution that is neither a length nor a share.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not a resolution: give a length in map units above 0 (0.02), or a share of the distance up to 100% (0.5%)"
)]
pub struct MapResolutionError(String);

impl Default for MapResolution {
    fn default() -> Self {
        Self::Relative(0.005)
    }
}

impl MapResolution {
    /// Cell size of a point at `distance` from its camera, where a pixel is `pixel` wide, with standard deviation
    /// `sigma` along the ray; map units.
    pub(super) fn cell_size(&self, distance: f64, pixel: f64, sigma: f64) -> f64 {
        let size = match self {
            Self::Length(length) => *length,
            Self::Relative(share) => share * distance,
        };
        size.max(pixel).max(SIGMA_RATIO * sigma)
    }
}

impl FromStr for MapResolution {
    type Err = MapResolutionError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let refuse = || MapResolutionError(text.to_owned());
        let (number, is_share) = match text.trim().strip_suffix('%') {
            Some(percent) => (percent, true),
            None => (text, false),
        };
        let number: f64 = number.trim().parse().map_err(|_| refuse())?;
        /// Finer is below the rounding of a coordinate, coarser than any map.
        const SANE: std::ops::RangeInclusive<f64> = 1e-6..=1e6;
        match (is_share, number) {
            (true, percent) if SANE.contains(&percent) && percent <= 100.0 => {
                Ok(Self::Relative(percent / 100.0))
            }
            (false, length) if SANE.contains(&length) => Ok(Self::Length(length)),
            _ => Err(refuse()),
        }
    }
}

impl fmt::Display for MapResolution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Length(length) => write!(f, "{length}"),
            Self::Relative(share) => write!(f, "{}%", (share * 1e8).round() / 1e6),
        }
    }
}

impl TryFrom<String> for MapResolution {
    type Error = MapResolutionError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<MapResolution> for String {
    fn from(resolution: MapResolution) -> Self {
        resolution.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_and_shares_are_read_and_written() {
        for (text, resolution) in [
            ("0.02", MapResolution::Length(0.02)),
            ("0.5%", MapResolution::Relative(0.005)),
            ("7 %", MapResolution::Relative(0.07)),
            ("1", MapResolution::Length(1.0)),
        ] {
            assert_eq!(text.parse(), Ok(resolution));
            assert_eq!(resolution.to_string().parse(), Ok(resolution));
        }
        for text in ["", "0", "-1", "nan", "inf", "101%", "%", "1e-9", "0.5 m", "0%"] {
            let error = text.parse::<MapResolution>().unwrap_err().to_string();
            assert!(error.contains(&format!("`{text}`")) && error.contains("map units"), "{error}");
        }
    }
}
