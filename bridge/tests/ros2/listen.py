"""Reads a robot's topics with Cyclone DDS and writes what came: listen.py DOMAIN NAMESPACE FOLDER NUM_POSES.

Ends when as many poses have come on each of their topics and one of everything else, or after some minutes.
`poses.json` has the small messages, `cloud.bin` and `image.bin` the bytes of the last cloud and image.
"""

import json
import os
import sys
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import messages as m

RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
BEST_EFFORT = Policy.Reliability.BestEffort
LATE = Policy.Durability.TransientLocal
LONGEST_S = 200
# Topics with a message for every pose, and processes that say how they are, one a message.
OF_EVERY_POSE = ("odometry", "odometry_best_effort", "pose", "tf")
NUM_SPEAKERS = 4


def reader(participant, name, kind, reliability, depth=10, durability=Policy.Durability.Volatile):
    qos = Qos(reliability, durability, Policy.History.KeepLast(depth))
    return DataReader(participant, Topic(participant, name, kind), qos=qos)


def header(message):
    stamp = message.header.stamp
    return {"stamp": stamp.sec * 10**9 + stamp.nanosec, "frame": message.header.frame_id}


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def pose(pose):
    q = pose.orientation
    return xyz(pose.position) + [q.x, q.y, q.z, q.w]


def odometry(message):
    twist = message.twist.twist
    return header(message) | {
        "child": message.child_frame_id,
        "pose": pose(message.pose.pose),
        "covariance": list(message.pose.covariance),
        "twist": xyz(twist.linear) + xyz(twist.angular),
        "twist_covariance": list(message.twist.covariance),
    }


def transforms(message):
    def one(stamped):
        t, q = stamped.transform.translation, stamped.transform.rotation
        value = xyz(t) + [q.x, q.y, q.z, q.w]
        return header(stamped) | {"child": stamped.child_frame_id, "transform": value}

    return [one(stamped) for stamped in message.transforms]


def main():
    domain, namespace, folder, num_poses = int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
    participant = DomainParticipant(domain)
    own = "rt" + namespace
    readers = {
        # As rviz, nav2 and tf2 read them.
        "odometry": reader(participant, own + "/odom", m.Odometry, RELIABLE, 100),
        "odometry_best_effort": reader(participant, own + "/odom", m.Odometry, BEST_EFFORT, 100),
        "pose": reader(participant, own + "/pose", m.PoseWithCovarianceStamped, RELIABLE, 100),
        "tf": reader(participant, "rt/tf", m.TFMessage, RELIABLE, 100),
        "tf_static": reader(participant, "rt/tf_static", m.TFMessage, RELIABLE, 10, LATE),
        "keyframes": reader(participant, own + "/keyframes", m.PoseArray, RELIABLE, 1, LATE),
        "diagnostics": reader(participant, "rt/diagnostics", m.DiagnosticArray, RELIABLE),
        "cloud": reader(participant, own + "/points", m.PointCloud2, BEST_EFFORT, 5),
        "cloud_reliable": reader(participant, own + "/points", m.PointCloud2, RELIABLE, 5),
        "image": reader(participant, own + "/image_rect", m.Image, BEST_EFFORT, 5),
        "camera_info": reader(participant, own + "/camera_info", m.CameraInfo, BEST_EFFORT, 5),
        "nodes": reader(participant, "ros_discovery_info", m.ParticipantEntitiesInfo, RELIABLE, 10, LATE),
    }
    came = {name: [] for name in readers}
    begin = time.monotonic()
    optional = {"cloud_reliable"}
    while time.monotonic() - begin < LONGEST_S:
        for name, one in readers.items():
            for message in one.take(32):
                if hasattr(message, "sample_info") and not message.sample_info.valid_data:
                    continue
                came[name].append(message)
        is_whole = all(came[name] or name in optional for name in readers)
        speakers = {status.name for message in came["diagnostics"] for status in message.status}
        if is_whole and len(speakers) >= NUM_SPEAKERS and all(len(came[name]) >= num_poses for name in OF_EVERY_POSE):
            break
        time.sleep(0.0005)
    result = {
        "counts": {name: len(list_) for name, list_ in came.items()},
        "odometry": [odometry(message) for message in came["odometry"]],
        "odometry_best_effort": [odometry(message) for message in came["odometry_best_effort"]],
        "pose": [
            header(message) | {"pose": pose(message.pose.pose), "covariance": list(message.pose.covariance)}
            for message in came["pose"]
        ],
        "tf": [transforms(message) for message in came["tf"]],
        "tf_static": [transforms(message) for message in came["tf_static"]],
        "keyframes": [[pose(one) for one in message.poses] for message in came["keyframes"][-1:]],
        "diagnostics": [
            {"name": status.name, "level": status.level, "message": status.message}
            for message in came["diagnostics"]
            for status in message.status
        ],
        "nodes": [
            [node.node_namespace, node.node_name, len(node.writer_gid_seq)]
            for message in came["nodes"]
            for node in message.node_entities_info_seq
        ],
    }
    for message in came["cloud"][-1:]:
        fields = [[one.name, one.offset, one.datatype, one.count] for one in message.fields]
        result["cloud"] = header(message) | {
            "width": message.width, "height": message.height, "point_step": message.point_step,
            "row_step": message.row_step, "fields": fields,
        }
        with open(os.path.join(folder, "cloud.bin"), "wb") as out:
            out.write(bytes(message.data))
    for message in came["image"][-1:]:
        result["image"] = header(message) | {
            "width": message.width, "height": message.height, "encoding": message.encoding, "step": message.step,
        }
        with open(os.path.join(folder, "image.bin"), "wb") as out:
            out.write(bytes(message.data))
    for message in came["camera_info"][-1:]:
        result["camera_info"] = header(message) | {"k": list(message.k), "p": list(message.p), "width": message.width}
    with open(os.path.join(folder, "poses.json"), "w") as out:
        json.dump(result, out)


main()
