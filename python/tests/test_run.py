"""Finished runs: complete, partial and damaged."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY, SMALL_CAMERA, binary

import semidense
from semidense.ply import read_ply


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "output"
    settings = [word for setting in SMALL_CAMERA for word in ("--set", f"simulator.{setting}")]
    command = [binary(), "replay", "sim", "--output", str(folder), *settings]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=300)
    return folder


def test_a_run_is_loaded_whole(output: Path) -> None:
    run = semidense.load(output)
    assert run.trajectory is not None and run.trajectory_online is not None and run.map_points is not None
    assert len(run.trajectory) == run.summary["frames_tracked"]
    assert run.trajectory.matrices().shape == (len(run.trajectory), 4, 4)
    assert (np.diff(run.trajectory.times) > 0).all()
    assert len(run.keyframes) == run.summary["keyframes"]
    assert run.positions().shape == (len(run.map_points), 3) and len(run.map_points) > 1000
    if "keyframe" in (run.map_points.dtype.names or ()):
        fullest = max(run.keyframes, key=lambda keyframe: len(keyframe.points))
        depths = fullest.depths()
        # A few points refined from other keyframes may have moved behind it.
        assert len(depths) > 100 and (depths > 0).mean() > 0.99


def test_files_that_are_missing_give_nothing(output: Path, tmp_path: Path) -> None:
    (tmp_path / "keyframes.txt").write_bytes((output / "keyframes.txt").read_bytes())
    run = semidense.load(tmp_path)
    assert run.trajectory is None and run.map_points is None and run.summary == {}
    assert len(run.positions()) == 0 and len(run.keyframes) > 0
    assert len(run.keyframes[0].points) == 0 and len(run.keyframes[0].depths()) == 0


def test_what_is_no_run_is_said(tmp_path: Path) -> None:
    with pytest.raises(semidense.BadRun, match="no such folder"):
        semidense.load(tmp_path / "nowhere")
    with pytest.raises(semidense.BadRun, match="no results"):
        semidense.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "attribute"),
    [
        ("trajectory.txt", "0 1 2\n", "trajectory"),
        ("trajectory.txt", "0 a b c d e f g\n", "trajectory"),
        ("keyframes.txt", "0 0 0 0 0 0 0 1 1 x\n", "keyframes"),
        ("summary.json", "{", "summary"),
        ("summary.json", "[]", "summary"),
        ("map.ply", "hello", "map_points"),
        ("map.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n", "map_points"),
        (
            "map.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
            "property float z\nend_header\nshort",
            "map_points",
        ),
    ],
)
def test_broken_files_are_named(tmp_path: Path, name: str, text: str, attribute: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(semidense.BadRun, match=name):
        getattr(semidense.load(tmp_path), attribute)


EPOCHS = """# map_from_camera of every tracked frame
# timestamp tx ty tz qx qy qz qw
# epoch 0: a separate origin and unit of length
1 0 0 0 0 0 0 1
2 1 0 0 0 0 0 1
# epoch 2: a separate origin and unit of length
3 9 0 0 0 0 0 1
"""


def test_poses_know_their_epoch(tmp_path: Path) -> None:
    (tmp_path / "trajectory.txt").write_text(EPOCHS)
    # A single epoch is not marked.
    unmarked = "".join(line + "\n" for line in EPOCHS.splitlines() if "epoch" not in line)
    (tmp_path / "trajectory_online.txt").write_text(unmarked)
    run = semidense.load(tmp_path)
    assert run.trajectory is not None and run.trajectory_online is not None
    assert run.trajectory.epochs.tolist() == [0, 0, 2] and len(run.trajectory) == 3
    assert run.trajectory_online.epochs.tolist() == [0, 0, 0]


def test_the_old_name_of_a_keyframes_pose_is_deprecated(tmp_path: Path) -> None:
    (tmp_path / "keyframes.txt").write_text("1 2 3 4 0 0 0 1 0.5 7 9 0 100 Established\n")
    (keyframe,) = semidense.load(tmp_path).keyframes
    assert keyframe.map_from_keyframe.translation.tolist() == [2.0, 3.0, 4.0]
    with pytest.warns(DeprecationWarning, match="map_from_keyframe"):
        assert keyframe.world_from_keyframe is keyframe.map_from_keyframe


def test_the_example_leaves_a_gap_between_epochs() -> None:
    example = runpy.run_path(str(REPOSITORY / "python" / "examples" / "trajectory.py"))
    path = example["with_gaps"](np.arange(9.0).reshape(3, 3), [0, 0, 2])
    assert np.isnan(path).all(axis=1).tolist() == [False, False, True, False]
    assert len(example["with_gaps"](np.zeros((0, 3)), [])) == 0


def test_ply_in_text_and_in_both_orders(tmp_path: Path) -> None:
    head = "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty double z\n"
    head += "property uchar red\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [(1.0, 2.0, 3.0, 4), (5.0, 6.0, 7.0, 8)]
    path = tmp_path / "p.ply"
    path.write_text(head.format("ascii") + "1 2 3 4\n5 6 7 8\n")
    text = read_ply(str(path))
    assert text is not None and text.tolist() == rows
    for form, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        kind = np.dtype([("x", order + "f4"), ("y", order + "f4"), ("z", order + "f8"), ("red", "u1")])
        path.write_bytes(head.format(form).encode() + np.array(rows, dtype=kind).tobytes())
        points = read_ply(str(path))
        assert points is not None and points.tolist() == rows


def test_the_example_draws_the_trajectory(output: Path, tmp_path: Path) -> None:
    picture = tmp_path / "trajectory.png"
    script = REPOSITORY / "python" / "examples" / "trajectory.py"
    subprocess.run([sys.executable, str(script), str(output), "--save", str(picture)], check=True, timeout=120)
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 5000
