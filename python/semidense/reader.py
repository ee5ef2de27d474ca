"""Reads one instance, whenever it runs: waits for it, returns its messages, notices its end."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from types import TracebackType
from typing import Any, Callable, Dict, Iterator, List, Optional, Tuple, Type, TypeVar, Union

from ._place import AnyPath, Place
from ._ports import Ports, Sample
from ._wire import ProcessState
from .errors import NotRunning
from .messages import BrokenMessage, Frame, Graph, Health, Keyframe, Pose

# Between two attempts to join an instance that is not running yet.
RETRY_SECS = 0.1
# Wait after which a message is logged that names what is missing.
PATIENCE_SECS = 1.0
# Longest uninterrupted wait, hence the delay until a Ctrl-C or the end of a run is noticed.
WAIT_SECS = 0.1
# Processes report once a second: a process that is silent for longer counts as gone.
LONGEST_SILENCE_SECS = 3.0

_LOG = logging.getLogger("semidense")

Message = Union[Pose, Frame, Keyframe, Graph, Health]
M = TypeVar("M", Pose, Frame, Keyframe, Graph, Health)

_PATHS: Dict[type, Tuple[str, ...]] = {
    Pose: ("tracker/pose",),
    Frame: ("capture/frame",),
    Keyframe: ("mapper/keyframe", "mapper/keyframe_image"),
    Graph: ("mapper/graph",),
    Health: ("capture/health", "tracker/health", "mapper/health"),
}
_HEALTH = _PATHS[Health]
_GOING_ON = (ProcessState.STARTING, ProcessState.PREPARING, ProcessState.READY, ProcessState.RUNNING)
# Health is sent at least once a second, so it needs no wake-up.
_WAKES: Dict[type, Tuple[str, ...]] = {
    Pose: ("tracker/pose",),
    Frame: ("capture/frame",),
    Keyframe: ("mapper/keyframe",),
    Graph: ("mapper/graph",),
    Health: _HEALTH,
}


class Reader:
    """Reads the named kinds of messages of one instance; for several kinds in one loop.

    >>> with semidense.Reader(semidense.Pose, semidense.Keyframe) as reader:
    ...     for message in reader:
    ...         if isinstance(message, semidense.Pose): ...

    It belongs to the thread that uses it.
    """

    def __init__(
        self,
        *kinds: Type[Message],
        instance: str = "semidense",
        root: Optional[AnyPath] = None,
        timeout: Optional[float] = None,
        follow: bool = False,
        copy: bool = True,
    ) -> None:
        """Waits for the instance for `timeout` seconds (None: forever), then raises `NotRunning`.

        With `follow` it continues with the next run of the instance when one ends. Without `copy` the points of a
        keyframe stay in shared memory, where a reader may hold one keyframe: `del` it before the next.
        """
        unknown = [kind for kind in kinds if kind not in _PATHS]
        if unknown or not kinds:
            raise TypeError(f"name what to read: Pose, Frame, Keyframe, Graph or Health, not {unknown}")
        self.place = Place(instance, root)
        self.refused = 0
        """Number of messages skipped because they are invalid."""
        self._kinds = tuple(dict.fromkeys(kinds))
        self._timeout = timeout
        self._follow = follow
        self._copy = copy
        self._ports: Optional[Ports] = None
        self._states: Dict[str, ProcessState] = {}
        self._heard = time.monotonic()
        self._runs = 0
        # Whether a process of the run is known to go on: the end of a run that is mirrored from another machine stays
        # visible, and is not the next run.
        self._is_known = True
        # Depth whose image has not arrived, and the newest image, which serves every revision of its keyframe's depth.
        self._depth: Optional[Tuple[Any, Any]] = None
        self._image: Optional[Tuple[Any, Any]] = None
        self._join()

    def _join(self) -> None:
        begin = time.monotonic()
        end = None if self._timeout is None else begin + self._timeout
        is_silent = True
        while not self._try_to_join(end):
            if is_silent and time.monotonic() - begin > PATIENCE_SECS:
                is_silent = False
                _LOG.warning(
                    "waiting for instance `%s` in %s: start it with `semidense run`", self.place.instance, self.place.root
                )
            left = RETRY_SECS if end is None else min(RETRY_SECS, end - time.monotonic())
            time.sleep(max(0.0, left))

    def _try_to_join(self, end: Optional[float]) -> bool:
        paths = tuple(dict.fromkeys(p for kind in (*self._kinds, Health) for p in _PATHS[kind]))
        wakes = tuple(dict.fromkeys(p for kind in self._kinds for p in _WAKES[kind]))
        try:
            self._ports = Ports(self.place, f"python-{os.getpid()}", paths, wakes)
        except NotRunning:
            if end is not None and time.monotonic() >= end:
                raise
            return False
        self._states.clear()
        self._heard = time.monotonic()
        self._runs += 1
        self._is_known = self._runs == 1
        return True

    def read(self, timeout: float = 0.0) -> List[Message]:
        """Pending messages, waiting for at most `timeout` seconds; also empty when the run is over (`is_open`).

        With `follow` a later call joins the next run, if it has begun.
        """
        end = time.monotonic() + timeout
        if self._ports is None and self._follow:
            self._try_to_join(None)
        while True:
            messages = list(self._take())
            left = end - time.monotonic()
            if messages or self._ports is None:
                return messages
            if self._is_over():
                self.close()
            elif left <= 0.0:
                return messages
            else:
                self._ports.wait(min(left, WAIT_SECS))

    @property
    def is_open(self) -> bool:
        """Whether the run being read still continues."""
        return self._ports is not None

    def __iter__(self) -> Iterator[Message]:
        """Every message as it arrives, until the run ends (with `follow`: forever)."""
        while True:
            while self._ports is not None:
                is_quiet = True
                for message in self._take():
                    is_quiet = False
                    yield message
                    del message
                if not is_quiet or self._ports is None:
                    continue
                if self._is_over():
                    self.close()
                else:
                    self._ports.wait(WAIT_SECS)
            if not self._follow:
                return
            if not self._is_known:
                # That run was over before it was joined.
                time.sleep(RETRY_SECS)
            self._join()

    def _is_over(self) -> bool:
        """Whether tracker and mapper have finished, or no process has reported for too long."""
        ended = [self._states.get(process) is ProcessState.FINISHED for process in ("tracker", "mapper")]
        return all(ended) or time.monotonic() - self._heard > LONGEST_SILENCE_SECS

    def _receive(self, path: str) -> Optional[Sample]:
        if self._ports is None:
            return None
        sample = self._ports.subscribers[path].receive()
        if sample is not None:
            self._heard = time.monotonic()
        return sample

    def _take(self) -> Iterator[Message]:
        """All unread messages, keyframes before the poses that name them; of replaceable ones only the newest."""
        takes: Dict[type, Callable[[], Iterator[Message]]] = {
            Keyframe: self._keyframe,
            Graph: self._graph,
            Frame: self._frames,
            Pose: self._poses,
        }
        yield from self._health()
        if not self._is_known:
            self._discard()
            return
        for kind, take in takes.items():
            if kind in self._kinds:
                yield from take()

    def _checked(self, make: Callable[[], M]) -> Iterator[M]:
        try:
            message = make()
        except BrokenMessage:
            self.refused += 1
            return
        yield message

    def _health(self) -> Iterator[Health]:
        for path in _HEALTH:
            process = path.split("/")[0]
            while (sample := self._receive(path)) is not None:
                for message in sample.payload():
                    for health in self._checked(lambda m=message, p=process: Health(p, m)):  # type: ignore[misc]
                        self._states[process] = health.state
                        self._is_known |= health.state in _GOING_ON
                        if Health in self._kinds and self._is_known:
                            yield health

    def _discard(self) -> None:
        """Drops what is left of a run whose processes have all ended, as far as they have reported."""
        if self._ports is None or not self._states:
            return
        for path in self._ports.subscribers:
            while path not in _HEALTH and self._receive(path) is not None:
                pass

    def _poses(self) -> Iterator[Pose]:
        while (sample := self._receive("tracker/pose")) is not None:
            for message in sample.payload():
                yield from self._checked(lambda m=message: Pose(m))  # type: ignore[misc]

    def _frames(self) -> Iterator[Frame]:
        # One at a time: only few may be held.
        if (sample := self._receive("capture/frame")) is not None:
            header, pixels = sample.header(), sample.array()
            del sample
            yield from self._checked(lambda h=header, p=pixels: Frame(h, p))  # type: ignore[misc]

    def _graph(self) -> Iterator[Graph]:
        if (sample := self._receive("mapper/graph")) is not None:
            header, messages = sample.header(), sample.payload()
            del sample
            yield from self._checked(lambda: Graph(header, messages))

    def _keyframe(self) -> Iterator[Keyframe]:
        # Depth first: the mapper sends the image before it, so the image of a received depth is here. Points are copied
        # by default: only one may be held, and the loop still has the previous one when the next arrives. An image
        # serves all revisions of its keyframe.
        is_free = self._copy or self._depth is None
        if is_free and (depth := self._receive("mapper/keyframe")) is not None:
            self._depth = (depth.header(), depth.copied_array() if self._copy else depth.array())
            del depth
        if (image := self._receive("mapper/keyframe_image")) is not None:
            self._image = (image.header(), image.copied_array())
            del image
        if self._depth is None or self._image is None:
            return
        (header, points), (image_header, pixels) = self._depth, self._image
        if (header.keyframe_id, header.epoch) != (image_header.keyframe_id, image_header.epoch):
            # The other half is in transit; a newer depth replaces this one.
            if not self._copy:
                # Holding it would leave no room for the newer one.
                self._depth = None
            return
        self._depth = None
        yield from self._checked(lambda: Keyframe(header, points, image_header, pixels))

    def close(self) -> None:
        """Leaves the instance; returned messages stay readable."""
        self._depth = self._image = None
        if self._ports is not None:
            ports, self._ports = self._ports, None
            with contextlib.suppress(Exception):
                ports.close()

    def __enter__(self) -> Reader:
        """Returns the reader itself."""
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        traceback: Optional[TracebackType],
    ) -> None:
        """Leaves the instance."""
        self.close()
