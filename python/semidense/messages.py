"""The messages in shared memory: poses, frames, keyframes, the graph, health.

Each is checked before it is returned: an invalid message is counted (`Reader.refused`) and skipped.
"""

from __future__ import annotations

import ctypes
import time
from functools import cached_property
from typing import Any, Dict, Iterator, Optional, Tuple

import numpy as np
import numpy.typing as npt

from . import _wire
from ._wire import MapState, ProcessState, Reason, Scheduling, State
from .geometry import Floats, Intrinsics, Transform, rigid, symmetric

NO_KEYFRAME = 2**64 - 1
Points = npt.NDArray[np.void]
Image = npt.NDArray[np.uint8]

_DIAGONAL = (0, 6, 11, 15, 18, 20)


class BrokenMessage(ValueError):
    """A message with invalid content."""


class Velocity:
    """Velocity of the camera at the stamp of the frame, in its own axes (x right, y down, z forward)."""

    __slots__ = ("linear", "angular", "covariance")

    def __init__(self, linear: Floats, angular: Floats, covariance: Floats) -> None:
        """World units per second, radians per second, and the 6×6 covariance of both."""
        self.linear, self.angular, self.covariance = linear, angular, covariance

    def __repr__(self) -> str:
        """Both, abbreviated."""
        return f"Velocity(linear={np.round(self.linear, 4)}, angular={np.round(self.angular, 4)})"


class Pose:
    """The pose of one frame. Every frame has one, even when the camera is lost: see `state` and `is_tracked`."""

    def __init__(self, message: _wire.PoseMessage) -> None:
        """Takes a message, which is kept; raises `BrokenMessage`."""
        self._message = message
        self.sequence: int = message.sequence
        """Number of the frame at its source; a gap is a missing frame."""
        self.capture_nanos: int = message.capture_nanos
        """Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock."""
        self.realtime_nanos: int = message.realtime_nanos
        """The same instant since 1970 (`time.time_ns()`), 0 if unknown."""
        self.published_nanos: int = message.published_nanos
        """CLOCK_MONOTONIC (`time.monotonic_ns()`) when it was published."""
        self.latency_nanos: int = message.latency_nanos
        """Time from the frame to the publication of its pose."""
        self.epoch: int = message.epoch
        """Epoch of the map."""
        self.map_revision: int = message.map_revision
        """Number of corrections of the map: `map_from_camera` may jump when it increases."""
        keyframe_id: int = message.keyframe_id
        self.keyframe_id: Optional[int] = None if keyframe_id == NO_KEYFRAME else keyframe_id
        """The keyframe it was tracked on; None before the first."""
        try:
            self.state = State(message.state)
            claims_reason = self.state in (State.DEGRADED, State.LOST)
            self.reason: Optional[Reason] = Reason((message.state, message.reason)) if claims_reason else None
        except ValueError as error:
            raise BrokenMessage(str(error)) from None
        self._check()

    def _check(self) -> None:
        message = self._message
        for field in ("covariance", "map_covariance", "brightness", "velocity_covariance"):
            if not np.isfinite(np.ctypeslib.as_array(getattr(message, field))).all():
                raise BrokenMessage(f"{field} is not finite")
        if any(message.map_covariance[entry] < 0.0 for entry in _DIAGONAL):
            raise BrokenMessage("a variance of map_covariance is negative")
        transforms = (self.world_from_camera, self.map_from_camera, self.keyframe_from_camera)
        if not all(transform.is_valid() for transform in transforms):
            raise BrokenMessage("a transform is invalid")

    @property
    def is_tracked(self) -> bool:
        """Whether the pose is claimed: tracking or degraded."""
        return self.state in (State.TRACKING, State.DEGRADED)

    @property
    def capture_secs(self) -> float:
        """`capture_nanos` in seconds, the time stamp of `trajectory.txt`."""
        return self.capture_nanos / 1e9

    @property
    def age_secs(self) -> float:
        """Seconds since it was published."""
        return (time.monotonic_ns() - self.published_nanos) / 1e9

    @cached_property
    def world_from_camera(self) -> Transform:
        """Odometry: never jumps within an epoch, but drifts."""
        return rigid(self._message.world_from_camera)

    @cached_property
    def map_from_camera(self) -> Transform:
        """The best estimate in the map; jumps when the map is corrected."""
        return rigid(self._message.map_from_camera)

    @cached_property
    def keyframe_from_camera(self) -> Transform:
        """Relative to the keyframe, in keyframe units."""
        return rigid(self._message.keyframe_from_camera)

    @cached_property
    def covariance(self) -> Floats:
        """6×6, of the left increment (translation, rotation) of camera_from_keyframe, keyframe units and radians."""
        return symmetric(self._message.covariance, 6)

    @cached_property
    def map_covariance(self) -> Floats:
        """6×6, of the left increment (translation, rotation) of `map_from_camera`, map units and radians."""
        return symmetric(self._message.map_covariance, 6)

    @cached_property
    def velocity(self) -> Optional[Velocity]:
        """The velocity of the camera; None if this frame or the previous one has no pose."""
        message = self._message
        if not message.has_velocity:
            return None
        linear = np.array(message.linear_velocity)
        return Velocity(linear, np.array(message.angular_velocity), symmetric(message.velocity_covariance, 6))

    @property
    def brightness(self) -> Tuple[float, float]:
        """a, b of `I_camera ≈ eᵃ I_keyframe + b`, grey levels."""
        a, b = self._message.brightness
        return float(a), float(b)

    @property
    def quality(self) -> Dict[str, float]:
        """Figures of the alignment: in_view_ratio, inlier_ratio, residual_rmse and more."""
        names = (
            "in_view_ratio", "inlier_ratio", "whitened_rmse", "residual_rmse", "mean_squared_flow",
            "displacement_px", "iterations", "finest_level", "points",
        )  # fmt: skip
        return {name: getattr(self._message, name) for name in names}

    def line(self, in_map: bool = False) -> str:
        """One line: frame, seconds, position and quaternion in the world or in the map, state and reason."""
        state = self.state.name.lower() + (f" ({self.reason.name.lower()})" if self.reason else "")
        place = self.map_from_camera if in_map else self.world_from_camera
        t, q = place.translation, place.quaternion
        position = " ".join(f"{value:9.4f}" for value in t)
        rotation = " ".join(f"{value:7.4f}" for value in q)
        return f"{self.sequence:7d} {self.capture_secs:14.6f} {position}  {rotation}  {state}"

    def __str__(self) -> str:
        """`line()`."""
        return self.line()

    def __repr__(self) -> str:
        """A short description."""
        return f"Pose(sequence={self.sequence}, state={self.state.name}, world_from_camera={self.world_from_camera})"


