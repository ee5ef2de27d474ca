//! The charts of the joint estimation: how well it explains the images over the run, its time, and the resulting depth
//! of the keyframes.

use std::collections::HashMap;

use crate::service::adjustments::AdjustmentRecord;
use crate::service::results::record::RunRecord;
use crate::service::results::report::chart::{Chart, Scaling};
use crate::service::results::report::charts::{ERROR, ESTIMATE, MAPPING, ONLINE, secs};
use crate::service::results::report::series::{Mark, Series};
use crate::slam::evaluation::depth_error::KeyframeDepth;
use crate::slam::evaluation::statistics::median;

const RESIDUAL_MEANING: &str = "Difference in brightness between the keyframes after they are estimated together: a few \
                                grey levels are the camera's noise; a rise means that the map does not fit the images.";
const INLIER_MEANING: &str = "Comparisons of a point with a keyframe that agree. Above 80 % is good; low values indicate moving objects, hidden points or \
     wrong depth.";
const TIME_MEANING: &str =
    "CPU time of each joint estimate of keyframes; it runs alongside tracking and mapping.";

/// Residual, share of inliers and time of every joint estimate; empty without any.
pub fn joint_charts(record: &RunRecord) -> Vec<Chart> {
    let poses = record.poses.iter();
    let times: HashMap<u64, i64> =
        poses.map(|pose| (pose.estimate.sequence, pose.estimate.capture_nanos)).collect();
    let points = |value: fn(&AdjustmentRecord) -> f64| -> Vec<[f64; 2]> {
        let timed = record.adjustments.iter().filter_map(|estimate| {
            let nanos = *times.get(&estimate.sequence)?;
            Some([secs(record, nanos), value(estimate)])
        });
        timed.collect()
    };
    let chart = |title, meaning, y_label, colour, points| {
        let line = vec![Series::new("", colour, Mark::Line, points)];
        Chart::over_time(title, meaning, y_label, Scaling::FromZero, line)
    };
    let residual = points(|estimate| estimate.adjustment.rms_grey);
    if residual.is_empty() {
        return Vec::new();
    }
    let inliers = points(|estimate| 100.0 * estimate.adjustment.inlier_ratio);
    let time = points(|estimate| estimate.nanos as f64 * 1e-6);
    vec![
        chart(
            "Residual of joint estimates",
            RESIDUAL_MEANING,
            "root mean square [grey levels]",
            ERROR,
            residual,
        ),
        chart(
            "Inliers of joint estimates",
            INLIER_MEANING,
            "of comparisons [%]",
            ESTIMATE,
            inliers,
        ),
        chart("CPU time of joint estimates", TIME_MEANING, "CPU time [ms]", MAPPING, time),
    ]
}

const MODES_MEANING: &str = "Depth errors that all points of a keyframe share: depth that grows across the columns or rows \
                             of the image, and relief that is too strong or too weak. 0 is right.";

/// The scales and the common errors of each keyframe's depth over the run; empty without true depth.
pub fn depth_charts(record: &RunRecord, keyframes: &[KeyframeDepth]) -> Vec<Chart> {
    let points = |value: &dyn Fn(&KeyframeDepth) -> Option<f64>| -> Vec<[f64; 2]> {
        let timed = keyframes.iter().map(|of| (secs(record, of.capture_nanos), value(of)));
        timed.filter_map(|(time, value)| Some([time, value?])).collect()
    };
    let units: Vec<f64> = keyframes.iter().map(|of| of.units_per_metre).collect();
    let Some(middle) = median(&units).filter(|_| units.len() > 1) else { return Vec::new() };
    let series = |name, colour, points| Series::new(name, colour, Mark::Dots(2.6), points);
    let unit = points(&|of| Some(of.units_per_metre / middle));
    let mode = |which: usize| points(&|of| of.modes.map(|modes| modes[which]));
    let modes = vec![
        series("along columns", ESTIMATE, mode(0)),
        series("along rows", ONLINE, mode(1)),
        series("relief", ERROR, mode(2)),
    ];
    let mut charts = vec![Chart::over_time(
        "Depth scales of the keyframes",
        "Length of a true metre in each keyframe's depth, over the median of all. 1 everywhere means that the keyframes \
         agree in scale.",
        "map units in a metre / their median",
        Scaling::Free,
        vec![series("", MAPPING, unit)],
    )];
    if modes.iter().any(|of| !of.points.is_empty()) {
        let (title, y_label) = ("Common errors of depth", "for each unit");
        charts.push(Chart::over_time(title, MODES_MEANING, y_label, Scaling::Free, modes));
    }
    charts
}
