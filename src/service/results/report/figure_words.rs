//! Names and meanings of the figures of `summary.json` on the page.

/// The section of a figure on the page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Group {
    /// The run as a whole.
    Run,
    /// Frames and poses.
    Tracking,
    /// Keyframes and points.
    Map,
    /// Joint estimation.
    Joint,
    /// The search for loops.
    Loops,
    /// Durations and memory.
    Time,
    /// Final trajectory against ground truth.
    Accuracy,
    /// Published trajectory against ground truth.
    Published,
    /// Reported covariances against ground truth: of poses on their keyframe,
    PoseCovariance,
    /// … in the map,
    MapCovariance,
    /// … of velocities.
    VelocityCovariance,
    /// Depth against ground truth.
    Depth,
}

/// The groups in the order of the page, with their headings.
pub(super) const GROUPS: [(Group, &str); 12] = [
    (Group::Run, "Run"),
    (Group::Tracking, "Tracking"),
    (Group::Map, "Map"),
    (Group::Joint, "Joint estimation"),
    (Group::Loops, "Loops"),
    (Group::Time, "Time and memory"),
    (Group::Accuracy, "Accuracy against ground truth: final trajectory"),
    (Group::Published, "Accuracy against ground truth: trajectory as published"),
    (Group::PoseCovariance, "Reported covariance against errors: poses relative to their keyframe"),
    (Group::MapCovariance, "Reported covariance against errors: places in the map"),
    (Group::VelocityCovariance, "Reported covariance against errors: velocities"),
    (Group::Depth, "Depth against ground truth"),
];

