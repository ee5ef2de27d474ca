"""Ports of iceoryx2 for one run of an instance: opened together, read without copying."""

from __future__ import annotations

import ctypes
from typing import Any, Dict, List, Optional, Tuple

import iceoryx2 as iox2
import numpy as np

from . import _wire
from ._place import Place
from ._wire import TOPICS, WIRE_VERSION
from .errors import NotRunning, SemidenseError, TooManyHeld, TooManyReaders, WireVersion

# iceoryx2 compares sizes and names of types; a table that is not that of the Rust definitions would show here first.
_kinds: List[Any] = [kind for topic in TOPICS.values() for kind in (topic.payload, topic.header)]
for _kind in _kinds:
    if hasattr(_kind, "SIZE") and ctypes.sizeof(_kind) != _kind.SIZE:
        raise ImportError(f"{_kind.__name__} has {ctypes.sizeof(_kind)} bytes on this machine, not {_kind.SIZE}")


class Sample:
    """A message in shared memory: it stays there for as long as it, or an array of it, is referred to."""

    def __init__(self, sample: Any, topic: _wire.Topic, ports: Any) -> None:
        self._sample = sample
        # A port that is gone gives its places back, whoever still looks at them.
        self._ports = ports
        self._topic = topic
        self.length: int = sample.header.number_of_elements

    def header(self) -> Any:
        """A copy of the header."""
        kind: Any = self._topic.header
        return kind.from_buffer_copy((ctypes.c_char * ctypes.sizeof(kind)).from_address(self._sample.user_header_ptr))

    def payload(self) -> Any:
        """A copy of the payload: an array of structures."""
        element: Any = self._topic.payload
        kind = element * self.length
        return kind.from_buffer_copy((ctypes.c_char * ctypes.sizeof(kind)).from_address(self._sample.payload_ptr))

    def array(self) -> Any:
        """The payload itself as a read-only numpy array."""
        kind: Any = self._topic.payload
        size = ctypes.sizeof(kind) * self.length
        if size == 0:
            return np.empty(0, dtype=np.dtype(kind))
        buffer: Any = (ctypes.c_ubyte * size).from_address(self._sample.payload_ptr)
        # The array refers to the buffer, the buffer to the sample: the last one to go gives the place back, and the
        # sample goes before its port.
        buffer.owner = (self._ports, self._sample)
        array = np.frombuffer(buffer, dtype=np.dtype(kind))
        array.flags.writeable = False
        return array

    def copied_array(self) -> Any:
        """The payload as a read-only numpy array of its own."""
        array = self.array().copy()
        array.flags.writeable = False
        return array


class Subscriber:
    """Receives one topic."""

    def __init__(self, node: Any, place: Place, path: str) -> None:
        self.topic = TOPICS[path]
        self._name = service_name(place, path)
        builder = node.service_builder(iox2.ServiceName.new(self._name))
        builder = builder.publish_subscribe(iox2.Slice[self.topic.payload]).enable_safe_overflow(True)
        if self.topic.header is not None:
            builder = builder.user_header(self.topic.header)
        try:
            service = builder.open()
        except iox2.PublishSubscribeOpenError:
            raise not_running(place) from None
        self.most_held: int = service.static_config.subscriber_max_borrowed_samples
        port = service.subscriber_builder().buffer_size(self.topic.buffer)
        if self.topic.history:
            port = port.history_request(self.topic.history)
        try:
            self._port = port.create()
        except iox2.SubscriberCreateError as error:
            if "ExceedsMaxSupportedSubscribers" not in f"{error!r}":
                raise SemidenseError(f"topic {self._name}: {error}") from None
            most = service.static_config.max_subscribers
            raise TooManyReaders(
                f"{path} has {most} subscribers already, as many as it may have: stop one ({_readers(service)})"
            ) from None
        self._ports: Tuple[Any, ...] = (node, self._port)

    def receive(self) -> Optional[Sample]:
        """The oldest unread message."""
        try:
            sample = self._port.receive()
        except iox2.ReceiveError as error:
            if "ExceedsMaxBorrow" not in f"{error!r}":
                raise SemidenseError(f"topic {self._name}: receiving failed ({error})") from None
            raise TooManyHeld(
                f"{self.topic.path}: {self.most_held} messages are held, and there is room for no more: keep the "
                "`.copy()` of what you keep, and let go of the arrays of the others (they refer to shared memory)"
            ) from None
        return None if sample is None else Sample(sample, self.topic, self._ports)

    def close(self) -> None:
        """Lets go of the port; what has been received stays."""
        self._port = None
        self._ports = ()


