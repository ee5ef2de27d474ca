//! Names and meanings on the page of the figures of `summary.json` that need ground truth.

use crate::service::results::report::figure_words::{Format, Group, Words, words};

const MODES: [&str; 3] = ["along columns", "along rows", "relief"];
const SIGMAS: [&str; 3] = ["1 σ", "2 σ", "3 σ"];

/// Figures that need ground truth. Those of the trajectories and covariances appear several times, each in its group.
pub(super) const QUALITY_WORDS: &[Words] = words! {
    evaluated_epoch: Accuracy, Format::Count, "Epoch compared", "The epoch with the most tracked frames, counted from 0.";
    matched_poses: Accuracy, Format::Count, "Poses compared", "Poses that have ground truth.";
    ate_rmse_m: Accuracy, Format::Metres, "Position error (ATE), root mean square", "Distance from the ground truth after one alignment of the whole path.";
    ate_mean_m: Accuracy, Format::Metres, "Position error, mean", "The same, mean.";
    ate_median_m: Accuracy, Format::Metres, "Position error, median", "The same: half of the frames are better.";
    ate_max_m: Accuracy, Format::Metres, "Position error, largest", "The same, of the worst frame.";
    ate_scale: Accuracy, Format::Unit("m"), "Map unit", "Length of a map unit by the alignment: a single camera cannot determine it.";
    rpe_translation: Accuracy, Format::Metres, "Relative error of position, frame to frame", "Error of the movement from one frame to the next, root mean square.";
    rpe_rotation_deg: Accuracy, Format::Unit("°"), "Relative error of rotation, frame to frame", "Error of the turn from one frame to the next, root mean square.";
    rpe_translation_1s: Accuracy, Format::Metres, "Relative error of position over 1 s", "Error of the movement within a second, root mean square: the drift.";
    rpe_rotation_deg_1s: Accuracy, Format::Unit("°"), "Relative error of rotation over 1 s", "Error of the turn within a second, root mean square: the drift.";
    path_length_m: Accuracy, Format::Metres, "Length of the path", "Of the ground truth between compared poses.";
    window_scale_ratio: Accuracy, Format::Number, "Scale drift", "Largest over smallest scale of the path in windows of 100 frames. 1 is best.";
    window_error_m: Accuracy, Format::Metres, "Error of short windows", "Median position error of windows of 30 frames, each aligned by itself: without the drift.";
    online: Published, Format::Nested(Group::Published), "As published", "The trajectory as it was published during the run.";

    nees_frames: PoseCovariance, Format::Count, "Frames compared", "Frames whose error can be compared with the covariance that was reported.";
    nees_mean: PoseCovariance, Format::Number, "Squared error over covariance, mean", "Of all components (three of position or velocity, three of rotation): 6 where the covariance is right; more means that it is too small.";
    nees_median: PoseCovariance, Format::Number, "Squared error over covariance, median", "5.3 where the covariance is right.";
    nees_translation: PoseCovariance, Format::Number, "Linear part, mean", "3 where the covariance is right.";
    nees_rotation: PoseCovariance, Format::Number, "Rotation, mean", "3 where the covariance is right.";
    nees_below_bound: PoseCovariance, Format::Percent, "Frames below the 95 % bound", "95 % where the covariance is right; fewer means that it is too small.";
    map_nees: MapCovariance, Format::Nested(Group::MapCovariance), "Places in the map", "The same of the places in the map.";
    velocity_nees: VelocityCovariance, Format::Nested(Group::VelocityCovariance), "Velocities", "The same of the velocities.";

    depth_pixels: Depth, Format::Count, "Pixels compared", "Pixels of keyframes whose true depth is known.";
    depth_relative_error_median: Depth, Format::Percent, "Depth error, median", "Relative to the true depth.";
    depth_relative_error_median_best_half: Depth, Format::Percent, "Depth error of the more certain half, median", "The same over the half with the smallest relative standard deviation.";
    depth_coverage: Depth, Format::Named(SIGMAS, true), "Within the reported standard deviation", "Share of the pixels whose true inverse depth is within 1, 2 and 3 σ: 68 %, 95 % and 99.7 % where σ is right.";
    depth_density: Depth, Format::Percent, "Density", "Share of the keyframes' pixels that have depth.";
    depth_modes: Depth, Format::Named(MODES, false), "Common errors of a keyframe", "Depth that grows across columns or rows of the image, and relief too strong or too weak: medians of the magnitude. 0 is best.";
    depth_modes_whitened: Depth, Format::Named(MODES, false), "Common errors over their standard deviation", "0.67 where the reported standard deviation is right; more means that it is too small.";
    depth_scale_ratio: Depth, Format::Number, "Spread of the keyframes' depth scales", "Largest over smallest: how far the keyframes disagree in scale. 1 is best.";
    keyframe_depth: Depth, Format::Drawn, "Depth of each keyframe", "In the charts above.";
};
