"""Reads a recording with two independent readers and says what is in it, as JSON."""

import json
import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

path = sys.argv[1]
counts, last, first = Counter(), {}, {}
with open(path, "rb") as file:
    reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    profile = reader.get_header().profile
    statistics = reader.get_summary().statistics
    hashes = {c.topic: c.metadata.get("topic_type_hash") for c in reader.get_summary().channels.values()}
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        counts[channel.topic] += 1
        first.setdefault(channel.topic, decoded)
        last[channel.topic] = decoded

humble = get_typestore(Stores.ROS2_HUMBLE)
reliability = {}
with AnyReader([Path(path)]) as reader:
    for connection in reader.connections:
        reliability[connection.topic] = connection.ext.offered_qos_profiles[0].reliability.name
        if not connection.msgtype.startswith("semidense_msgs/"):
            assert humble.hash_rihs01(connection.msgtype) == hashes[connection.topic], connection.topic
    for connection, stamp, raw in reader.messages():
        message = reader.deserialize(raw, connection.msgtype)
        again = reader.typestore.serialize_cdr(message, connection.msgtype)
        assert bytes(again) == bytes(raw), f"{connection.topic} has other bytes when it is written again"


def numbers(value):
    return [value.x, value.y, value.z] + ([value.w] if hasattr(value, "w") else [])


odom, cloud, camera = last["/left/odom"], first["/left/points"], first["/left/camera_info"]
frame, status = last["/left/details/frame"], [s for s in [last["/diagnostics"].status[0]]]
print(
    json.dumps(
        {
            "profile": profile,
            "chunks": statistics.chunk_count,
            "counts": counts,
            "reliability": reliability,
            "stamp": [odom.header.stamp.sec, odom.header.stamp.nanosec],
            "frames": [odom.header.frame_id, odom.child_frame_id, camera.header.frame_id],
            "position": numbers(odom.pose.pose.position),
            "orientation": numbers(odom.pose.pose.orientation),
            "covariance": list(odom.pose.covariance),
            "twist_covariance": odom.twist.covariance[0],
            "transforms": [[t.header.frame_id, t.child_frame_id] for t in last["/tf"].transforms],
            "fields": [f.name for f in cloud.fields],
            "points": cloud.width,
            "cloud_bytes": len(cloud.data),
            "k": list(camera.k),
            "image_format": first["/left/image_rect/compressed"].format,
            "image_begin": list(bytes(first["/left/image_rect/compressed"].data[:4])),
            "frame": [frame.sequence, frame.capture_nanos, frame.exposure_nanos],
            "keyframe_ids": list(last["/left/details/graph"].keyframe_ids),
            "status": [s.name for s in status],
        }
    )
)