def _readers(service: Any) -> str:
    """Who has opened a service, the pipeline's own processes left out."""
    names = []
    for node in service.nodes:
        # Of a process that is gone, or another user's, no details are known.
        view = node[0] if isinstance(node, iox2.NodeState.Alive) else None
        if view is not None and view.details is not None:
            name, process = view.details.name.as_str(), view.details.process_id
            if name not in ("capture", "tracker", "mapper"):
                names.append(f"{name}, process {process}")
    return "; ".join(sorted(names)) or "their names are not known"


def service_name(place: Place, path: str) -> str:
    """Name of a topic: `<instance>/v<wire version>/<owner>/<noun>`."""
    return f"{place.instance}/v{WIRE_VERSION}/{path}"


def not_running(place: Place) -> NotRunning:
    """Why nothing can be read there."""
    holder = place.running()
    if holder is not None:
        return NotRunning(
            f"instance `{place.instance}` runs (process {holder}), but its topics are not here: it is just starting, or "
            "this container has a /dev/shm of its own (docker run --ipc=host shares the host's)"
        )
    return NotRunning(
        f"nothing is running as instance `{place.instance}` in {place.root}: "
        "start `semidense run`, or name another instance"
    )


def _config(place: Place) -> Any:
    config = iox2.config.default()
    config.global_cfg.root_path = iox2.Path.new(place.root)
    config.global_cfg.prefix = iox2.FileName.new(place.prefix)
    return config


def _check_version(config: Any, place: Place) -> None:
    """Topics of another version have other names: without this look the reader would wait forever."""
    try:
        services = iox2.Service.list(config, iox2.ServiceType.Ipc)
    except Exception:
        # What cannot be listed cannot be opened either, and that says why.
        return
    head = f"{place.instance}/v"
    for service in services:
        name = str(service.name().to_string())
        version, slash, _ = name[len(head) :].partition("/")
        if name.startswith(head) and slash and version.isdigit() and int(version) != WIRE_VERSION:
            raise WireVersion(place.instance, int(version), WIRE_VERSION)


def make_node(place: Place, name: str) -> Any:
    """Joins the instance; to be called while the place is held."""
    iox2.set_log_level(iox2.LogLevel.Fatal)
    config = _config(place)
    builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(name)).config(config)
    # Ctrl-C is Python's.
    builder = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled)
    try:
        node = builder.create(iox2.ServiceType.Ipc)
    except iox2.NodeCreationFailure as error:
        raise SemidenseError(
            f"cannot join the instance in {place.root} ({error}): it may be another user's (run as that user), or the "
            "limit of open files is too low (ulimit -n)"
        ) from None
    place.keep_to_user()
    _check_version(config, place)
    return node


class Ports:
    """The open topics of one run."""

    def __init__(self, place: Place, name: str, paths: Tuple[str, ...], wakes: Tuple[str, ...]) -> None:
        """Opens `paths`, and waits on the wake-ups of `wakes`."""
        if not place.is_there():
            raise not_running(place)
        place.check_room()
        with place.hold():
            if not place.is_there():
                raise not_running(place)
            self.node = make_node(place, name)
            self.subscribers: Dict[str, Subscriber] = {path: Subscriber(self.node, place, path) for path in paths}
            self._listeners: List[Any] = [self._listener(place, path) for path in wakes]
            place.reserve()
        self._wait_set: Any = None
        self._guards: List[Any] = []
        if len(self._listeners) > 1:
            builder = iox2.WaitSetBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            self._wait_set = builder.create(iox2.ServiceType.Ipc)
            self._guards = [self._wait_set.attach_notification(listener) for listener in self._listeners]

    def _listener(self, place: Place, path: str) -> Any:
        builder = self.node.service_builder(iox2.ServiceName.new(service_name(place, path))).event()
        try:
            return builder.open().listener_builder().create()
        except (iox2.EventOpenError, iox2.ListenerCreateError):
            raise not_running(place) from None

    def wait(self, seconds: float) -> None:
        """Until something comes, at most so long. Other threads run meanwhile; a signal is handled after it."""
        duration = iox2.Duration.from_nanos(max(1, int(seconds * 1e9)))
        try:
            if self._wait_set is None:
                self._listeners[0].timed_wait(duration)
                return
            self._wait_set.wait_and_process_with_timeout(duration)
            for listener in self._listeners:
                listener.try_wait()
        except (iox2.ListenerWaitError, iox2.WaitSetRunError):
            # A signal: Python handles it now, and the caller looks again.
            return

    def close(self) -> None:
        """Leaves the instance; what has been received stays."""
        self._guards.clear()
        self._wait_set = None
        self._listeners.clear()
        for subscriber in self.subscribers.values():
            subscriber.close()
        self.subscribers.clear()
        self.node = None
