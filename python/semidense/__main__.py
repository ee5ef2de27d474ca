"""`python -m semidense`: prints the poses of a running instance, one per line."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any, Dict, List, Optional

from . import WIRE_VERSION, SemidenseError, __version__, poses
from .messages import Pose

HEAD = "#  frame        stamp s         x         y         z       qx      qy      qz      qw  state"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m semidense",
        description="Prints the pose of every frame of a running semidense: number of the frame, stamp in seconds, "
        "world_from_camera (position in map units and quaternion x y z w), state and reason.",
        epilog="Waits for the instance, and ends with the run. Ctrl-C ends it. Exit codes: 0 done, 1 failed, 2 wrong "
        "usage, 130 Ctrl-C.",
    )
    parser.add_argument("--instance", default="semidense", metavar="NAME", help="instance to read [semidense]")
    parser.add_argument("--root", metavar="DIR", help="its folder [SEMIDENSE_ROOT, else the usual one]")
    parser.add_argument(
        "--timeout", type=float, metavar="SECONDS", help="wait at most this long for the instance [forever]"
    )
    parser.add_argument("--follow", action="store_true", help="continue with the next run when one ends")
    parser.add_argument("--map", action="store_true", help="print map_from_camera instead of world_from_camera")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, with covariance and velocity")
    parser.add_argument("--count", type=int, metavar="N", help="end after N poses")
    version = f"semidense for Python {__version__}, wire version {WIRE_VERSION}"
    parser.add_argument("--version", action="version", version=version)
    return parser


def _as_json(pose: Pose) -> str:
    fields: Dict[str, Any] = {
        "sequence": pose.sequence,
        "capture_nanos": pose.capture_nanos,
        "realtime_nanos": pose.realtime_nanos,
        "epoch": pose.epoch,
        "map_revision": pose.map_revision,
        "keyframe_id": pose.keyframe_id,
        "state": pose.state.name.lower(),
        "reason": pose.reason.name.lower() if pose.reason else None,
        "covariance": pose.covariance.tolist(),
        "map_covariance": pose.map_covariance.tolist(),
        "velocity": None,
    }
    for name in ("world_from_camera", "map_from_camera", "keyframe_from_camera"):
        transform = getattr(pose, name)
        fields[name] = {
            "translation": transform.translation.tolist(),
            "quaternion": transform.quaternion.tolist(),
        }
    if pose.velocity is not None:
        velocity = pose.velocity
        fields["velocity"] = {name: getattr(velocity, name).tolist() for name in ("linear", "angular", "covariance")}
    return json.dumps(fields)


def _print(arguments: argparse.Namespace) -> None:
    stream = poses(arguments.instance, root=arguments.root, timeout=arguments.timeout, follow=arguments.follow)
    if not arguments.json:
        print(HEAD, flush=True)
    for count, pose in enumerate(stream, start=1):
        if arguments.json:
            print(_as_json(pose), flush=True)
        else:
            print(pose.line(in_map=arguments.map), flush=True)
        if arguments.count is not None and count >= arguments.count:
            return


def main(arguments: Optional[List[str]] = None) -> int:
    """Runs the command line and returns the exit code."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    if parsed.count is not None and parsed.count < 1:
        parser.error("--count: at least 1")
    try:
        _print(parsed)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader closed the pipe; Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SemidenseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
