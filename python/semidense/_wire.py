"""The messages in shared memory. Generated from the Rust definitions: never edit it.

SEMIDENSE_WRITE_WIRE=1 cargo test --test repository wire_table
"""
# ruff: noqa
from __future__ import annotations

import ctypes
import enum
from typing import NamedTuple, Optional

WIRE_VERSION = 11
MAX_KEYFRAME_POINTS = 100000
# Where the buckets of a histogram end, milliseconds.
BUCKET_ENDS_MS = (
    0.0014142135623730952, 0.002, 0.0028284271247461905, 0.004, 0.005656854249492381,
    0.008, 0.011313708498984762, 0.016, 0.022627416997969524, 0.032,
    0.04525483399593905, 0.064, 0.0905096679918781, 0.128, 0.1810193359837562,
    0.256, 0.3620386719675124, 0.512, 0.7240773439350248, 1.024,
    1.4481546878700495, 2.048, 2.896309375740099, 4.096, 5.792618751480198,
    8.192, 11.585237502960396, 16.384, 23.170475005920792, 32.768,
    46.340950011841585, 65.536, 92.68190002368317, 131.072, 185.36380004736634,
    262.144, 370.7276000947327, 524.288, 741.4552001894654, 1048.576,
    1482.9104003789307, 2097.152, 2965.8208007578614, 4194.304, 5931.641601515723,
    8388.608, 11863.283203031446, 16777.216,
)


