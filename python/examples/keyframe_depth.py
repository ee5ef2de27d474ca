"""Draws the depth of the active keyframe over its image, live.

python keyframe_depth.py                  # a live window, until the run ends or it is closed
python keyframe_depth.py --save depth.png # the next keyframe, saved as a picture
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import matplotlib
import numpy as np

import semidense


def draw(figure: Any, keyframe: semidense.Keyframe) -> None:
    """Image in grey, depth in colours: near is red, far is blue."""
    points = keyframe.points[keyframe.has_depth]
    # Otherwise the nearest and farthest hundredth would use up the colours.
    nearest, farthest = np.percentile(points["inverse_depth"], [99, 1]) if len(points) else (1.0, 0.0)
    figure.clear()
    axes = figure.subplots()
    axes.imshow(keyframe.image, cmap="gray", vmin=0, vmax=255)
    size = 70 * 320 / keyframe.intrinsics.width
    dots = axes.scatter(
        points["u"], points["v"], c=points["inverse_depth"], s=size / 50, cmap="turbo", vmin=farthest, vmax=nearest
    )
    figure.colorbar(dots, ax=axes, label="inverse depth, 1/keyframe units", shrink=0.8)
    axes.set_title(f"keyframe {keyframe.keyframe_id}, revision {keyframe.revision}: {len(points)} points")
    axes.set_axis_off()


def main() -> None:
    """Parses the arguments and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", default="semidense")
    parser.add_argument("--timeout", type=float, help="seconds to wait for the instance [forever]")
    parser.add_argument("--save", metavar="FILE", help="write a picture instead of opening a window")
    arguments = parser.parse_args()
    if arguments.save is not None:
        matplotlib.use("Agg")
    from matplotlib import pyplot as plot

    figure = plot.figure(figsize=(8, 5.5), layout="constrained")
    try:
        for keyframe in semidense.keyframes(arguments.instance, timeout=arguments.timeout):
            draw(figure, keyframe)
            if arguments.save is not None:
                figure.savefig(arguments.save, dpi=120)
                return
            plot.pause(0.001)
            if not plot.fignum_exists(figure.number):
                return
    except semidense.SemidenseError as error:
        sys.exit(f"error: {error}")
    plot.show()


if __name__ == "__main__":
    main()
