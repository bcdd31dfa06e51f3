"""A rosbag2 folder (mcap) with image, camera_info and ground truth, and the text files beside the bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer

from thegra_core.simulation.recording import Simulated
from thegra_core.simulation.writers.files import write_beside
from thegra_core.simulation.writers.messages import CAMERA_INFO, IMAGE, ODOMETRY, Messages

IMAGE_TOPIC = "/thermal/image_raw"
CAMERA_TOPIC = "/thermal/camera_info"
TRUTH_TOPIC = "/ground_truth/odometry"
CAMERA_FRAME = "thermal_camera"
WORLD_FRAME = "world"
TRANSPORT_NS = 23_000_000
"""Time from exposure to receipt, ns: receive times differ from header stamps, as in every real recording."""


def write_mcap(out_dir: Path, recording: Simulated) -> Path:
    """Write a recording; returns `out_dir`, the rosbag2 folder."""
    out_dir.parent.mkdir(parents=True, exist_ok=True)
    if out_dir.exists():
        out_dir.rmdir()  # empty: the bag's writer wants to make it
    messages = Messages(ros1=False)
    truth: list[tuple[int, NDArray[np.float64]]] = []
    with Writer(out_dir, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        types = {IMAGE_TOPIC: IMAGE, TRUTH_TOPIC: ODOMETRY} | ({CAMERA_TOPIC: CAMERA_INFO} if recording.camera is not None else {})
        connections = {topic: bag.add_connection(topic, name, typestore=messages.typestore) for topic, name in types.items()}

        def write(topic: str, stamp_ns: int, message: object) -> None:
            bag.write(connections[topic], stamp_ns + TRANSPORT_NS, messages.bytes_of(message, types[topic]))

        for tick in recording.ticks:
            if tick.image is not None:
                write(IMAGE_TOPIC, tick.stamp_ns, messages.image(tick.stamp_ns, tick.image, CAMERA_FRAME))
                if recording.camera is not None:
                    write(CAMERA_TOPIC, tick.stamp_ns, messages.camera_info(tick.stamp_ns, recording.camera, CAMERA_FRAME))
            if tick.world_from_camera is not None:
                write(TRUTH_TOPIC, tick.stamp_ns, messages.odometry(tick.stamp_ns, tick.world_from_camera, WORLD_FRAME, CAMERA_FRAME))
                truth.append((tick.stamp_ns, tick.world_from_camera))
    write_beside(out_dir, recording, truth)
    return out_dir
