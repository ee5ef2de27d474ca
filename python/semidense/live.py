"""Loops over one kind of message, and commands: all that most programs need."""

from __future__ import annotations

import os
import time
from typing import Iterator, Optional, Type, cast

import iceoryx2 as iox2

from . import _wire
from ._place import AnyPath, Place
from ._ports import make_node, not_running, service_name
from .errors import CommandFailed
from .messages import Frame, Graph, Health, Keyframe, Pose, _text
from .reader import M, Reader

# Between two checks for an answer.
ANSWER_PAUSE_SECS = 0.01
PATH_BYTES = 4096
_SAVE_FOLDER, _LOAD_FOLDER, _LOCATE_IN_FOLDER = 2, 3, 4


def _stream(
    kind: Type[M],
    instance: str,
    root: Optional[AnyPath],
    timeout: Optional[float],
    follow: bool,
    copy: bool = True,
) -> Iterator[M]:
    # Joined by the call itself, so that errors are raised there, not in the first iteration of the loop.
    reader = Reader(kind, instance=instance, root=root, timeout=timeout, follow=follow, copy=copy)

    def messages() -> Iterator[M]:
        with reader:
            yield from cast(Iterator[M], iter(reader))

    return messages()


def poses(
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: Optional[float] = None,
    follow: bool = False,
) -> Iterator[Pose]:
    """Every pose as it is published, including those of lost frames, until the run ends.

    Waits for the instance for `timeout` seconds (None: forever), then raises `NotRunning`. `root` is the folder of the
    instance if it is not the usual one (`SEMIDENSE_ROOT`). With `follow` it continues to the next run. 900 poses
    are kept for a slow loop.
    """
    return _stream(Pose, instance, root, timeout, follow)


def frames(
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: Optional[float] = None,
    follow: bool = False,
) -> Iterator[Frame]:
    """Every image of the camera, without copying; a slow loop skips the oldest ones (visible in `sequence`).

    At most 4 may be held at once, including that of the loop: keep `frame.copy()` instead.
    """
    return _stream(Frame, instance, root, timeout, follow)


def keyframes(
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: Optional[float] = None,
    follow: bool = False,
    copy: bool = True,
) -> Iterator[Keyframe]:
    """The active keyframe at once, then each new one and each revision of its depth; the newest wins.

    Each is copied once and may be kept. With `copy=False` its points stay in shared memory, where a reader may hold one:
    write `del keyframe` at the end of the loop, or `TooManyHeld` is raised.
    """
    return _stream(Keyframe, instance, root, timeout, follow, copy)


def graph(
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: Optional[float] = None,
    follow: bool = False,
) -> Iterator[Graph]:
    """The poses of all keyframes in the map: at once, then whenever they change; the newest wins."""
    return _stream(Graph, instance, root, timeout, follow)


def health(
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: Optional[float] = None,
    follow: bool = False,
) -> Iterator[Health]:
    """Health reports of capture, tracker and mapper: once a second and on every change."""
    return _stream(Health, instance, root, timeout, follow)


def save_map(
    folder: Optional[AnyPath] = None,
    instance: str = "semidense",
    *,
    root: Optional[AnyPath] = None,
    timeout: float = 60.0,
) -> None:
    """Saves the map to `folder`, as `semidense map save` does; by default to the mapper's own folder."""
    _ask(_SAVE_FOLDER, folder, instance, root, timeout)


def load_map(
    folder: AnyPath,
    instance: str = "semidense",
    *,
    read_only: bool = False,
    root: Optional[AnyPath] = None,
    timeout: float = 60.0,
) -> None:
    """Switches to the map in `folder`, as `semidense map load` does; with `read_only` the camera is only localised."""
    _ask(_LOCATE_IN_FOLDER if read_only else _LOAD_FOLDER, folder, instance, root, timeout)


def _ask(kind: int, folder: Optional[AnyPath], instance: str, root: Optional[AnyPath], timeout: float) -> None:
    path = b"" if folder is None else os.fsencode(os.path.abspath(os.fspath(folder)))
    if len(path) > PATH_BYTES:
        raise CommandFailed(f"{folder!r}: a path may have at most {PATH_BYTES} bytes")
    place = Place(instance, root)
    if not place.is_there():
        raise not_running(place)
    place.check_room()
    with place.hold():
        node = make_node(place, f"python-command-{os.getpid()}")
        name = iox2.ServiceName.new(service_name(place, _wire.COMMAND_TOPIC))
        builder = node.service_builder(name).request_response(_wire.CommandRequest, _wire.CommandResponse)
        try:
            client = builder.open().client_builder().create()
            notifier = node.service_builder(name).event().open().notifier_builder().create()
        except (iox2.RequestResponseOpenError, iox2.EventOpenError):
            raise not_running(place) from None
        except (iox2.ClientCreateError, iox2.NotifierCreateError) as error:
            raise CommandFailed(f"mapper/command: {error}: other programs are sending requests; try again") from None
        place.reserve()
    request = _wire.CommandRequest(kind=kind, path_bytes=len(path))
    request.path[: len(path)] = path
    pending = client.send_copy(request)
    notifier.notify()
    _answer(pending, place, timeout)


def _answer(pending: object, place: Place, timeout: float) -> None:
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        response = pending.receive()  # type: ignore[attr-defined]
        if response is not None:
            answer = response.payload().contents
            if answer.status != 0:
                raise CommandFailed(f"mapper: {_text(answer.text, answer.text_bytes)}")
            return
        if place.running() is None:
            raise not_running(place)
        time.sleep(ANSWER_PAUSE_SECS)
    raise CommandFailed(f"the mapper did not answer within {timeout:g} s")
