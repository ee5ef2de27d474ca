"""A camera on ROS 2: camera.py DOMAIN TOPIC FILE WIDTH HEIGHT FX FY CX CY RATE publishes the grey frames in FILE.

Prints a line for each hundredth frame, and ends when standard input is closed; the frames go back and forth.
"""

import sys
import threading
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import messages as m


def main():
    domain, topic, file = int(sys.argv[1]), sys.argv[2], sys.argv[3]
    width, height = int(sys.argv[4]), int(sys.argv[5])
    fx, fy, cx, cy, rate = map(float, sys.argv[6:11])
    with open(file, "rb") as source:
        data = source.read()
    size = width * height
    # A list is what the binding writes; made once, it is written fast.
    frames = [list(data[at : at + size]) for at in range(0, len(data), size)]
    participant = DomainParticipant(domain)
    # As image_transport publishes: reliable, a few kept.
    qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(5))
    images = DataWriter(participant, Topic(participant, "rt" + topic, m.Image), qos=qos)
    infos = "rt" + topic.rsplit("/", 1)[0] + "/camera_info"
    infos = DataWriter(participant, Topic(participant, infos, m.CameraInfo), qos=qos)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    round_trip = 2 * (len(frames) - 1)
    sequence, due = 0, time.monotonic()
    while not ended.is_set():
        at = sequence % round_trip
        pixels = frames[at if at < len(frames) else round_trip - at]
        now = time.clock_gettime_ns(time.CLOCK_REALTIME)
        header = m.Header(m.Time(now // 10**9, now % 10**9), "camera_optical_frame")
        infos.write(m.CameraInfo(header, height, width, "plumb_bob", [0.0] * 5, k, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], p, 0, 0, m.RegionOfInterest()))
        images.write(m.Image(header, height, width, "mono8", 0, width, pixels))
        sequence += 1
        if sequence % 100 == 1:
            print(sequence, flush=True)
        due += 1 / rate
        time.sleep(max(0.0, due - time.monotonic()))


main()