class FrameHeader(ctypes.Structure):
    """Header of `capture/frame`; the payload is the grey image."""

    SIZE = 96
    _fields_ = [
        # Number of the frame at its source; a gap means missing frames.
        ("sequence", ctypes.c_uint64),
        # Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
        ("capture_nanos", ctypes.c_int64),
        # CLOCK_MONOTONIC instant that latency counts from: a camera's stamp, a recording's paced instant, or the sending.
        ("clock_nanos", ctypes.c_int64),
        # CLOCK_REALTIME at `clock_nanos`, by the system clock at the time of sending; 0 where unknown.
        ("realtime_nanos", ctypes.c_int64),
        # CLOCK_MONOTONIC when it was sent; wake-up times count from here.
        ("sent_nanos", ctypes.c_int64),
        # Exposure time in nanoseconds, 0 where unknown.
        ("exposure_nanos", ctypes.c_uint64),
        # fx, fy, cx, cy in pixels.
        ("intrinsics", ctypes.c_double * 4),
        # Width in pixels.
        ("width", ctypes.c_uint32),
        # Height in pixels.
        ("height", ctypes.c_uint32),
        # Bytes from row to row; equal to the width.
        ("stride", ctypes.c_uint32),
        # Sensor gain, 0 where unknown.
        ("gain", ctypes.c_float),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.FrameHeader.v3"


class PoseMessage(ctypes.Structure):
    """Message of `tracker/pose`."""

    SIZE = 1064
    _fields_ = [
        # Sequence of the frame.
        ("sequence", ctypes.c_uint64),
        # Stamp of the frame, nanoseconds.
        ("capture_nanos", ctypes.c_int64),
        # `realtime_nanos` of the frame, bit for bit: CLOCK_REALTIME at its `clock_nanos`; 0 where unknown.
        ("realtime_nanos", ctypes.c_int64),
        # CLOCK_MONOTONIC when the pose was published.
        ("published_nanos", ctypes.c_int64),
        # From the frame's `clock_nanos` to `published_nanos`.
        ("latency_nanos", ctypes.c_uint64),
        # Tracking time.
        ("track_nanos", ctypes.c_uint64),
        # From sending the frame to the tracker picking it up.
        ("wake_nanos", ctypes.c_uint64),
        # Revision of the keyframe it was tracked on.
        ("revision", ctypes.c_uint64),
        # Keyframe it was tracked on, all ones before the first.
        ("keyframe_id", ctypes.c_uint64),
        # Epoch of the map.
        ("epoch", ctypes.c_uint32),
        # 0 initializing, 1 tracking, 2 degraded, 3 lost.
        ("state", ctypes.c_uint32),
        # Reason: degraded 0 budget, 1 low overlap, 2 high residual, 3 gap, 4 turning; lost 0 diverged, 1 too few inliers, 2 no points, 3 unusable frame, 4 map rejected; otherwise 0.
        ("reason", ctypes.c_uint32),
        # 1 if the tracker proposes a new keyframe here.
        ("proposes_keyframe", ctypes.c_uint32),
        # Number of corrections of the map when the keyframe was published: `map_from_camera` jumps where this increases.
        ("map_revision", ctypes.c_uint64),
        # Odometry pose: drifts, and never jumps within an epoch, except from a turning pose to the next that is not.
        ("world_from_camera", ctypes.c_double * 7),
        # Pose in the map, the best estimate: jumps where the map is corrected.
        ("map_from_camera", ctypes.c_double * 7),
        # Pose relative to the keyframe, keyframe units.
        ("keyframe_from_camera", ctypes.c_double * 7),
        # Upper triangle, row-major, of the covariance of the left increment (translation, rotation) of `current_from_keyframe`, keyframe units and radians. Includes the noise of single points, the errors shared by all depth of the keyframe (its `mode_covariance`) and displacements of the whole image (`displacement_px`). Calibrated on simulated and recorded sequences: check the `nees_…` figures of your own recording before fusing it. Excludes the drift of the keyframe itself and of the scale.
        ("covariance", ctypes.c_double * 21),
        # Upper triangle, row-major, of the covariance of the left increment ξ (translation, rotation) of `map_from_camera`, `exp(ξ) map_from_camera`, map units and radians: `covariance` and the keyframe's `place_covariance`. The increment rotates about the map's origin: a position p errs by ξ_t + ξ_ω × p. Relative to the first keyframe of the epoch, so that it includes the estimated drift of the map since its start.
        ("map_covariance", ctypes.c_double * 21),
        # As `covariance`, but of the alignment alone, for the mapper. Overconfident by a factor of up to a hundred in standard deviation: never fuse it.
        ("alignment_covariance", ctypes.c_double * 21),
        # Camera velocity at the frame's stamp, along its axes (x right, y down, z forward), world units per second.
        ("linear_velocity", ctypes.c_double * 3),
        # Angular velocity about the same axes, radians per second.
        ("angular_velocity", ctypes.c_double * 3),
        # Upper triangle, row-major, of the covariance of both, linear first; excludes the error of the map's scale.
        ("velocity_covariance", ctypes.c_double * 21),
        # Affine brightness relative to the keyframe: a, b.
        ("brightness", ctypes.c_double * 2),
        # Share of the keyframe's points in view.
        ("in_view_ratio", ctypes.c_double),
        # Share of inliers among the compared points.
        ("inlier_ratio", ctypes.c_double),
        # Huber-weighted root mean square of the residuals over their standard deviations.
        ("whitened_rmse", ctypes.c_double),
        # Root mean square of the residuals, grey levels.
        ("residual_rmse", ctypes.c_double),
        # Mean squared optical flow, pixels².
        ("mean_squared_flow", ctypes.c_double),
        # Standard deviation of an undetected displacement of the whole image, pixels; included in `covariance`.
        ("displacement_px", ctypes.c_double),
        # Iterations over all levels.
        ("iterations", ctypes.c_uint32),
        # Finest level that was solved; the number of levels if none was.
        ("finest_level", ctypes.c_uint32),
        # Points compared: in view and not clipped by the sensor.
        ("points", ctypes.c_uint32),
        # 1 if the velocity is known (this frame and the previous one were tracked in one epoch); else 0, and it is zero.
        ("has_velocity", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.Pose.v7"


class KeyframeHeader(ctypes.Structure):
    """Header of `mapper/keyframe`; the payload is its `DepthPoint`s."""

    SIZE = 488
    _fields_ = [
        # Id of the keyframe.
        ("keyframe_id", ctypes.c_uint64),
        # Increases with every change of the map.
        ("revision", ctypes.c_uint64),
        # Sequence of its frame.
        ("sequence", ctypes.c_uint64),
        # Stamp of its frame, nanoseconds.
        ("capture_nanos", ctypes.c_int64),
        # Pose and unit of the keyframe in odometry, from which poses follow.
        ("world_from_keyframe", ctypes.c_double * 8),
        # Pose and unit of the keyframe in the map.
        ("map_from_keyframe", ctypes.c_double * 8),
        # Number of corrections of the map by then.
        ("map_revision", ctypes.c_uint64),
        # fx, fy, cx, cy in pixels.
        ("intrinsics", ctypes.c_double * 4),
        # Upper triangle, row-major, of the covariance of the errors shared by all its depth: relative errors of inverse depth per unit of X, of Y (the ray's coordinates) and of ln d.
        ("mode_covariance", ctypes.c_double * 6),
        # Upper triangle, row-major, of the covariance of the keyframe's pose and unit: the left increment (translation, rotation) of the rigid part of `map_from_keyframe`, map units and radians, and the logarithm of its unit.
        ("place_covariance", ctypes.c_double * 28),
        # Epoch of the map.
        ("epoch", ctypes.c_uint32),
        # State of the map: 1 established, 2 rejected.
        ("map_state", ctypes.c_uint32),
        # Width of its image, pixels.
        ("width", ctypes.c_uint32),
        # Height of its image, pixels.
        ("height", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.KeyframeHeader.v4"


class DepthPoint(ctypes.Structure):
    """One pixel with depth, as sent over the wire."""

    SIZE = 16
    _fields_ = [
        # Column of the pixel, level 0.
        ("u", ctypes.c_uint16),
        # Row of the pixel, level 0.
        ("v", ctypes.c_uint16),
        # 1/z along the keyframe's optical axis, 1/keyframe units.
        ("inverse_depth", ctypes.c_float),
        # Variance of the inverse depth.
        ("variance", ctypes.c_float),
        # Brightness of the pixel, 0 to 255.
        ("intensity", ctypes.c_float),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.DepthPoint.v1"


class KeyframeImageHeader(ctypes.Structure):
    """Header of `mapper/keyframe_image`; the payload is the grey image."""

    SIZE = 24
    _fields_ = [
        # The keyframe.
        ("keyframe_id", ctypes.c_uint64),
        # Epoch of the map.
        ("epoch", ctypes.c_uint32),
        # Width in pixels.
        ("width", ctypes.c_uint32),
        # Height in pixels.
        ("height", ctypes.c_uint32),
        # Bytes from row to row; equal to the width.
        ("stride", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.KeyframeImageHeader.v1"


class StepMessage(ctypes.Structure):
    """Message of `mapper/step`: this frame has entered the map."""

    SIZE = 136
    _fields_ = [
        # Sequence of the frame.
        ("sequence", ctypes.c_uint64),
        # Keyframe that is active from the next frame on, all ones before the first.
        ("keyframe_id", ctypes.c_uint64),
        # Its revision.
        ("revision", ctypes.c_uint64),
        # Duration of the step.
        ("step_nanos", ctypes.c_uint64),
        # Part of it spent on making and publishing a new keyframe, after the frame was observed; 0 if there was none.
        ("change_nanos", ctypes.c_uint64),
        # Keyframes in the map.
        ("keyframes", ctypes.c_uint64),
        # Points with depth of the active keyframe.
        ("points", ctypes.c_uint64),
        # Stamp of the last frame whose pose was claimed, nanoseconds.
        ("pose_nanos", ctypes.c_int64),
        # That pose: a restarted tracker begins here.
        ("world_from_camera", ctypes.c_double * 7),
        # 1 if there was such a frame in the epoch.
        ("has_pose", ctypes.c_uint32),
        # Epoch of the map.
        ("epoch", ctypes.c_uint32),
        # While there is no map, the outcome of the frame: 1 begun, 2 dark, 3 overexposed, 4 textureless, 5 unmatched, 6 still, 7 turned, 8 little parallax; otherwise 0.
        ("start_frame", ctypes.c_uint32),
        # Zero.
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.Step.v4"


class GraphHeader(ctypes.Structure):
    """Header of `mapper/graph`; the payload is one `KeyframePoseMessage` per keyframe."""

    SIZE = 24
    _fields_ = [
        # Newest revision among its keyframes.
        ("revision", ctypes.c_uint64),
        # Number of corrections of the map by then.
        ("map_revision", ctypes.c_uint64),
        # Epoch of the map.
        ("epoch", ctypes.c_uint32),
        # Zero.
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.GraphHeader.v2"


class KeyframePoseMessage(ctypes.Structure):
    """The pose of one keyframe in `mapper/graph`."""

    SIZE = 80
    _fields_ = [
        # The keyframe.
        ("keyframe_id", ctypes.c_uint64),
        # Revision of its depth; a reader that holds a different one sends a request for the keyframe.
        ("revision", ctypes.c_uint64),
        # Pose and unit of the keyframe in the map.
        ("map_from_keyframe", ctypes.c_double * 8),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.KeyframePose.v2"


class AdjustmentMessage(ctypes.Structure):
    """Message of `mapper/adjustment`: a joint estimate of keyframes has ended."""

    SIZE = 72
    _fields_ = [
        # Sequence of the last frame before it entered the map.
        ("sequence", ctypes.c_uint64),
        # Frames from its start until then.
        ("frames", ctypes.c_uint64),
        # CPU time of the estimate, nanoseconds.
        ("cpu_nanos", ctypes.c_uint64),
        # Newest keyframe that took part.
        ("keyframe_id", ctypes.c_uint64),
        # Share of inliers among the comparisons of a point with a keyframe.
        ("inlier_ratio", ctypes.c_double),
        # Root mean square of the inliers' residuals, grey levels.
        ("rms_grey", ctypes.c_double),
        # Outcome: 0 it entered the map, 1 it entered a map with newer keyframes, which moved with it, 2 it was dropped because the map had changed.
        ("fate", ctypes.c_uint32),
        # Keyframes whose poses were free.
        ("free", ctypes.c_uint32),
        # Keyframes that were fixed and held them in place.
        ("fixed", ctypes.c_uint32),
        # Points.
        ("points", ctypes.c_uint32),
        # Comparisons of a point with a keyframe.
        ("comparisons", ctypes.c_uint32),
        # Steps tried.
        ("iterations", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.Adjustment.v1"


class HealthMessage(ctypes.Structure):
    """Message of `<process>/health`."""

    SIZE = 2360
    _fields_ = [
        # CLOCK_MONOTONIC when it was published.
        ("published_nanos", ctypes.c_int64),
        # CLOCK_MONOTONIC when the process started.
        ("started_nanos", ctypes.c_int64),
        # Its process id.
        ("process_id", ctypes.c_uint32),
        # 0 starting, 1 preparing, 2 ready, 3 running, 4 finished, 5 failed, 6 stale.
        ("state", ctypes.c_uint32),
        # Preparing: work done so far.
        ("progress_done", ctypes.c_uint64),
        # Preparing: total work, 0 where unknown.
        ("progress_total", ctypes.c_uint64),
        # Frames sent, tracked or mapped.
        ("frames", ctypes.c_uint64),
        # Frames per second over about the last second; NaN before the first has passed.
        ("rate_hz", ctypes.c_double),
        # Late frames that were skipped.
        ("dropped", ctypes.c_uint64),
        # Frames lost by the source.
        ("gaps", ctypes.c_uint64),
        # Messages refused as invalid.
        ("refused", ctypes.c_uint64),
        # Frames whose sequence or stamp does not increase: repeated, out of order, or after a jump of the source's clock.
        ("disordered", ctypes.c_uint64),
        # Changes of the image size or the intrinsics.
        ("resized", ctypes.c_uint64),
        # Frames that took longer than the deadline.
        ("deadline_misses", ctypes.c_uint64),
        # Page faults of the frame loop since its first hundred frames.
        ("page_faults", ctypes.c_uint64),
        # Capture: total number of frames, 0 where unknown. Mapper: keyframes of the map.
        ("total", ctypes.c_uint64),
        # Tracker: state of the last frame, as in `PoseMessage`. Mapper: that of the map, as in `KeyframeHeader`. Capture: largest factor on the grey levels of dim images, 1 where none was dim, 0 where brightening is off.
        ("detail", ctypes.c_uint32),
        # Bytes of `cause` that are used.
        ("cause_bytes", ctypes.c_uint32),
        # Largest resident memory so far.
        ("peak_rss_bytes", ctypes.c_uint64),
        # Histogram of latencies, see `semidense::service::health`.
        ("latency_counts", ctypes.c_uint64 * 48),
        # Histogram of the time spent on a frame.
        ("work_counts", ctypes.c_uint64 * 48),
        # Histogram of the time from sending a frame to picking it up.
        ("wake_counts", ctypes.c_uint64 * 48),
        # Mapper: joint estimates of keyframes that entered the map.
        ("adjustments", ctypes.c_uint64),
        # Mapper: of these, the ones that entered a map with newer keyframes, which moved with them.
        ("adjustments_merged", ctypes.c_uint64),
        # Mapper: joint estimates that were dropped because the map had changed.
        ("adjustments_dropped", ctypes.c_uint64),
        # Mapper: histogram of the CPU time of joint estimates.
        ("adjustment_counts", ctypes.c_uint64 * 48),
        # Mapper: keyframes that were searched for among older ones.
        ("loop_searches", ctypes.c_uint64),
        # Mapper: loops that moved the map.
        ("loops_closed", ctypes.c_uint64),
        # Mapper: loops that the map already agreed with.
        ("loops_held", ctypes.c_uint64),
        # Mapper: epochs that were joined to others.
        ("epochs_joined", ctypes.c_uint64),
        # Mapper: keyframes whose candidates were different places.
        ("loops_refused", ctypes.c_uint64),
        # Mapper: places that were farther off than the map can have drifted.
        ("loops_against_drift", ctypes.c_uint64),
        # Mapper: places that no second pair confirmed.
        ("loops_unconfirmed", ctypes.c_uint64),
        # Mapper: places that contradicted other loops.
        ("loops_inconsistent", ctypes.c_uint64),
        # Active scheduling: 0 other, 1 FIFO, 2 deadline, 3 unknown.
        ("scheduling", ctypes.c_uint32),
        # Priority of FIFO scheduling, else 0.
        ("priority", ctypes.c_uint32),
        # 1 if the memory is locked.
        ("memory_locked", ctypes.c_uint32),
        # Bytes of `warning` that are used.
        ("warning_bytes", ctypes.c_uint32),
        # What the system refused and which limit to raise, UTF-8.
        ("warning", ctypes.c_uint8 * 192),
        # Cause of the state, UTF-8.
        ("cause", ctypes.c_uint8 * 192),
        # Capture: source of its frames as the user named it, UTF-8; long names are truncated.
        ("source", ctypes.c_uint8 * 192),
        # Bytes of `source` that are used.
        ("source_bytes", ctypes.c_uint32),
        # Zero.
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.Health.v6"


class CommandRequest(ctypes.Structure):
    """Request of `mapper/command`."""

    SIZE = 4112
    _fields_ = [
        # The requested keyframe; otherwise 0.
        ("keyframe_id", ctypes.c_uint64),
        # 0 save the map to the file `path`, 1 send keyframe `keyframe_id` on `mapper/earlier_keyframe`, 2 save the map to the folder `path`, 3 switch to the map in the folder `path`, 4 the same, but only localise the camera in it.
        ("kind", ctypes.c_uint32),
        # Bytes of `path` that are used.
        ("path_bytes", ctypes.c_uint32),
        # Absolute path of the file or folder.
        ("path", ctypes.c_uint8 * 4096),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.CommandRequest.v2"


class CommandResponse(ctypes.Structure):
    """Response of `mapper/command`."""

    SIZE = 200
    _fields_ = [
        # 0 done, 1 failed.
        ("status", ctypes.c_uint32),
        # Bytes of `text` that are used.
        ("text_bytes", ctypes.c_uint32),
        # The error, UTF-8.
        ("text", ctypes.c_uint8 * 192),
    ]

    @staticmethod
    def type_name() -> str:
        return "semidense.CommandResponse.v1"


class State(enum.IntEnum):
    """What a pose is worth."""

    INITIALIZING = 0
    TRACKING = 1
    DEGRADED = 2
    LOST = 3


class Reason(enum.Enum):
    """Why a pose is degraded or lost: (code of the state, code of the reason)."""

    BUDGET = (2, 0)
    LOW_OVERLAP = (2, 1)
    HIGH_RESIDUAL = (2, 2)
    GAP = (2, 3)
    TURNING = (2, 4)
    DIVERGED = (3, 0)
    TOO_FEW_INLIERS = (3, 1)
    NO_POINTS = (3, 2)
    UNUSABLE_FRAME = (3, 3)
    MAP_REJECTED = (3, 4)


class MapState(enum.IntEnum):
    """What the mapper thinks of the map."""

    ESTABLISHED = 1
    REJECTED = 2


class StartFrame(enum.IntEnum):
    """What a frame came to while there is no map."""

    BEGUN = 1
    DARK = 2
    OVEREXPOSED = 3
    TEXTURELESS = 4
    UNMATCHED = 5
    STILL = 6
    TURNED = 7
    LITTLE_PARALLAX = 8


class ProcessState(enum.IntEnum):
    """What a process is doing."""

    STARTING = 0
    PREPARING = 1
    READY = 2
    RUNNING = 3
    FINISHED = 4
    FAILED = 5
    STALE = 6


class Scheduling(enum.IntEnum):
    """Scheduling in force of a process."""

    OTHER = 0
    FIFO = 1
    DEADLINE = 2
    UNKNOWN = 3


class Topic(NamedTuple):
    """A data topic: its wake-up event has the same name."""

    path: str
    payload: type
    header: Optional[type]
    subscribers: int
    buffer: int
    borrowed: int
    history: int


TOPICS = {
    "capture/frame": Topic("capture/frame", ctypes.c_uint8, FrameHeader, 6, 4, 4, 0),
    "tracker/pose": Topic("tracker/pose", PoseMessage, None, 9, 900, 2, 1),
    "mapper/keyframe": Topic("mapper/keyframe", DepthPoint, KeyframeHeader, 6, 1, 1, 1),
    "mapper/keyframe_image": Topic("mapper/keyframe_image", ctypes.c_uint8, KeyframeImageHeader, 6, 1, 1, 1),
    "mapper/graph": Topic("mapper/graph", KeyframePoseMessage, GraphHeader, 6, 1, 1, 1),
    "mapper/step": Topic("mapper/step", StepMessage, None, 6, 900, 2, 1),
    "mapper/adjustment": Topic("mapper/adjustment", AdjustmentMessage, None, 9, 64, 2, 1),
    "capture/health": Topic("capture/health", HealthMessage, None, 10, 4, 2, 1),
    "tracker/health": Topic("tracker/health", HealthMessage, None, 10, 4, 2, 1),
    "mapper/health": Topic("mapper/health", HealthMessage, None, 10, 4, 2, 1),
}
COMMAND_TOPIC = "mapper/command"

ROOT_VARIABLE = "SEMIDENSE_ROOT"
SYSTEM_ROOT = "/run/semidense"
PREFIXES = {
    "/run/semidense": "semidense_system_",
    "/tmp/semidense-1000": "semidense_feb30abd_",
    "/run/user/1000/semidense": "semidense_349ed4c3_",
    "/tmp/ä": "semidense_d8af776b_",
}
