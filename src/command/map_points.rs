//! Options of the commands that write a map's points.

use clap::Args;

use crate::service::results::ResultsParams;
use crate::slam::fusion::MapResolution;

/// How a map's points are written.
#[derive(Debug, Clone, Args)]
pub struct MapPointOptions {
    /// Spacing of the points of map.ply: a length in map units (0.02), or a share of the distance from the
    /// camera (0.5%), so that near surfaces are finer; never below the points' standard deviation [default:
    /// results.map_resolution of the configuration, 0.5% unless set]
    #[arg(long, value_name = "LENGTH|SHARE%")]
    map_resolution: Option<MapResolution>,
    /// Also write map.pcd: the points of map.ply for PCL
    #[arg(long)]
    pcd: bool,
    /// Also write points-full.ply: every point of every keyframe, before they are fused into one surface
    /// (about 25 MB per million points)
    #[arg(long)]
    full_points: bool,
}

impl MapPointOptions {
    /// The configured parameters with the options of the command line.
    pub fn of(&self, configured: &ResultsParams) -> ResultsParams {
        ResultsParams {
            map_resolution: self.map_resolution.unwrap_or(configured.map_resolution),
            pcd: self.pcd || configured.pcd,
            full_points: self.full_points || configured.full_points,
            ..configured.clone()
        }
    }
}
