"""A finished run: the files in the output folder of `run` or `replay`, as numpy arrays."""

from __future__ import annotations

import json
import os
import re
import warnings
from functools import cached_property
from typing import Any, Dict, Iterator, List, Optional

import numpy as np
import numpy.typing as npt

from ._place import AnyPath
from .errors import BadRun
from .geometry import Floats, Transform
from .ply import read_ply

# Files that identify a folder of results.
FILES = ("summary.json", "trajectory.txt", "keyframes.txt", "map.ply")
# Precedes the poses of each epoch if there are several.
EPOCH_MARK = re.compile(r"# epoch (\d{1,10}):")


class Trajectory:
    """Poses over time: `map_from_camera` of a final trajectory, `world_from_camera` of the online one.

    Iterating yields (seconds, pose).
    """

    def __init__(self, table: Floats, epochs: Optional[npt.NDArray[np.int64]] = None) -> None:
        """Takes rows of timestamp, tx, ty, tz, qx, qy, qz, qw, and the epoch of each."""
        self.times: Floats = table[:, 0]
        """Seconds, of the source's clock."""
        self.positions: Floats = table[:, 1:4]
        """N×3, map units."""
        self.quaternions: Floats = table[:, 4:8]
        """N×4: x, y, z, w."""
        self.epochs = np.zeros(len(table), dtype=np.int64) if epochs is None else epochs
        """N: poses of different epochs have different origins and units of length; all 0 if the file marks no epochs."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.times)

    def __getitem__(self, index: int) -> Transform:
        """The pose at an index."""
        return Transform(self.quaternions[index], self.positions[index])

    def __iter__(self) -> Iterator[Any]:
        """Iterates over (seconds, pose)."""
        return ((float(self.times[index]), self[index]) for index in range(len(self)))

    def matrices(self) -> Floats:
        """The poses as N×4×4 matrices."""
        return np.array([self[index].matrix for index in range(len(self))]).reshape(-1, 4, 4)

    def __repr__(self) -> str:
        """A short description."""
        span = float(self.times[-1] - self.times[0]) if len(self) else 0.0
        return f"Trajectory({len(self)} poses over {span:.2f} s)"


class RunKeyframe:
    """A keyframe of a finished run."""

    def __init__(self, run: Run, time: float, map_from_keyframe: Transform, numbers: List[str]) -> None:
        """Takes the values of a line in keyframes.txt."""
        self._run = run
        self.time = time
        """Seconds, of the source's clock."""
        self.map_from_keyframe = map_from_keyframe
        """Final pose; the scale is the keyframe's unit in map units."""
        self.keyframe_id, self.sequence, self.epoch, self.num_points = (int(number) for number in numbers[:4])
        self.state = numbers[4] if len(numbers) > 4 else ""
        """State of the map, as judged by the mapper."""

    @property
    def world_from_keyframe(self) -> Transform:
        """Deprecated name of `map_from_keyframe`."""
        warnings.warn("world_from_keyframe is now map_from_keyframe", DeprecationWarning, stacklevel=2)
        return self.map_from_keyframe

    @property
    def points(self) -> npt.NDArray[np.void]:
        """Its points in map.ply, in map units; empty if the file is missing or does not name keyframes."""
        points = self._run.map_points
        if points is None:
            return np.empty(0, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
        if "keyframe" not in (points.dtype.names or ()):
            return points[:0]
        mine: npt.NDArray[np.void] = points[points["keyframe"] == self.keyframe_id]
        return mine

    def depths(self) -> Floats:
        """Depth of each of its `points` along its optical axis, map units."""
        points = self.points
        positions = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)
        rigid = Transform(self.map_from_keyframe.quaternion, self.map_from_keyframe.translation)
        depths: Floats = (rigid.inverse() @ positions)[:, 2]
        return depths

    def __repr__(self) -> str:
        """A short description."""
        return f"RunKeyframe(id={self.keyframe_id}, {self.num_points} points, {self.state})"


