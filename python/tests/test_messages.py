"""The table of messages, and invalid messages."""

from __future__ import annotations

import ctypes
import json
import random
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest

from semidense import Reason, State, Transform, _wire
from semidense.geometry import symmetric
from semidense.messages import BrokenMessage, Frame, Graph, Health, Keyframe, Pose

MESSAGES: List[Any] = [kind for kind in vars(_wire).values() if hasattr(kind, "SIZE")]
# Generated from the Rust definitions, like the table itself (tests/repository/wire_table.rs).
OFFSETS: Dict[str, Dict[str, int]] = json.loads((Path(__file__).parent / "offsets.json").read_text())


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: str(kind.__name__))
def test_layouts_are_those_of_rust(kind: Any) -> None:
    assert ctypes.sizeof(kind) == kind.SIZE
    assert {name: getattr(kind, name).offset for name, *_ in kind._fields_} == OFFSETS[kind.__name__]
    assert kind.type_name().startswith("semidense.")


def test_every_reason_belongs_to_a_state() -> None:
    assert {State(reason.value[0]) for reason in Reason} == {State.DEGRADED, State.LOST}


def pose(**fields: Any) -> Pose:
    message = _wire.PoseMessage(state=1)
    for name in ("world_from_camera", "map_from_camera", "keyframe_from_camera"):
        getattr(message, name)[3] = 1.0
    for name, value in fields.items():
        setattr(message, name, value)
    return Pose(message)


def test_a_pose_is_checked() -> None:
    assert pose().keyframe_id == 0 and pose(keyframe_id=2**64 - 1).keyframe_id is None
    assert pose(state=2, reason=4).reason is Reason.TURNING
    for broken in ({"state": 9}, {"state": 2, "reason": 99}):
        with pytest.raises(BrokenMessage):
            pose(**broken)
    infinite = (ctypes.c_double * 21)(float("inf"))
    with pytest.raises(BrokenMessage):
        pose(covariance=infinite)
    with pytest.raises(BrokenMessage):
        pose(map_covariance=(ctypes.c_double * 21)(-1.0))
    with pytest.raises(BrokenMessage):
        pose(world_from_camera=(ctypes.c_double * 7)(0, 0, 0, 2))


def test_hostile_bytes_are_broken_messages() -> None:
    generator = random.Random(7)
    points = np.zeros(3, dtype=np.dtype(_wire.DepthPoint))
    pixels = np.zeros(12, dtype=np.uint8)
    refused = 0
    for _ in range(300):

        def hostile(kind: Any) -> Any:
            return kind.from_buffer_copy(generator.randbytes(ctypes.sizeof(kind)))

        makes = (
            lambda: Pose(hostile(_wire.PoseMessage)),
            lambda: Frame(hostile(_wire.FrameHeader), pixels),
            lambda: Keyframe(hostile(_wire.KeyframeHeader), points, hostile(_wire.KeyframeImageHeader), pixels),
            lambda: Graph(hostile(_wire.GraphHeader), [hostile(_wire.KeyframePoseMessage)]),
            lambda: Health("mapper", hostile(_wire.HealthMessage)),
        )
        for make in makes:
            try:
                make()
            except BrokenMessage:
                refused += 1
    assert refused > 1400


def test_transforms_are_a_group() -> None:
    generator = np.random.default_rng(3)

    def some() -> Transform:
        quaternion = generator.normal(size=4)
        return Transform(quaternion / np.linalg.norm(quaternion), generator.normal(size=3), generator.uniform(0.5, 2))

    a, b = some(), some()
    assert np.allclose((a @ b).matrix, a.matrix @ b.matrix)
    assert np.allclose((a @ a.inverse()).matrix, np.eye(4))
    points = generator.normal(size=(5, 3))
    assert np.allclose(a @ points, (np.c_[points, np.ones(5)] @ a.matrix.T)[:, :3])
    with pytest.raises(ValueError):
        a @ np.zeros(4)


def test_the_triangle_fills_a_matrix() -> None:
    matrix = symmetric(range(21), 6)
    assert np.array_equal(matrix, matrix.T) and list(matrix[0]) == [0, 1, 2, 3, 4, 5] and matrix[1, 1] == 6


def test_a_keyframe_at_infinity_has_no_depth() -> None:
    header = _wire.KeyframeHeader(width=4, height=3, map_state=1)
    header.intrinsics[:] = (2.0, 2.0, 1.5, 1.0)
    for name in ("world_from_keyframe", "map_from_keyframe"):
        getattr(header, name)[3] = getattr(header, name)[7] = 1.0
    image = _wire.KeyframeImageHeader(width=4, height=3, stride=4)
    points = np.zeros(2, dtype=np.dtype(_wire.DepthPoint))
    points["u"], points["inverse_depth"] = (1, 2), (0.0, 0.5)
    with np.errstate(all="raise"):
        keyframe = Keyframe(header, points, image, np.zeros(12, dtype=np.uint8))
        assert list(keyframe.has_depth) == [False, True]
        assert np.nansum(keyframe.depth()) == 2.0 and len(keyframe.points_in_map()) == 1
    points["u"] = 4
    with pytest.raises(BrokenMessage):
        keyframe.copy()
