"""How much later odometry is in the hands of a DDS reader than its pose in shared memory.

latency.py INSTANCE SECONDS [pose] [image] [points]: reads `odom` of the instance, and what else is named, with Cyclone
DDS, and the poses themselves with python/semidense, and prints the median and the 99th percentile, milliseconds. Needs
cyclonedds, iceoryx2 and numpy, and python/ on PYTHONPATH.
"""

import sys
import threading
import time

import semidense
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import messages as m

RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
BEST_EFFORT = Policy.Reliability.BestEffort


def main():
    instance, seconds, wanted = sys.argv[1], float(sys.argv[2]), sys.argv[3:]
    published = {}

    def watch():
        for pose in semidense.poses(instance=instance):
            published[int(pose.realtime_nanos)] = int(pose.published_nanos)

    threading.Thread(target=watch, daemon=True).start()
    participant = DomainParticipant(0)

    def reader(name, kind, reliability):
        qos = Qos(reliability, Policy.Durability.Volatile, Policy.History.KeepLast(20))
        return DataReader(participant, Topic(participant, "rt" + name, kind), qos=qos)

    own = "/" + instance
    odometry = reader(own + "/odom", m.Odometry, RELIABLE)
    others = {
        "pose": lambda: reader(own + "/pose", m.PoseWithCovarianceStamped, RELIABLE),
        "image": lambda: reader(own + "/image_rect", m.Image, BEST_EFFORT),
        "points": lambda: reader(own + "/points", m.PointCloud2, BEST_EFFORT),
    }
    others = [others[name]() for name in wanted]
    end = time.monotonic() + seconds

    def drain():
        while time.monotonic() < end:
            for other in others:
                other.take(20)
            time.sleep(0.02)

    threading.Thread(target=drain, daemon=True).start()
    waits = WaitSet(participant)
    waits.attach(ReadCondition(odometry, SampleState.NotRead | ViewState.Any | InstanceState.Any))
    came = []
    while time.monotonic() < end:
        waits.wait(duration(milliseconds=200))
        now = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        came += [(one.header.stamp.sec * 10**9 + one.header.stamp.nanosec, now) for one in odometry.take(20)]
    time.sleep(0.2)
    late = sorted((now - published[stamp]) / 1e6 for stamp, now in came if stamp in published)
    if not late:
        sys.exit(f"none of {len(came)} odometry messages has the stamp of a pose")
    at = lambda share: late[min(len(late) - 1, int(len(late) * share))]
    print(f"{len(late)} of {len(came)} matched; median {at(0.5):.2f} ms, p99 {at(0.99):.2f} ms, max {late[-1]:.2f} ms")


main()
