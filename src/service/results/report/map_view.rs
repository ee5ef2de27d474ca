//! The 3D map in the report: the page's viewer with a thinned map in it, without any other file.

use std::fmt::Write;

use nalgebra::Vector3;

use crate::service::results::Results;
use crate::service::results::poses::{final_poses, keyframes_of_longest_epoch, longest_epoch};
use crate::service::results::report::html::base64;
use crate::service::results::report::number_text::grouped;
use crate::service::results::report::scene::{
    PLAYER, SceneInput, SceneKeyframe, ScenePoint, VIEWER, pack,
};
use crate::slam::fusion::SurfacePoint;
use crate::slam::trajectory::gaps_in;

/// Most points of the map in a report: 3.2 MB of text, which a browser opens at once.
const MAX_POINTS: usize = 300_000;

/// The section; empty without points.
pub fn map_view(results: &Results<'_>, up: Option<Vector3<f64>>) -> String {
    let map = &results.record.map;
    let Some(first) = map.keyframes.first().filter(|_| !results.surface.is_empty()) else {
        return String::new();
    };
    let keyframes: Vec<SceneKeyframe> = keyframes_of_longest_epoch(results.record)
        .map(|k| SceneKeyframe {
            keyframe_id: k.keyframe_id,
            nanos: k.capture_nanos,
            place: k.map_from_keyframe,
        })
        .collect();
    // Each point belongs to the first keyframe that saw it.
    let scene_point = |&SurfacePoint { position, grey, sigma, .. }: &SurfacePoint| ScenePoint {
        position,
        grey,
        std_dev: sigma,
        keyframe_id: None,
    };
    let points: Vec<ScenePoint> = results.surface.iter().map(scene_point).collect();
    let epoch = longest_epoch(results.record);
    let gaps = epoch.map_or_else(Vec::new, |epoch| gaps_in(&final_poses(results.record), epoch));
    let block = pack(&SceneInput {
        points: &points,
        keyframes: &keyframes,
        path: &results.trajectory,
        gaps: &gaps,
        intrinsics: &first.intrinsics,
        up: up.map(Into::into),
        max_points: MAX_POINTS,
    });
    let shown = points.len().min(MAX_POINTS);
    let mut html =
        format!("<section><style>{}</style><h2>Map in 3D</h2>", include_str!("map_view.css"));
    html.push_str(include_str!("map_view.html"));
    let _ = write!(
        html,
        "<p>{} of {} points; drag to turn, wheel or two fingers to zoom, shift-drag to move, double click to show all of it. \
         Blue: the camera's path; the slider shows the map as it grew. Lengths are map units. \
         <code>semidense view</code> with this folder shows all points.</p>",
        grouped(shown as u64),
        grouped(points.len() as u64)
    );
    let _ =
        write!(html, "<script type=\"text/plain\" id=\"map3d-data\">{}</script>", base64(&block));
    let _ = write!(html, "<script>{VIEWER}</script><script>{PLAYER}</script>");
    let _ = write!(html, "<script>{}</script></section>", include_str!("map_view.js"));
    html
}
