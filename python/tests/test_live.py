"""Reading a running instance."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from types import SimpleNamespace
from typing import Any, Dict

import numpy as np
import pytest
from conftest import WATCH_DOG_SECS, Rig, until

import semidense
from semidense import Frame, Graph, Health, Keyframe, Pose, ProcessState, Reader, State, _wire


def options(rig: Rig) -> Dict[str, Any]:
    return {"root": rig.root, "timeout": WATCH_DOG_SECS}


def tracked(rig: Rig, count: int) -> list[Pose]:
    return list(itertools.islice((p for p in semidense.poses(**options(rig)) if p.is_tracked), count))


def test_poses_come_in_order_with_all_they_have(running: Rig) -> None:
    poses = tracked(running, 20)
    sequences = [pose.sequence for pose in poses]
    assert sequences == sorted(set(sequences))
    for pose in poses:
        assert pose.state in (State.TRACKING, State.DEGRADED)
        assert np.allclose(pose.world_from_camera.rotation @ pose.world_from_camera.rotation.T, np.eye(3))
        assert pose.covariance.shape == (6, 6) and (np.linalg.eigvalsh(pose.covariance) > 0).all()
        assert np.array_equal(pose.map_covariance, pose.map_covariance.T)
        assert pose.published_nanos <= time.monotonic_ns()
        assert 0.0 <= pose.quality["inlier_ratio"] <= 1.0
    moving = [pose.velocity for pose in poses if pose.velocity is not None]
    assert moving and all(velocity.covariance.shape == (6, 6) for velocity in moving)


def test_velocity_is_the_change_of_the_pose(running: Rig) -> None:
    errors = []
    for before, after in itertools.pairwise(tracked(running, 30)) if sys.version_info >= (3, 10) else []:
        is_next = after.sequence == before.sequence + 1 and after.velocity is not None
        if is_next and before.epoch == after.epoch and after.velocity is not None:
            seconds = (after.capture_nanos - before.capture_nanos) / 1e9
            moved = after.world_from_camera.translation - before.world_from_camera.translation
            in_camera = after.world_from_camera.rotation.T @ moved / seconds
            scale = max(float(np.linalg.norm(in_camera)), 1e-3)
            errors.append(float(np.linalg.norm(in_camera - after.velocity.linear)) / scale)
    if sys.version_info >= (3, 10):
        assert errors and np.median(errors) < 0.1, errors


def test_a_pose_is_what_the_run_writes_down(rig: Rig) -> None:
    child = rig.run("--lockstep", "--set", "simulator.frames=40")
    seen = {f"{pose.capture_secs:.6f}": pose for pose in semidense.poses(**options(rig)) if pose.is_tracked}
    child.wait(WATCH_DOG_SECS)
    written = semidense.load(rig.output).trajectory_online
    assert written is not None
    both = [(seen[f"{t:.6f}"].world_from_camera, pose) for t, pose in written if f"{t:.6f}" in seen]
    # Lockstep outruns the joining reader by at most a thousand poses, which are kept for it.
    assert len(both) > 20
    for ours, theirs in both:
        assert np.allclose(ours.matrix, theirs.matrix, atol=1e-6)


def test_a_keyframe_is_whole_and_has_the_image_of_its_frame(running: Rig) -> None:
    frames: Dict[int, Any] = {}
    with Reader(Frame, Keyframe, **options(running)) as reader:
        for message in reader:
            if isinstance(message, Frame):
                assert message.image.shape == (120, 160) and not message.image.flags.writeable
                frames[message.sequence] = message.copy().image
            elif isinstance(message, Keyframe):
                keyframe = message.copy()
                if keyframe.sequence in frames or len(frames) > 300:
                    break
    assert keyframe.image.shape == (120, 160) and len(keyframe.points) > 500
    if keyframe.sequence in frames:
        assert np.array_equal(frames[keyframe.sequence], keyframe.image)
    points = keyframe.points[keyframe.has_depth]
    depth = keyframe.depth()
    assert np.allclose(depth[points["v"], points["u"]], 1 / points["inverse_depth"])
    assert np.isnan(depth).sum() == depth.size - len(points)
    # Projecting the points back gives their pixels.
    projected = keyframe.points_in_keyframe() @ keyframe.intrinsics.matrix.T
    assert np.allclose(projected[:, 0] / projected[:, 2], points["u"], atol=1e-6)
    in_map = keyframe.points_in_map()
    assert np.allclose(keyframe.map_from_keyframe.inverse() @ in_map, keyframe.points_in_keyframe(), atol=1e-6)
    assert keyframe.place_covariance.shape == (7, 7) and keyframe.mode_covariance.shape == (3, 3)


def test_graph_and_health(running: Rig) -> None:
    graph = next(semidense.graph(**options(running)))
    assert isinstance(graph, Graph) and len(graph) >= 1 and graph.positions().shape == (len(graph), 3)
    seen: Dict[str, Health] = {}
    for health in semidense.health(**options(running)):
        seen[health.process] = health
        if len(seen) == 3 and all(h.frames > 0 for h in seen.values()):
            break
    assert seen["capture"].source.startswith("loop:") and seen["capture"].process_id > 0
    latency = seen["tracker"].latency_ms(0.5)
    assert latency is not None and latency > 0


def test_too_many_held_is_said_and_a_copy_may_be_kept(running: Rig) -> None:
    held = []
    with pytest.raises(semidense.TooManyHeld, match=r"4 messages are held.*copy\(\)"):
        for frame in semidense.frames(**options(running)):
            held.append(frame)
    assert len(held) == 4
    held.clear()
    copies = [frame.copy() for frame in itertools.islice(semidense.frames(**options(running)), 12)]
    assert len({frame.sequence for frame in copies}) == 12
    kept = list(itertools.islice(semidense.keyframes(**options(running)), 5))
    assert len({k.revision for k in kept}) == 5 and not kept[0].points.flags.writeable


def test_points_of_a_keyframe_may_stay_in_shared_memory(running: Rig) -> None:
    revisions = set()
    for keyframe in semidense.keyframes(copy=False, **options(running)):
        assert not keyframe.points.flags.owndata and not keyframe.points.flags.writeable
        revisions.add(keyframe.revision)
        points, before = keyframe.points, keyframe.points.copy()
        assert np.array_equal(points, before) and len(points) > 100
        del keyframe, points
        if len(revisions) == 5:
            break
    with pytest.raises(semidense.TooManyHeld, match="1 messages are held"):
        held = []
        for keyframe in semidense.keyframes(copy=False, **options(running)):
            held.append(keyframe)


def test_what_is_held_outlives_the_reader(running: Rig) -> None:
    frame = next(semidense.frames(**options(running)))
    image, before = frame.image, frame.copy().image
    del frame
    # Frames that arrive now would overwrite it if it were released.
    list(itertools.islice(semidense.poses(**options(running)), 30))
    assert np.array_equal(image, before)


def test_a_map_is_saved(running: Rig) -> None:
    tracked(running, 1)
    folder = running.folder / "map"
    until(lambda: saved(running, folder))
    assert any(folder.iterdir())
    with pytest.raises(semidense.CommandFailed, match="mapper: "):
        semidense.load_map(running.folder / "nothing", root=running.root)


def saved(rig: Rig, folder: Any) -> bool:
    try:
        semidense.save_map(folder, root=rig.root)
    except semidense.CommandFailed as error:
        # Before the first keyframe there is nothing to save.
        assert "map" in str(error)
        return False
    return True


def test_two_readers_at_a_time(running: Rig) -> None:
    first, second = semidense.poses(**options(running)), semidense.poses(**options(running))
    sequences = [next(first).sequence for _ in range(5)], [next(second).sequence for _ in range(5)]
    for of_one in sequences:
        assert of_one == sorted(set(of_one))


def test_the_loop_ends_with_the_run_and_follows_to_the_next(rig: Rig) -> None:
    child = rig.live()
    ending = semidense.poses(**options(rig))
    following = semidense.poses(**options(rig), follow=True)
    next(ending)
    # Two seconds: the next run is joined sooner after its start.
    highest = next(pose.sequence for pose in following if pose.sequence >= 60)
    rig.end(child)
    rest = [pose.sequence for pose in ending]
    assert rest == sorted(set(rest))
    rig.output = rig.folder / "second"
    rig.live()

    def has_begun_anew() -> bool:
        nonlocal highest
        sequence = next(following).sequence
        is_before, highest = sequence < highest, max(highest, sequence)
        return is_before

    until(has_begun_anew)


class Topic:
    """A topic with the messages of its publisher, which late subscribers get as well."""

    def __init__(self, *messages: Any) -> None:
        self.messages = list(messages)

    def receive(self) -> Any:
        taken = [self.messages.pop(0)] if self.messages else []
        return SimpleNamespace(payload=lambda: taken) if taken else None


def test_the_end_of_a_mirrored_run_is_not_read_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    running, finished = ProcessState.RUNNING, ProcessState.FINISHED
    failed, stale = ProcessState.FAILED, ProcessState.STALE
    paths = ["capture/health", "tracker/health", "mapper/health"]

    def pose(sequence: int) -> Any:
        message = _wire.PoseMessage(state=1, sequence=sequence)
        for place in (message.world_from_camera, message.map_from_camera, message.keyframe_from_camera):
            place[3] = 1.0
        return message

    # A run that is interrupted, and its end, which a mirror shows first as it is and then as stale, until the next.
    runs = iter([[failed, finished, finished], [failed, finished, finished], [stale] * 3])

    class Shown:
        def __init__(self, *_: Any) -> None:
            states = next(runs)
            health = [Topic(_wire.HealthMessage(state=state.value)) for state in states]
            self.subscribers = dict(zip(paths, health))
            self.subscribers["tracker/pose"] = Topic(pose(41))
            self.is_stale = stale in states

        def wait(self, _: float) -> None:
            assert self.is_stale
            self.subscribers["tracker/health"].messages.append(_wire.HealthMessage(state=running.value))
            self.subscribers["tracker/pose"].messages.append(pose(7))
            # All processes end before the reader looks again.
            for path in paths:
                self.subscribers[path].messages.append(_wire.HealthMessage(state=finished.value))

        def close(self) -> None:
            pass

    monkeypatch.setattr(semidense.reader, "Ports", Shown)
    poses = semidense.poses(follow=True)
    assert [next(poses).sequence for _ in range(2)] == [41, 7]


def test_a_read_without_a_timeout_notices_the_end_of_the_run(rig: Rig) -> None:
    child = rig.live()
    reader = Reader(Pose, **options(rig))
    until(lambda: bool(reader.read()))
    rig.end(child)

    def has_ended() -> bool:
        reader.read()
        return not reader.is_open

    until(has_ended)


def test_ctrl_c_ends_the_command_line(running: Rig) -> None:
    command = [sys.executable, "-m", "semidense", "--root", str(running.root)]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None
    lines = [child.stdout.readline() for _ in range(4)]
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=WATCH_DOG_SECS)
    assert child.returncode == 130 and errors == ""
    assert lines[0].startswith("#") and len(lines[1].split()) >= 10


def test_ctrl_c_while_waiting_for_an_instance(rig: Rig) -> None:
    code = "import semidense; print('waits', flush=True); next(semidense.poses(root='" + str(rig.root) + "'))"
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "waits\n"
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=WATCH_DOG_SECS)
    assert "KeyboardInterrupt" in errors


def test_json_has_every_pose(running: Rig) -> None:
    import json

    command = [sys.executable, "-m", "semidense", "--root", str(running.root), "--json", "--count", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WATCH_DOG_SECS, check=True)
    poses = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(poses) == 3 and len(poses[0]["world_from_camera"]["quaternion"]) == 4


def test_too_many_readers_are_told_who_has_the_places(running: Rig) -> None:
    readers = []
    expected = rf"capture/frame already has its maximum of \d+ subscribers.*process {os.getpid()}"
    with pytest.raises(semidense.TooManyReaders, match=expected):
        for _ in range(20):
            readers.append(Reader(Frame, **options(running)))
    for reader in readers:
        reader.close()
    next(semidense.frames(**options(running)))


def test_a_long_wait_says_what_for(caplog: pytest.LogCaptureFixture) -> None:
    with tempfile.TemporaryDirectory(prefix="sd") as root, pytest.raises(semidense.NotRunning):
        semidense.poses("absent", root=root, timeout=1.5)
    said = [record.getMessage() for record in caplog.records if record.name == "semidense"]
    assert len(said) == 1 and "instance `absent`" in said[0] and "semidense run" in said[0]