def _intrinsics(header: Any) -> Intrinsics:
    fx, fy, cx, cy = (float(value) for value in header.intrinsics)
    intrinsics = Intrinsics(fx, fy, cx, cy, header.width, header.height)
    if not intrinsics.is_valid():
        raise BrokenMessage("invalid image size or intrinsics")
    return intrinsics


class Frame:
    """A rectified grey image of the camera. `image` stays in shared memory, read-only, for as long as it is referenced."""

    def __init__(self, header: _wire.FrameHeader, pixels: Image) -> None:
        """Takes a header and its pixels; raises `BrokenMessage`."""
        self.intrinsics = _intrinsics(header)
        if header.stride != header.width or pixels.size != header.width * header.height:
            raise BrokenMessage(f"{pixels.size} pixels, not {header.width} × {header.height}")
        self.image: Image = pixels.reshape(header.height, header.width)
        """Height × width, uint8."""
        self.sequence: int = header.sequence
        """Number of the frame at its source, as in its pose."""
        self.capture_nanos: int = header.capture_nanos
        """Middle of the exposure, nanoseconds."""
        self.realtime_nanos: int = header.realtime_nanos
        """The same instant since 1970, 0 if unknown."""
        self.exposure_nanos: int = header.exposure_nanos
        """Exposure time, 0 if unknown."""
        self.gain: float = header.gain
        """Sensor gain, 0 if unknown."""
        self._header = header

    def copy(self) -> Frame:
        """A copy in separate memory, which may be kept indefinitely."""
        return Frame(self._header, self.image.ravel().copy())

    def __repr__(self) -> str:
        """A short description."""
        return f"Frame(sequence={self.sequence}, {self.intrinsics.width}×{self.intrinsics.height})"


