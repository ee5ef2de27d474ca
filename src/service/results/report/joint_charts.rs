//! The charts of the joint estimation: how well it explains the images over the run, and its time.

use std::collections::HashMap;

use crate::service::adjustments::AdjustmentRecord;
use crate::service::results::RunRecord;
use crate::service::results::report::chart::{Chart, Mark, Scaling, Series};
use crate::service::results::report::charts::{ERROR, ESTIMATE, MAPPING, secs};

/// Residual, share of inliers and time of every joint estimate; none where there was none.
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
    let chart = |title, y_label: &str, colour, points: Vec<[f64; 2]>| Chart {
        title,
        x_label: "time [s]".into(),
        y_label: y_label.into(),
        height: 230.0,
        scaling: Scaling::FromZero,
        series: vec![Series { name: "", colour, mark: Mark::Line, points }],
    };
    let residual = points(|estimate| estimate.adjustment.rms_grey);
    if residual.is_empty() {
        return Vec::new();
    }
    let inliers = points(|estimate| 100.0 * estimate.adjustment.inlier_ratio);
    let time = points(|estimate| estimate.nanos as f64 * 1e-6);
    vec![
        chart("Residual of joint estimates", "root mean square [grey levels]", ERROR, residual),
        chart("Inliers of joint estimates", "of comparisons [%]", ESTIMATE, inliers),
        chart("CPU time of joint estimates", "[ms]", MAPPING, time),
    ]
}
