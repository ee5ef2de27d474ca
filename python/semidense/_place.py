"""The place of an instance: its name, the folder of its files, the prefix of its shared memory.

The same rules as in the Rust readers (`src/wire/place.rs`, `src/wire/root_folder.rs`).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
import time
from typing import Iterator, Optional, Union

from ._wire import ROOT_VARIABLE, SYSTEM_ROOT
from .errors import BadPlace, SemidenseError

SHARED_MEMORY = "/dev/shm"
# A listener's socket is in the folder, and the path of a socket has at most 107 bytes.
MAX_ROOT_BYTES = 48
JOIN_LOCK = ".join.lock"
MEMBERS = ("capture", "tracker", "mapper")
# Joining takes milliseconds, on a busy machine a second.
LONGEST_HOLD_SECS = 10.0
# Upper limit for the shared memory needed by a reader of all topics: without it the process would die of SIGBUS.
JOIN_BYTES = 1 << 20
# Number of names tried in the temporary folder.
PRIVATE_NAMES = 20

AnyPath = Union[str, "os.PathLike[str]"]


def _is_mine(path: str) -> bool:
    try:
        return os.stat(path).st_uid == os.geteuid()
    except OSError:
        return False


def _private_root(temporary: str) -> str:
    """This user's folder in `temporary`: the first that is ours, else the first free name."""
    usual = os.path.join(temporary, f"semidense-{os.geteuid()}")
    names = [usual] + [f"{usual}-{n}" for n in range(1, PRIVATE_NAMES)]
    free = None
    for name in names:
        try:
            # Without following a link, which could lead anywhere.
            found = os.lstat(name)
        except FileNotFoundError:
            free = free or name
            continue
        except OSError:
            continue
        is_closed = not found.st_mode & 0o022
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and is_closed:
            return name
    return free or usual


def usual_root() -> str:
    """The folder that all processes of this user find by default."""
    for variable in (ROOT_VARIABLE, "RUNTIME_DIRECTORY"):
        if os.environ.get(variable):
            return os.environ[variable]
    if _is_mine(SYSTEM_ROOT):
        return SYSTEM_ROOT
    # After `su` or `sudo` it may name the folder of the previous user.
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and _is_mine(runtime):
        return os.path.join(runtime, "semidense")
    return _private_root(os.environ.get("TMPDIR") or "/tmp")


def prefix_of(root: str) -> str:
    """First part of the names of an instance's shared memory."""
    if root == SYSTEM_ROOT:
        return "semidense_system_"
    # FNV-1a, 32 bits.
    value = 0x811C9DC5
    for byte in os.fsencode(root):
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return f"semidense_{value:08x}_"


class Place:
    """An instance and its folder. Creating one touches no files."""

    def __init__(self, instance: str, root: Optional[AnyPath]) -> None:
        """The place of `instance` below `root`, by default below the usual folder."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}", instance):
            raise BadPlace(
                f"instance {instance!r}: a name has 1 to 32 letters, digits, '-' and '_' (as --instance of semidense)"
            )
        self.instance = instance
        self.root = os.path.abspath(os.fspath(root) if root else usual_root())
        if len(os.fsencode(self.root)) > MAX_ROOT_BYTES:
            raise BadPlace(
                f"{self.root}: the folder of an instance may have at most {MAX_ROOT_BYTES} bytes; "
                f"name a shorter one with root= or {ROOT_VARIABLE}, as where semidense runs"
            )
        self.prefix = prefix_of(self.root)

    def is_there(self) -> bool:
        """Whether there are topics below the root: joining otherwise would leave folders behind."""
        return os.path.isdir(os.path.join(self.root, "services"))

    def running(self) -> Optional[str]:
        """The id of a running process of the instance, from its claim."""
        for member in MEMBERS:
            path = os.path.join(self.root, f"{self.instance}.{member}.lock")
            try:
                with open(path) as file:
                    try:
                        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    except BlockingIOError:
                        return file.read().strip()
            except OSError:
                continue
        return None

    @contextlib.contextmanager
    def hold(self) -> Iterator[None]:
        """Keeps the last process of a run from cleaning up while we join."""
        path = os.path.join(self.root, JOIN_LOCK)
        end = time.monotonic() + LONGEST_HOLD_SECS
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                if self._lock(descriptor, path, end):
                    yield
                    return
            finally:
                os.close(descriptor)

    def _lock(self, descriptor: int, path: str, end: float) -> bool:
        """Locks the file; returns whether it is still the one at `path`."""
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    raise SemidenseError(
                        f"{path} has been held by another process for more than {LONGEST_HOLD_SECS:.0f} s: "
                        "stop it (fuser names it), or choose another root"
                    ) from None
                time.sleep(0.002)
        try:
            return os.path.samestat(os.fstat(descriptor), os.stat(path))
        except FileNotFoundError:
            return False

    def check_room(self) -> None:
        """Checks that shared memory has room for one more reader."""
        found = os.statvfs(SHARED_MEMORY)
        if found.f_bavail * found.f_frsize < JOIN_BYTES:
            raise SemidenseError(f"{SHARED_MEMORY} is full: a reader needs {JOIN_BYTES >> 20} MiB (df {SHARED_MEMORY})")

    def _segments(self) -> Iterator[str]:
        for name in os.listdir(SHARED_MEMORY):
            if name.startswith(self.prefix):
                yield os.path.join(SHARED_MEMORY, name)

    def keep_to_user(self) -> None:
        """Revokes other users' access: iceoryx2 creates its node counter accessible to everybody."""
        for path in self._segments():
            if path.endswith(".global_mgmt"):
                with contextlib.suppress(OSError):
                    os.chmod(path, 0o600)

    def reserve(self) -> None:
        """Allocates the segments fully: touching a page that cannot be allocated would end the process."""
        for path in self._segments():
            try:
                descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            except OSError:
                continue
            try:
                found = os.fstat(descriptor)
                lacks = found.st_size - 512 * found.st_blocks
                if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() and lacks > 0:
                    os.posix_fallocate(descriptor, 0, found.st_size)
            except OSError as error:
                raise SemidenseError(
                    f"{SHARED_MEMORY} has no room for what this reader needs ({error.strerror}): "
                    f"free some of it (df {SHARED_MEMORY})"
                ) from None
            finally:
                os.close(descriptor)
