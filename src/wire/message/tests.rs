//! Layouts that every program reading our topics relies on.

use super::*;

/// A change of layout breaks every program that reads our topics: it needs a new version in
/// the `type_name` and in [`crate::wire::topic::WIRE_VERSION`].
fn assert_layout<T: ZeroCopySend>(size: usize, alignment: usize, name: &str) {
    assert_eq!((size_of::<T>(), align_of::<T>()), (size, alignment), "{name}");
    // SAFETY: it only returns a name.
    assert_eq!(unsafe { <T as ZeroCopySend>::type_name() }, name);
}

#[test]
fn layouts_are_pinned() {
    assert_layout::<FrameHeader>(96, 8, "semidense.FrameHeader.v3");
    assert_layout::<PoseMessage>(1064, 8, "semidense.Pose.v7");
    assert_layout::<KeyframeHeader>(488, 8, "semidense.KeyframeHeader.v4");
    assert_layout::<DepthPoint>(16, 4, "semidense.DepthPoint.v1");
    assert_layout::<KeyframeImageHeader>(24, 8, "semidense.KeyframeImageHeader.v1");
    assert_layout::<StepMessage>(136, 8, "semidense.Step.v4");
    assert_layout::<GraphHeader>(24, 8, "semidense.GraphHeader.v2");
    assert_layout::<KeyframePoseMessage>(80, 8, "semidense.KeyframePose.v2");
    assert_layout::<AdjustmentMessage>(72, 8, "semidense.Adjustment.v1");
    assert_layout::<HealthMessage>(2360, 8, "semidense.Health.v6");
    assert_layout::<CommandRequest>(4112, 8, "semidense.CommandRequest.v2");
    assert_layout::<CommandResponse>(200, 4, "semidense.CommandResponse.v1");
}