class Keyframe:
    """A frame with depth: `points` and `image`, read-only, in separate memory."""

    def __init__(
        self, header: _wire.KeyframeHeader, points: Points, image_header: _wire.KeyframeImageHeader, pixels: Image
    ) -> None:
        """Takes the messages of its depth and its image; raises `BrokenMessage`."""
        self.intrinsics = _intrinsics(header)
        sizes = {(h.width, h.height) for h in (header, image_header)} | {(image_header.stride, header.height)}
        if len(sizes) != 1 or pixels.size != header.width * header.height:
            raise BrokenMessage("image and depth have different sizes")
        self.points: Points = points
        """Structured array: u, v (pixels), inverse_depth (1/keyframe units), variance (of inverse_depth), intensity."""
        self.image: Image = pixels.reshape(header.height, header.width)
        """Height × width, uint8."""
        self.keyframe_id: int = header.keyframe_id
        """Its id, as in poses and the graph."""
        self.revision: int = header.revision
        """Incremented with every change of the map: the same keyframe is sent again with refined depth."""
        self.sequence: int = header.sequence
        """Number of its frame."""
        self.capture_nanos: int = header.capture_nanos
        """Stamp of its frame, nanoseconds."""
        self.epoch: int = header.epoch
        """Epoch of the map."""
        self.map_revision: int = header.map_revision
        """Number of corrections of the map by then."""
        self.world_from_keyframe = rigid(header.world_from_keyframe)
        """Pose in the odometry world, with its unit as the scale."""
        self.map_from_keyframe = rigid(header.map_from_keyframe)
        """Pose in the map, with its unit as the scale."""
        try:
            self.map_state = MapState(header.map_state)
            """Whether the map is established."""
        except ValueError as error:
            raise BrokenMessage(str(error)) from None
        self._headers = (header, image_header)
        self._check()

    def _check(self) -> None:
        points, (width, height) = self.points, self.intrinsics.size
        if len(points) > _wire.MAX_KEYFRAME_POINTS:
            raise BrokenMessage(f"{len(points)} points, at most {_wire.MAX_KEYFRAME_POINTS}")
        inside = (points["u"] < width).all() and (points["v"] < height).all()
        fields = ("inverse_depth", "variance", "intensity")
        if not inside or not all(np.isfinite(points[field]).all() for field in fields):
            raise BrokenMessage("a point lies outside the image or is not finite")
        if not (self.world_from_keyframe.is_valid() and self.map_from_keyframe.is_valid()):
            raise BrokenMessage("a transform is invalid")

    @cached_property
    def place_covariance(self) -> Floats:
        """7×7 covariance of the left increment (translation, rotation, ln scale) of `map_from_keyframe`."""
        return symmetric(self._headers[0].place_covariance, 7)

    @cached_property
    def mode_covariance(self) -> Floats:
        """3×3 covariance of the relative errors common to all inverse depths, per unit of X, of Y and of ln d."""
        return symmetric(self._headers[0].mode_covariance, 3)

    @property
    def has_depth(self) -> npt.NDArray[np.bool_]:
        """Whether the depth of each point is finite: an inverse depth of 0 is infinitely far."""
        mask: npt.NDArray[np.bool_] = self.points["inverse_depth"] > 0.0
        return mask

    def depth(self) -> npt.NDArray[np.float32]:
        """Height × width, z in keyframe units, NaN where unknown."""
        return self._picture(1.0 / self.points["inverse_depth"][self.has_depth])

    def depth_std_dev(self) -> npt.NDArray[np.float32]:
        """Height × width, the standard deviation of `depth()` to first order, NaN where unknown."""
        points = self.points[self.has_depth]
        return self._picture(np.sqrt(points["variance"]) / points["inverse_depth"] ** 2)

    def _picture(self, values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        picture = np.full(self.image.shape, np.nan, dtype=np.float32)
        points = self.points[self.has_depth]
        picture[points["v"], points["u"]] = values
        return picture

    def points_in_keyframe(self) -> Floats:
        """N×3, the points with finite depth in the keyframe's axes, keyframe units."""
        points, k = self.points[self.has_depth], self.intrinsics
        z = 1.0 / points["inverse_depth"].astype(np.float64)
        return np.column_stack(((points["u"] - k.cx) / k.fx * z, (points["v"] - k.cy) / k.fy * z, z))

    def points_in_map(self) -> Floats:
        """N×3, the points with finite depth in the map, map units."""
        return self.map_from_keyframe @ self.points_in_keyframe()

    def points_in_world(self) -> Floats:
        """N×3, the points with finite depth in the odometry world, world units."""
        return self.world_from_keyframe @ self.points_in_keyframe()

    def copy(self) -> Keyframe:
        """A copy with writable arrays."""
        header, image_header = self._headers
        return Keyframe(header, self.points.copy(), image_header, self.image.ravel().copy())

    def __repr__(self) -> str:
        """A short description."""
        return f"Keyframe(id={self.keyframe_id}, revision={self.revision}, {len(self.points)} points)"


class KeyframePose:
    """The pose of a keyframe in the map."""

    __slots__ = ("keyframe_id", "revision", "map_from_keyframe")

    def __init__(self, keyframe_id: int, revision: int, map_from_keyframe: Transform) -> None:
        """Its id, the revision of its depth, and its pose with its unit as the scale."""
        self.keyframe_id, self.revision, self.map_from_keyframe = keyframe_id, revision, map_from_keyframe

    def __repr__(self) -> str:
        """All values."""
        return f"KeyframePose(id={self.keyframe_id}, {self.map_from_keyframe})"


class Graph:
    """The poses of all keyframes in the map, sent whenever they change."""

    def __init__(self, header: _wire.GraphHeader, messages: Any) -> None:
        """Takes a header and an array of `KeyframePoseMessage`; raises `BrokenMessage`."""
        self.revision: int = header.revision
        """Newest revision of a keyframe in the graph."""
        self.map_revision: int = header.map_revision
        """Number of corrections of the map."""
        self.epoch: int = header.epoch
        """Epoch of the map."""
        self.keyframes = [KeyframePose(m.keyframe_id, m.revision, rigid(m.map_from_keyframe)) for m in messages]
        """The pose of each keyframe."""
        if not all(keyframe.map_from_keyframe.is_valid() for keyframe in self.keyframes):
            raise BrokenMessage("a transform is invalid")

    def positions(self) -> Floats:
        """N×3, the positions of the keyframes in the map."""
        return np.array([k.map_from_keyframe.translation for k in self.keyframes]).reshape(-1, 3)

    def __iter__(self) -> Iterator[KeyframePose]:
        """Iterates over all keyframes."""
        return iter(self.keyframes)

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.keyframes)

    def __repr__(self) -> str:
        """A short description."""
        return f"Graph(map_revision={self.map_revision}, {len(self)} keyframes)"


