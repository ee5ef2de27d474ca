"""Writes a bag as rosbags does for `ros2 bag`, and one with the mcap package: FOLDER gets rosbags/ and mcap-COMPRESSION.mcap."""

import sys
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

folder = Path(sys.argv[1])
store = get_typestore(Stores.ROS2_HUMBLE)
types = store.types
WIDTH, HEIGHT, FRAMES = 64, 48, 12


def header(i):
    time = types["builtin_interfaces/msg/Time"](sec=100 + i, nanosec=500)
    return types["std_msgs/msg/Header"](stamp=time, frame_id="camera")


def image(i):
    red, green, blue = (np.full((HEIGHT, WIDTH), 10 * i + c, np.uint8) for c in (0, 1, 2))
    data = np.stack([blue, green, red], axis=-1).reshape(-1)
    return types["sensor_msgs/msg/Image"](
        header=header(i), height=HEIGHT, width=WIDTH, encoding="bgr8", is_bigendian=0, step=3 * WIDTH, data=data
    )


def camera(i):
    roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    k = np.array([50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1])
    p = np.array([50.0, 0, 31.5, 0, 0, 50.0, 23.5, 0, 0, 0, 1, 0])
    return types["sensor_msgs/msg/CameraInfo"](
        header=header(i), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=np.zeros(5), k=k,
        r=np.eye(3).reshape(-1), p=p, binning_x=0, binning_y=0, roi=roi,
    )


with Writer(folder / "rosbags", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    images = writer.add_connection("/cam/image_raw", "sensor_msgs/msg/Image", typestore=store)
    cameras = writer.add_connection("/cam/camera_info", "sensor_msgs/msg/CameraInfo", typestore=store)
    for i in range(FRAMES):
        writer.write(cameras, i, store.serialize_cdr(camera(i), "sensor_msgs/msg/CameraInfo"))
        writer.write(images, i, store.serialize_cdr(image(i), "sensor_msgs/msg/Image"))

for compression in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
    path = folder / f"mcap-{compression.name.lower()}.mcap"
    with open(path, "wb") as file:
        from mcap.writer import Writer as Plain

        writer = Plain(file, chunk_size=20_000, compression=compression)
        writer.start(profile="ros2", library="test")
        for name, topic, make in (
            ("sensor_msgs/msg/CameraInfo", "/cam/camera_info", camera),
            ("sensor_msgs/msg/Image", "/cam/image_raw", image),
        ):
            schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode())
            channel = writer.register_channel(topic, "cdr", schema)
            for i in range(FRAMES):
                data = bytes(store.serialize_cdr(make(i), name))
                writer.add_message(channel, log_time=i, data=data, publish_time=i)
        writer.finish()