class Run:
    """The results in a folder. A missing file gives None or an empty result; a damaged one raises `BadRun`."""

    def __init__(self, folder: AnyPath) -> None:
        """Checks that it is a folder of results; files are read on first use."""
        self.folder = os.path.abspath(os.fspath(folder))
        if not os.path.isdir(self.folder):
            raise BadRun(f"{self.folder}: no such folder; `semidense run --output DIR` creates one")
        if not any(os.path.exists(self._path(name)) for name in FILES):
            raise BadRun(f"{self.folder}: no results of semidense in it (none of {', '.join(FILES)})")

    def _path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    def _text(self, name: str) -> Optional[List[str]]:
        try:
            with open(self._path(name), encoding="utf-8") as file:
                return [line for line in file if line.strip()]
        except FileNotFoundError:
            return None
        except UnicodeDecodeError as error:
            raise BadRun(f"{self._path(name)}: {error}") from None

    def _lines(self, name: str) -> Optional[List[List[str]]]:
        text = self._text(name)
        return None if text is None else [line.split() for line in text if not line.startswith("#")]

    def _trajectory(self, name: str) -> Optional[Trajectory]:
        lines = self._lines(name)
        if lines is None:
            return None
        rows = np.empty((len(lines), 8))
        for index, line in enumerate(lines):
            try:
                rows[index] = [float(number) for number in line[:8]]
            except ValueError:
                raise BadRun(
                    f"{self._path(name)}: pose {index + 1} is not `timestamp tx ty tz qx qy qz qw`: {' '.join(line)[:80]}"
                ) from None
        return Trajectory(rows, self._epochs(name))

    def _epochs(self, name: str) -> npt.NDArray[np.int64]:
        epoch, epochs = 0, []
        for line in self._text(name) or []:
            mark = EPOCH_MARK.match(line)
            if mark is not None:
                epoch = int(mark.group(1))
            elif not line.startswith("#"):
                epochs.append(epoch)
        return np.array(epochs, dtype=np.int64)

    @cached_property
    def summary(self) -> Dict[str, Any]:
        """Every figure of the run (docs/results.md); empty if the file is missing."""
        try:
            with open(self._path("summary.json"), encoding="utf-8") as file:
                summary = json.load(file)
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise BadRun(f"{self._path('summary.json')}: {error}") from None
        if not isinstance(summary, dict):
            raise BadRun(f"{self._path('summary.json')}: not an object of figures")
        return summary

    @cached_property
    def trajectory(self) -> Optional[Trajectory]:
        """Final pose of every tracked frame but those on rejected keyframes, `map_from_camera`."""
        return self._trajectory("trajectory.txt")

    @cached_property
    def trajectory_online(self) -> Optional[Trajectory]:
        """The poses as published, `world_from_camera`."""
        return self._trajectory("trajectory_online.txt")

    @cached_property
    def keyframes(self) -> List[RunKeyframe]:
        """All keyframes with their final poses."""
        keyframes = []
        for index, line in enumerate(self._lines("keyframes.txt") or []):
            try:
                numbers = [float(number) for number in line[:9]]
                place = Transform(numbers[4:8], numbers[1:4], numbers[8])
                keyframes.append(RunKeyframe(self, numbers[0], place, line[9:]))
            except (ValueError, IndexError):
                raise BadRun(
                    f"{self._path('keyframes.txt')}: keyframe {index + 1} cannot be read: {' '.join(line)[:80]}"
                ) from None
        return keyframes

    @cached_property
    def map_points(self) -> Optional[npt.NDArray[np.void]]:
        """The map as a structured array with the properties of map.ply: x, y, z in map units and more."""
        return read_ply(self._path("map.ply"))

    @cached_property
    def sparse_points(self) -> Optional[npt.NDArray[np.void]]:
        """The points of the joint estimation of keyframes."""
        return read_ply(self._path("points.ply"))

    def positions(self) -> npt.NDArray[np.float32]:
        """N×3, the points of the map in map units; empty without map.ply."""
        points = self.map_points
        if points is None:
            return np.empty((0, 3), dtype=np.float32)
        return np.column_stack([points[axis] for axis in "xyz"])

    def __repr__(self) -> str:
        """The folder."""
        return f"Run({self.folder!r})"


def load(folder: AnyPath) -> Run:
    """Loads the results of a finished run, as written by `semidense run --output FOLDER` or `replay`."""
    return Run(folder)
