"""Ports of iceoryx2 for one run of an instance, opened together and read without copying."""

from __future__ import annotations

import ctypes
from typing import Any, Dict, List, Optional, Tuple

import iceoryx2 as iox2
import numpy as np

from . import _wire
from ._place import Place
from ._wire import TOPICS, WIRE_VERSION
from .errors import NotRunning, SemidenseError, TooManyHeld, TooManyReaders, WireVersion

# iceoryx2 compares sizes and names of types; a table that differs from the Rust definitions is detected here first.
_kinds: List[Any] = [kind for topic in TOPICS.values() for kind in (topic.payload, topic.header)]
for _kind in _kinds:
    if hasattr(_kind, "SIZE") and ctypes.sizeof(_kind) != _kind.SIZE:
        raise ImportError(f"{_kind.__name__} has {ctypes.sizeof(_kind)} bytes on this machine, not {_kind.SIZE}")


class Sample:
    """A message in shared memory, held for as long as it, or an array of it, is referenced."""

    def __init__(self, sample: Any, topic: _wire.Topic, ports: Any) -> None:
        self._sample = sample
        # A closed port releases its loans even if they are still in use.
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
        # The array references the buffer, the buffer the sample: deleting the last one releases the loan, and the
        # sample is deleted before its port.
        buffer.owner = (self._ports, self._sample)
        array = np.frombuffer(buffer, dtype=np.dtype(kind))
        array.flags.writeable = False
        return array

    def copied_array(self) -> Any:
        """A copy of the payload as a read-only numpy array."""
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
                f"{path} already has its maximum of {most} subscribers: stop one ({_readers(service)})"
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
                f"{self.topic.path}: {self.most_held} messages are held, and there is no room for more: keep a "
                "`.copy()` of what you need, and release the arrays of the others (they refer to shared memory)"
            ) from None
        return None if sample is None else Sample(sample, self.topic, self._ports)

    def close(self) -> None:
        """Closes the port; received messages remain valid."""
        self._port = None
        self._ports = ()


def _readers(service: Any) -> str:
    """The nodes that have opened a service, except for the pipeline's own processes."""
    names = []
    for node in service.nodes:
        # A dead process, or another user's, has no details.
        view = node[0] if isinstance(node, iox2.NodeState.Alive) else None
        if view is not None and view.details is not None:
            name, process = view.details.name.as_str(), view.details.process_id
            if name not in ("capture", "tracker", "mapper"):
                names.append(f"{name}, process {process}")
    return "; ".join(sorted(names)) or "their names are unknown"


def service_name(place: Place, path: str) -> str:
    """Name of a topic: `<instance>/v<wire version>/<owner>/<noun>`."""
    return f"{place.instance}/v{WIRE_VERSION}/{path}"


def not_running(place: Place) -> NotRunning:
    """The error for a place where nothing can be read."""
    holder = place.running()
    if holder is not None:
        return NotRunning(
            f"instance `{place.instance}` runs (process {holder}), but its topics are not here: it is just starting, or "
            "this container has its own /dev/shm (docker run --ipc=host shares the host's)"
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
    """Detects topics of another version, which have other names: otherwise the reader would wait forever."""
    try:
        services = iox2.Service.list(config, iox2.ServiceType.Ipc)
    except Exception:
        # Services that cannot be listed cannot be opened either, and opening gives the reason.
        return
    head = f"{place.instance}/v"
    for service in services:
        name = str(service.name().to_string())
        version, slash, _ = name[len(head) :].partition("/")
        if name.startswith(head) and slash and version.isdigit() and int(version) != WIRE_VERSION:
            raise WireVersion(place.instance, int(version), WIRE_VERSION)


def make_node(place: Place, name: str) -> Any:
    """Joins the instance; call this while the place is held."""
    iox2.set_log_level(iox2.LogLevel.Fatal)
    config = _config(place)
    builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(name)).config(config)
    # Python handles Ctrl-C.
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
        """Opens the topics `paths`, and waits on the wake-ups of `wakes`."""
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
        """Waits for a message, at most for `seconds`. Other threads run meanwhile; signals are handled afterwards."""
        duration = iox2.Duration.from_nanos(max(1, int(seconds * 1e9)))
        try:
            if self._wait_set is None:
                self._listeners[0].timed_wait(duration)
                return
            self._wait_set.wait_and_process_with_timeout(duration)
            for listener in self._listeners:
                listener.try_wait()
        except (iox2.ListenerWaitError, iox2.WaitSetRunError):
            # A signal: Python handles it now, and the caller checks again.
            return

    def close(self) -> None:
        """Leaves the instance; received messages remain valid."""
        self._guards.clear()
        self._wait_set = None
        self._listeners.clear()
        for subscriber in self.subscribers.values():
            subscriber.close()
        self.subscribers.clear()
        self.node = None
