"""What runs inside a network namespace of test_two_hosts.py: a camera that goes to and fro over a recording, and a listener that writes down what comes."""

from __future__ import annotations

import itertools
import json
import sys
import time
from pathlib import Path

import cv2
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from thegra_core.sources.open import camera_for, open_recording
from thegra_ros.codec.images import camera_info_message, image_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.qos import LOSSLESS, RELIABLE

LEAST_S, MOST_S = 0.2, 1.5
"""Between two images: until the frame before is done, but no longer, for the link may be cut."""


def camera(recording: str, transport: str, works: str) -> None:
    """Publish the frames forwards, backwards, forwards, ... with stamps that rise, so that every place is seen again."""
    opened = open_recording(Path(recording))
    frames, model = list(opened.frames()), camera_for(opened, None)
    node = rclpy.create_node("camera", namespace="/thegra")
    raw = transport == "raw"
    images = node.create_publisher(Image if raw else CompressedImage, "image_raw" if raw else "image_raw/compressed", RELIABLE)
    infos = node.create_publisher(CameraInfo, "camera_info", RELIABLE)
    done: list[int] = [0]
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: done.extend(processed(m, works)), LOSSLESS)
    for count, frame in enumerate(itertools.cycle([*frames, *frames[-2:0:-1]])):
        stamped = header(frames[0].stamp_ns + count * 100_000_000, "thermal_camera")
        infos.publish(camera_info_message(stamped, model))
        if raw:
            images.publish(image_message(stamped, frame.image))
        else:
            message = CompressedImage(header=stamped, format="mono16; png compressed")
            message.data.frombytes(cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
            images.publish(message)
        begin, before = time.monotonic(), done[-1]
        while (passed := time.monotonic() - begin) < LEAST_S or (passed < MOST_S and done[-1] == before):
            rclpy.spin_once(node, timeout_sec=0.1)


def processed(message: DiagnosticArray, works: str) -> list[int]:
    """How many frames the node of that name says it has worked on."""
    return [int(v.value) for status in message.status if status.name.endswith(works) for v in status.values if v.key == "processed"]


def listener(file: str) -> None:
    """One line of JSON for each pose, and for each word of /diagnostics."""
    node = rclpy.create_node("listener", namespace="/thegra")
    with Path(file).open("w", buffering=1) as out:

        def write(**what: object) -> None:
            out.write(json.dumps(what) + "\n")

        def say(message: DiagnosticArray) -> None:
            for status in message.status:
                write(node=status.name, **{value.key: value.value for value in status.values})

        node.create_subscription(PoseWithCovarianceStamped, "pose", lambda m: write(pose=stamp_ns(m)), LOSSLESS)
        node.create_subscription(DiagnosticArray, "/diagnostics", say, LOSSLESS)
        rclpy.spin(node)


if __name__ == "__main__":
    rclpy.init(args=[])
    {"camera": camera, "listener": listener}[sys.argv[1]](*sys.argv[2:])
