"""Poses, frames, keyframes and maps of semidense as numpy arrays.

>>> import semidense
>>> for pose in semidense.poses():
...     print(pose.state.name, pose.world_from_camera.translation)

The package reads what a running instance publishes in shared memory, without copying large data, or the files of a
finished run (`load`). A reader cannot slow the pipeline down.
"""

from ._wire import BUCKET_ENDS_MS, WIRE_VERSION, MapState, ProcessState, Reason, Scheduling, State
from .errors import (
    BadPlace,
    BadRun,
    CommandFailed,
    NotRunning,
    SemidenseError,
    TooManyHeld,
    TooManyReaders,
    WireVersion,
)
from .geometry import Intrinsics, Transform
from .live import frames, graph, health, keyframes, load_map, poses, save_map
from .messages import Frame, Graph, Health, Keyframe, KeyframePose, Pose, Velocity
from .reader import Reader
from .run import Run, RunKeyframe, Trajectory, load

__version__ = "0.1.0"

__all__ = [
    "BUCKET_ENDS_MS",
    "WIRE_VERSION",
    "BadPlace",
    "BadRun",
    "CommandFailed",
    "Frame",
    "Graph",
    "Health",
    "Intrinsics",
    "Keyframe",
    "KeyframePose",
    "MapState",
    "NotRunning",
    "Pose",
    "ProcessState",
    "Reader",
    "Reason",
    "Run",
    "RunKeyframe",
    "Scheduling",
    "SemidenseError",
    "State",
    "TooManyHeld",
    "TooManyReaders",
    "Trajectory",
    "Transform",
    "Velocity",
    "WireVersion",
    "frames",
    "graph",
    "health",
    "keyframes",
    "load",
    "load_map",
    "poses",
    "save_map",
]