def _text(bytes_: Any, length: int) -> str:
    text = bytes(bytes_)[: min(length, len(bytes_))].decode("utf-8", "replace")
    return "".join(" " if ord(letter) < 32 or 127 <= ord(letter) < 160 else letter for letter in text)


class Health:
    """The health report of a process, once a second and on every change."""

    def __init__(self, process: str, message: _wire.HealthMessage) -> None:
        """`process` is capture, tracker or mapper; raises `BrokenMessage`."""
        self.process = process
        """capture, tracker or mapper."""
        try:
            self.state = ProcessState(message.state)
            """State of the process."""
            self.scheduling = Scheduling(message.scheduling)
            """Active scheduling."""
        except ValueError as error:
            raise BrokenMessage(str(error)) from None
        self.message = message
        """The original message, with all counters."""
        self.cause = _text(message.cause, message.cause_bytes)
        """The reason for the state."""
        self.warning = _text(message.warning, message.warning_bytes)
        """What the system refused, and the limit to raise; else empty."""
        self.source = _text(message.source, message.source_bytes)
        """Capture: where its frames come from."""
        self.published_nanos: int = message.published_nanos
        """CLOCK_MONOTONIC when it was published."""
        self.process_id: int = message.process_id
        """Its process id."""
        self.frames: int = message.frames
        """Number of frames sent, tracked or mapped."""
        self.rate_hz: float = message.rate_hz
        """The same per second; NaN during the first second."""
        self.dropped: int = message.dropped
        """Number of late frames, which were not processed."""

    def latency_counts(self) -> npt.NDArray[np.uint64]:
        """The histogram of latencies; its buckets end at `semidense.BUCKET_ENDS_MS`."""
        return np.array(self.message.latency_counts, dtype=np.uint64)

    def latency_ms(self, share: float) -> Optional[float]:
        """The latency not exceeded by `share` (0 to 1) of the frames, rounded to its bucket; None without frames."""
        counts = self.latency_counts().astype(np.float64)
        if not counts.any():
            return None
        index = int(np.searchsorted(np.cumsum(counts), share * counts.sum()))
        return _wire.BUCKET_ENDS_MS[min(index, len(counts) - 1)]

    def __repr__(self) -> str:
        """A one-line description."""
        return f"Health({self.process}: {self.state.name}, {self.frames} frames, {self.rate_hz:.1f} Hz)"


def copy_of(kind: Any, address: int) -> Any:
    """A copy of the structure at `address`."""
    return kind.from_buffer_copy((ctypes.c_char * ctypes.sizeof(kind)).from_address(address))
