"""Images between two processes: none is lost with the profile that ships, and what is lost without one is said."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from ros_graph import LIMIT_S, Graph
from sensor_msgs.msg import CompressedImage

from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.environment import config_file
from thegra_ros.gap_watch import SPAN, GapWatch
from thegra_ros.live import LiveOptions, ros_arguments
from thegra_ros.qos import LOSSLESS

S = 10**9
COUNT = 100
RATE_HZ = 20


def shares(stamps: list[int]) -> list[float]:
    watch = GapWatch()
    return [share for share in map(watch.missing, stamps) if share is not None]


@pytest.mark.parametrize("lost", [0.0, 0.3, 0.6])
def test_the_share_of_missing_images_is_told(lost: float) -> None:
    rng = np.random.default_rng(0)
    kept = [i for i in range(4000) if rng.random() >= lost]
    jitter = rng.normal(0, 0.5e6, 4000)
    told = shares([i * S // RATE_HZ + int(jitter[i]) for i in kept])
    assert len(told) == len(kept) // SPAN
    assert np.median(told) == pytest.approx(lost, abs=0.06)


def test_a_slow_stream_that_pauses_now_and_then_loses_nothing() -> None:
    stamps = [i * 3 * S + (i // 30) * 20 * S for i in range(10 * SPAN)]
    assert max(shares(stamps)) < 0.25


def test_missing_images_are_said_where_no_profile_is_set(graph: Graph, frames) -> None:
    """Every second image is there, at the period of the camera now and then, as when a best-effort topic loses them."""
    graph.environment.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
    node = graph.start("thegra_ros.nodes.preprocessing")
    graph.wait_for_listener()
    rng = np.random.default_rng(1)
    times = [i for i in range(4 * SPAN) if rng.random() > 0.5]
    graph.send([replace(frames[0], stamp_ns=S + i * S // RATE_HZ) for i in times[: SPAN + 5]])
    graph.wait(lambda: "images are missing" in node.output, "a word about the loss")
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" in node.output
    assert node.end() == 0


def test_compressed_images_are_taken_from_beside_the_topic_that_is_named(graph: Graph) -> None:
    images = graph.node.create_publisher(CompressedImage, "/boson/image_raw/compressed", 5)
    node = graph.start(parameters={"image_transport": "compressed"}, extra=ros_arguments(LiveOptions("boson/image_raw"))[1:])
    graph.wait(lambda: images.get_subscription_count() > 0, "the node")
    graph.wait(lambda: "images from /boson/image_raw/compressed" in node.output, "a word of where images come from")
    assert node.end() == 0


@pytest.mark.slow
def test_no_image_is_lost_between_two_processes_with_the_profile(graph: Graph, tmp_path: Path) -> None:
    """640x512 of 16 bit at 20 Hz, best effort as a camera driver's subscribers have it."""
    folder = tmp_path / "images"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(COUNT):
        assert cv2.imwrite(str(folder / f"{i:04d}.png"), rng.integers(7000, 7200, (512, 640), dtype=np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 0])
    (folder / "images.txt").write_text("".join(f"{1000 + i / RATE_HZ:.6f} {i:04d}.png\n" for i in range(COUNT)))
    (folder / "camera.txt").write_text("400,400,320,256\n")
    graph.environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(config_file("fastdds.xml"))
    best_effort = {"qos_overrides./thegra/image_raw.subscription.reliability": "best_effort", "qos_overrides./thegra/image_raw.subscription.depth": "5"}
    graph.start("thegra_ros.nodes.preprocessing", best_effort)
    notices = graph.listen(DiagnosticArray, "shutter", LOSSLESS)
    graph.wait(lambda: bool(graph.received["/diagnostics"]), "the node")
    command = [sys.executable, "-m", "thegra_core.cli.main", "play", str(folder), "--camera", str(folder / "camera.txt"), "--wait", str(LIMIT_S)]
    with subprocess.Popen(command, env=graph.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as play:
        graph.wait(lambda: play.poll() is not None, "the end of the recording")
    assert play.returncode == 0
    last = (1000 * RATE_HZ + COUNT - 1) * S // RATE_HZ
    graph.wait(lambda: bool(notices) and stamp_ns(notices[-1]) >= last, "the last image")
    steps = np.diff([stamp_ns(m) for m in notices])
    assert len(notices) > 0.9 * COUNT, "those before the two have found each other do not count"
    assert (steps == S // RATE_HZ).all()
