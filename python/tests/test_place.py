"""The search for an instance, and the errors without one."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Dict, Iterator

import pytest
from conftest import WATCH_DOG_SECS, Rig, binary, until

import semidense
from semidense import _ports, _wire
from semidense._place import Place, prefix_of, usual_root

VARIABLES = ("SEMIDENSE_ROOT", "RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR", "TMPDIR")


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    yield monkeypatch


def test_prefixes_are_those_of_the_pipeline() -> None:
    assert {root: prefix_of(root) for root in _wire.PREFIXES} == _wire.PREFIXES


@pytest.mark.parametrize(
    "variables",
    [
        {"SEMIDENSE_ROOT": "/tmp/sdpy-a", "XDG_RUNTIME_DIR": "{tmp}"},
        {"RUNTIME_DIRECTORY": "/tmp/sdpy-b"},
        {"SEMIDENSE_ROOT": "", "RUNTIME_DIRECTORY": "/tmp/sdpy-c"},
        {"XDG_RUNTIME_DIR": "{tmp}"},
        {"XDG_RUNTIME_DIR": "/nowhere"},
        {"TMPDIR": "{tmp}"},
        {},
    ],
)
def test_the_root_is_where_the_pipeline_looks(environment: pytest.MonkeyPatch, variables: Dict[str, str]) -> None:
    temporary = Path(subprocess.check_output(["mktemp", "-d", "/tmp/sdpyXXX"], text=True).strip())
    try:
        for name, value in variables.items():
            environment.setenv(name, value.format(tmp=temporary))
        said = subprocess.run(
            [binary(), "status", "--once", "--instance", "nobody"], capture_output=True, text=True, timeout=60
        ).stderr
        assert f"in {usual_root()}" in said, (usual_root(), said)
        assert str(Place("nobody", None).root) == os.path.abspath(usual_root())
    finally:
        temporary.rmdir()


def test_nothing_is_left_where_nothing_runs(rig: Rig) -> None:
    with pytest.raises(semidense.NotRunning, match="nothing is running as instance `semidense` in"):
        semidense.poses(root=rig.root, timeout=0.0)
    with pytest.raises(TimeoutError):
        semidense.save_map("x", root=rig.root)
    assert not rig.root.exists()
    rig.root.mkdir()
    with pytest.raises(semidense.NotRunning):
        semidense.keyframes(root=rig.root, timeout=0.2)
    assert list(rig.root.iterdir()) == []


def test_names_and_folders_are_checked() -> None:
    for bad in ("", "a/b", "ä", "x" * 33):
        with pytest.raises(semidense.BadPlace):
            semidense.poses(bad)
    with pytest.raises(semidense.BadPlace, match="48 bytes"):
        semidense.poses(root="/tmp/" + "x" * 60)
    with pytest.raises(TypeError):
        semidense.Reader()


def test_a_run_that_comes_later_is_waited_for_and_leaves_nothing(rig: Rig) -> None:
    import threading

    found = []
    waiting = threading.Thread(target=lambda: found.append(next(semidense.poses(root=rig.root, timeout=WATCH_DOG_SECS))))
    waiting.start()
    child = rig.live()
    waiting.join(WATCH_DOG_SECS)
    assert found and found[0].sequence >= 0
    rig.end(child)
    prefix = prefix_of(str(rig.root))
    until(lambda: not [name for name in os.listdir("/dev/shm") if name.startswith(prefix)])


def test_another_wire_version_is_refused_with_both(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.live()
    next(semidense.poses(root=rig.root, timeout=WATCH_DOG_SECS))
    other = _wire.WIRE_VERSION + 1
    monkeypatch.setattr(_ports, "WIRE_VERSION", other)
    with pytest.raises(semidense.WireVersion, match=f"wire version {_wire.WIRE_VERSION}, this package {other}") as told:
        semidense.poses(root=rig.root, timeout=WATCH_DOG_SECS)
    assert (told.value.found, told.value.ours) == (_wire.WIRE_VERSION, other)
    with pytest.raises(semidense.WireVersion):
        semidense.save_map("x", root=rig.root)
