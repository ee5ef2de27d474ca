"""A running pipeline for the tests: the real binary on a small simulated camera."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Callable, Iterator, List, TypeVar

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL_CAMERA = ("frames=60", "width=160", "height=120", "focal_px=131.0")
# Far above any expected duration: it ends a test that hangs.
WATCH_DOG_SECS = 120.0
T = TypeVar("T")

# A shell that starts the tests in the background has them ignore it, and so would the programs they start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def binary() -> str:
    """The program: `SEMIDENSE_BIN`, else the last one built by cargo."""
    named = os.environ.get("SEMIDENSE_BIN")
    if named:
        return named
    built = [REPOSITORY / "target" / kind / "semidense" for kind in ("release", "debug")]
    found = [path for path in built if path.exists()]
    if not found:
        pytest.exit("no semidense: cargo build --release, or name it with SEMIDENSE_BIN", returncode=3)
    return str(max(found, key=lambda path: path.stat().st_mtime))


class Rig:
    """A separate instance: folder, shared memory, output."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = folder / "r"
        self.output = folder / "o"
        self._children: List[subprocess.Popen[bytes]] = []

    def environment(self) -> Any:
        return {**os.environ, "SEMIDENSE_ROOT": str(self.root)}

    def run(self, *arguments: str) -> subprocess.Popen[bytes]:
        """`semidense run` on a small simulated camera."""
        settings = [word for setting in SMALL_CAMERA for word in ("--set", f"simulator.{setting}")]
        command = [binary(), "run", "--output", str(self.output), *settings, *arguments]
        log = open(self.folder / "log", "wb")  # noqa: SIM115
        child = subprocess.Popen(command, env=self.environment(), stdout=log, stderr=log)
        log.close()
        self._children.append(child)
        return child

    def live(self) -> subprocess.Popen[bytes]:
        """Starts a run that lasts longer than any test."""
        return self.run("--live", "--source", "loop:1000000:30:sim")

    def end(self, child: subprocess.Popen[bytes]) -> None:
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
        child.wait(WATCH_DOG_SECS)

    def close(self) -> None:
        for child in self._children:
            self.end(child)


def until(ask: Callable[[], T]) -> T:
    """Calls `ask` repeatedly until there is an answer."""
    end = time.monotonic() + WATCH_DOG_SECS
    while time.monotonic() < end:
        answer = ask()
        if answer:
            return answer
        time.sleep(0.01)
    raise AssertionError("waited in vain")


def make_rig() -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(prefix="sdpy", dir="/tmp") as folder:
        rig = Rig(Path(folder))
        try:
            yield rig
        finally:
            rig.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    """An instance without a running process."""
    yield from make_rig()


@pytest.fixture(scope="module")
def running() -> Iterator[Rig]:
    """An instance that runs for as long as the tests of a file."""
    for made in make_rig():
        made.live()
        yield made
