"""Draws the trajectory of a finished run, or of a running one as it grows.

python trajectory.py                     # live, until the run ends or the window is closed
python trajectory.py output/latest       # a finished run
python trajectory.py … --save path.png   # to a file (live: after --seconds)
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any, List

import matplotlib
import numpy as np

import semidense

# Between two updates of a live trajectory.
REDRAW_SECS = 0.2


def draw(axes: Any, positions: Any, keyframes: Any, title: str) -> None:
    """Draws the trajectory from above: x right, z forward."""
    axes.clear()
    axes.plot(positions[:, 0], positions[:, 2], lw=1.5, label="camera")
    if len(keyframes):
        axes.plot(keyframes[:, 0], keyframes[:, 2], "o", ms=5, mfc="none", label="keyframes")
    axes.set_xlabel("x, map units")
    axes.set_ylabel("z (forward), map units")
    axes.set_aspect("equal", "datalim")
    axes.grid(True, alpha=0.3)
    axes.legend(loc="best")
    axes.set_title(title)


def with_gaps(positions: Any, epochs: Any) -> Any:
    """Inserts a row of NaN where another epoch begins: its origin and unit differ, so no line connects the two."""
    begins = np.flatnonzero(np.diff(epochs)) + 1
    return np.insert(positions, begins, np.nan, axis=0)


def finished(folder: str, axes: Any) -> None:
    """Draws a finished run."""
    run = semidense.load(folder)
    if run.trajectory is None:
        raise semidense.BadRun(f"{run.folder}: no trajectory.txt")
    keyframes = np.array([k.map_from_keyframe.translation for k in run.keyframes]).reshape(-1, 3)
    positions = with_gaps(run.trajectory.positions, run.trajectory.epochs)
    draw(axes, positions, keyframes, f"{len(run.trajectory)} poses")


def live(arguments: argparse.Namespace, axes: Any, plot: Any) -> None:
    """Draws a run as it grows."""
    positions: List[Any] = []
    epochs: List[int] = []
    begun = drawn = time.monotonic()
    for pose in semidense.poses(arguments.instance, timeout=arguments.timeout):
        if pose.is_tracked:
            positions.append(pose.map_from_camera.translation)
            epochs.append(pose.epoch)
        now = time.monotonic()
        if arguments.seconds is not None and now - begun > arguments.seconds:
            break
        if positions and arguments.save is None and now - drawn > REDRAW_SECS:
            drawn = now
            path = with_gaps(np.array(positions), epochs)
            draw(axes, path, [], f"{len(positions)} poses, {pose.state.name.lower()}")
            plot.pause(0.001)
            if not plot.fignum_exists(axes.figure.number):
                return
    draw(axes, with_gaps(np.array(positions).reshape(-1, 3), epochs), [], f"{len(positions)} poses")


def main() -> None:
    """Parses the arguments and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", help="output folder of a finished run; live without")
    parser.add_argument("--instance", default="semidense")
    parser.add_argument("--timeout", type=float, help="seconds to wait for the instance [forever]")
    parser.add_argument("--seconds", type=float, help="live: end after so long")
    parser.add_argument("--save", metavar="FILE", help="write a picture instead of opening a window")
    arguments = parser.parse_args()
    if arguments.save is not None:
        matplotlib.use("Agg")
    from matplotlib import pyplot as plot

    figure, axes = plot.subplots(figsize=(7, 6), layout="constrained")
    try:
        if arguments.run is not None:
            finished(arguments.run, axes)
        else:
            live(arguments, axes, plot)
    except semidense.SemidenseError as error:
        sys.exit(f"error: {error}")
    if arguments.save is not None:
        figure.savefig(arguments.save, dpi=120)
    else:
        plot.show()


if __name__ == "__main__":
    main()