/// How a figure is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    /// Unchanged.
    Text,
    /// A whole number.
    Count,
    /// A number without a unit.
    Number,
    /// A number with this unit.
    Unit(&'static str),
    /// A length in metres, in the unit that keeps it readable.
    Metres,
    /// A share, in per cent.
    Percent,
    /// Several named numbers; in per cent where `true`.
    Named([&'static str; 3], bool),
    /// Median, percentiles and maximum of a time, milliseconds.
    Times,
    /// Upper ends of times and their counts.
    Histogram,
    /// The camera.
    Camera,
    /// One number per name.
    Counts,
    /// Rows of a table; key, heading and format of each column.
    Rows(&'static [(&'static str, &'static str, Format)]),
    /// Figures with separate entries, in another group.
    Nested(Group),
    /// Drawn elsewhere on the page.
    Drawn,
}

/// One figure.
#[derive(Debug, Clone, Copy)]
pub(super) struct Words {
    /// Its key in `summary.json`.
    pub key: &'static str,
    /// Its group.
    pub group: Group,
    /// Its name.
    pub name: &'static str,
    /// How it is written.
    pub format: Format,
    /// Its meaning, and what is good.
    pub meaning: &'static str,
}

/// A table of words: `key: group, format, name, meaning;`.
macro_rules! words {
    ($($key:ident: $group:ident, $format:expr, $name:literal, $meaning:literal;)*) => {
        &[$(Words { key: stringify!($key), group: Group::$group, name: $name, format: $format, meaning: $meaning }),*]
    };
}
pub(super) use words;

const LEVELS: &[(&str, &str, Format)] = &[
    ("level", "level (0 is the finest)", Format::Count),
    ("frames", "frames", Format::Count),
    ("points", "points, median", Format::Count),
    ("iterations_median", "iterations, median", Format::Number),
    ("iterations_mean", "iterations, mean", Format::Number),
    ("nanos_per_point", "ns a point and iteration", Format::Number),
];
const REJECTIONS: &[(&str, &str, Format)] =
    &[("sequence", "frame", Format::Count), ("reason", "reason", Format::Text)];
const CAUSES: &[(&str, &str, Format)] = &[
    ("process", "process", Format::Text),
    ("cause", "cause", Format::Text),
    ("count", "times", Format::Count),
];

/// Figures that need no ground truth.
pub(super) const RUN_WORDS: &[Words] = words! {
    mode: Run, Format::Text, "Mode", "Replay and lockstep take every frame; live takes the newest and skips those that it has no time for.";
    source: Run, Format::Text, "Source", "Where the frames came from.";
    camera: Run, Format::Camera, "Camera", "Focal lengths, principal point and size of the rectified images, pixels.";
    ended: Run, Format::Text, "End", "Finished, interrupted, failed, or recovered from the journal of a run that was killed.";
    failure: Run, Format::Text, "Failure", "What ended the run.";
    recovered_run_end: Run, Format::Text, "End of the recovered run", "When the run ended from whose journal this was recovered (UTC).";
    grade: Run, Format::Drawn, "Grade", "At the head of the page.";
    frames_in: Run, Format::Count, "Frames", "Frames that the source delivered.";
    frames_refused: Run, Format::Count, "Images refused", "Images of the source that could not be used. 0 is good.";
    refused: Run, Format::Text, "What was refused", "The first image that could not be used, and what is wrong with it.";
    brightened_by: Run, Format::Count, "Brightened by", "Largest factor on the grey levels of dim images. 1 is good: more light, or a longer exposure, has less noise.";
    gaps: Run, Format::Count, "Gaps", "Holes in the source's numbering of frames. 0 is good.";
    restarts: Run, Format::Count, "Restarts", "Processes that were restarted after they had ended. 0 is good.";
    restarts_by_process: Run, Format::Counts, "Restarts of each process", "How often each process was restarted.";
    restart_causes: Run, Format::Rows(CAUSES), "Causes of restarts", "Why the restarted processes had ended.";
    recorded_secs: Run, Format::Unit("s"), "Recorded duration", "From the first stamp to the last.";
    wall_secs: Run, Format::Unit("s"), "Duration of the run", "Time from start to end of the run.";
    realtime_factor: Run, Format::Unit("× real time"), "Speed", "Recorded duration over that of the run. A replay may be faster than 1; a live run is 1.";

    frames_tracked: Tracking, Format::Count, "Frames tracked", "Frames that have a pose. All of them is best.";
    frames_tracked_later: Tracking, Format::Count, "Frames tracked afterwards", "Of them those from before the map began, aligned to it afterwards.";
    frames_degraded: Tracking, Format::Count, "Frames with a degraded pose", "Frames whose pose is worse than it should be: few points, blur. Few is good.";
    frames_withdrawn: Tracking, Format::Count, "Frames withdrawn", "Tracked frames whose keyframe was rejected afterwards: trajectory.txt leaves them out. 0 is good.";
    frames_initializing: Tracking, Format::Count, "Frames before the map", "Frames without a pose because the map could not be trusted yet.";
    frames_lost: Tracking, Format::Count, "Frames lost", "Frames without a pose because tracking was lost. 0 is good.";
    lost_count: Tracking, Format::Count, "Losses", "How often tracking was lost. 0 is good.";
    frames_dropped: Tracking, Format::Count, "Frames dropped", "Frames that the tracker never saw because newer ones had arrived. 0 is good.";
    frames_skipped_by_mapper: Tracking, Format::Count, "Frames not mapped", "Frames with a pose that the mapper left out because newer ones had arrived. Their poses are not affected.";
    deadline_misses: Tracking, Format::Count, "Deadline misses", "Poses published after the tracker's deadline, which counts from the frame's arrival. 0 is good.";
    initialization_secs: Tracking, Format::Unit("s"), "Time to the first pose", "From the first frame to the first whose pose is claimed.";
    untracked: Tracking, Format::Text, "Why nothing was tracked", "The most likely reason.";
    whitened_residual_median: Tracking, Format::Number, "Residual over its standard deviation", "Median over the tracked frames: 1 is as modelled; above 1.5 the calibration is doubtful.";

    keyframes: Map, Format::Count, "Keyframes", "Frames of the final map that have their own depth.";
    keyframes_without_depth: Map, Format::Count, "Keyframes without depth", "Those whose depth is no longer held: the oldest of a long run, and those of a map that was left for another one (`map load`).";
    points: Map, Format::Count, "Certain points of the keyframes", "Points of all keyframes whose relative standard deviation is at most results.max_relative_std_dev (10 % unless set).";
    map_points: Map, Format::Count, "Points of the map", "Points of the surface that those of the evaluated epoch are fused into: the points of map.ply.";
    epoch: Map, Format::Count, "Last epoch", "Epoch of the map at the end, counted from 0: a map that is lost for good is restarted.";
    epochs: Map, Format::Count, "Epochs with poses", "Each has its own coordinate frame and scale. 1 is good.";
    map_rejections: Map, Format::Rows(REJECTIONS), "Rejected maps", "How often the map was found to contradict itself and was restarted.";

    adjustments: Joint, Format::Count, "Joint estimates", "Estimates of several keyframes together that entered the map.";
    adjustments_merged: Joint, Format::Count, "Of them merged", "Those that entered a map with newer keyframes, which followed.";
    adjustments_dropped: Joint, Format::Count, "Dropped", "Estimates that were dropped because the map had changed meanwhile. Few is good.";
    adjustment_ms: Joint, Format::Times, "CPU time of an estimate", "Runs alongside tracking and mapping.";
    adjustment_frames_max: Joint, Format::Count, "Longest delay", "Most frames between a keyframe and the entry of its estimate.";
    adjustment_inlier_ratio_median: Joint, Format::Percent, "Inliers", "Comparisons of a point with a keyframe that agree, median of the estimates. Above 80 % is good.";
    adjustment_rms_grey_median: Joint, Format::Unit("grey levels"), "Residual", "Difference in brightness that is left, root mean square, median of the estimates. A few levels are the camera's noise.";

    loop_searches: Loops, Format::Count, "Searches", "Keyframes that were searched for in older ones.";
    loop_pairs: Loops, Format::Count, "Pairs compared", "Pairs of keyframes that were compared.";
    loops_closed: Loops, Format::Count, "Loops closed", "Recognised places that corrected the map.";
    loops_held: Loops, Format::Count, "Loops held already", "Recognised places that the map already satisfied: it had not drifted.";
    epochs_joined: Loops, Format::Count, "Epochs joined", "Maps that were joined to an older one.";
    loops_against_drift: Loops, Format::Count, "Against the drift", "Places that look alike but are further apart than the map can have drifted.";
    loops_unconfirmed: Loops, Format::Count, "Not confirmed", "Places that no second pair of keyframes confirmed.";
    loops_inconsistent: Loops, Format::Count, "Inconsistent", "Places that contradicted other loops.";
    loops_refused: Loops, Format::Count, "Other places", "Keyframes whose candidates turned out to be other places.";
    loop_search_ms: Loops, Format::Times, "CPU time of a search", "Runs alongside tracking and mapping.";
    loop_search_ms_per_keyframe: Loops, Format::Unit("ms"), "CPU time of searches for each keyframe", "All searches over the keyframes of the map.";

    send_ms: Time, Format::Times, "From stamp to sending", "Delay before the tracker's deadline starts.";
    latency_ms: Time, Format::Times, "Latency", "From a frame's stamp to the publication of its pose.";
    wake_ms: Time, Format::Times, "Wake-up time", "From a frame's sending until the tracker looks at it.";
    latency_histogram: Time, Format::Histogram, "Latencies", "How many frames were that late.";
    track_histogram: Time, Format::Histogram, "Times in the tracker", "How many frames took that long.";
    wake_histogram: Time, Format::Histogram, "Wake-up times", "How many frames waited that long.";
    deadline_ms: Time, Format::Unit("ms"), "Deadline", "Time from a frame's arrival until its pose is due.";
    track_ms: Time, Format::Times, "Tracking a frame", "Time in the tracker. Good is well below the interval between frames.";
    pyramid_ms: Time, Format::Times, "Image pyramid", "Part of the tracking time: from the frame to the first iteration.";
    alignment_levels: Time, Format::Rows(LEVELS), "Alignment by pyramid level", "What the alignment of a frame costs on each level of the image pyramid.";
    map_ms: Time, Format::Times, "Mapping a frame", "Time in the mapper.";
    keyframe_step_ms: Time, Format::Times, "Mapping a frame that becomes a keyframe", "The longest steps of the mapper.";
    keyframe_ms: Time, Format::Times, "Until a new keyframe can be used", "Part of it: from the frame to a keyframe that the tracker can use.";
    fusion_secs: Time, Format::Unit("s"), "Fusing the map", "Time after the run to fuse the keyframes' points.";
    budget_curve: Time, Format::Drawn, "Quality and budget", "In the charts above.";
    page_faults: Time, Format::Count, "Page faults", "Of the tracker's frame loop after its first hundred frames: each can cost a deadline. 0 is good.";
    peak_rss_mb: Time, Format::Unit("MiB"), "Memory", "Largest resident memory of all processes together.";
};
