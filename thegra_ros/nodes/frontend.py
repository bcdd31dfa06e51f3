"""Pre-processed images in; features, and their matches to the reference keyframe, out.

Where keypoints are followed, tracking says of each image whether they are enough, and what is to be detected if they are not; the next image waits for that.
"""

from __future__ import annotations

import queue
import sys
import time
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from thegra_core.features.front_end import DetectAndFollow, DetectEach
from thegra_core.features.protocols import FrontEnd, Wanted
from thegra_core.features.registry import make_extractor, make_first_matcher
from thegra_core.features.tracks import shared_tracks
from thegra_core.messages import Features, Frame, Matches, Shutter
from thegra_core.tracking.fixed_pattern import FixedPatternMask
from thegra_ros.codec.images import frame_from_image
from thegra_ros.codec.rounds import read_verdict, round_clouds
from thegra_ros.codec.shutter import read_notice
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.joiner import FrameJoiner
from thegra_ros.lifecycle import run_node
from thegra_ros.qos import LATCHED, LOSSLESS, STREAM
from thegra_ros.stage_node import StageNode

REMEMBERED = 300
"""Frames whose features are kept: the reference is one of them. Matches to an older one are tracking's own."""

PATIENCE_S = 5.0
"""After so long a wait for tracking the next image is taken."""
WAKE_S = 0.2


class FrontendNode(StageNode):
    """The second stage."""

    def __init__(self) -> None:
        super().__init__("frontend")

    def prepare(self) -> None:
        self._features = self.publisher(PointCloud2, "features", LOSSLESS)
        self._matches = self.publisher(PointCloud2, "matches", LOSSLESS)
        self._known: OrderedDict[int, Features] = OrderedDict()
        self._pattern, self._reference_ns, self._epoch = FixedPatternMask(), 0, -1
        self._joiner = FrameJoiner("notice", lambda parts: "image" in parts or _closed(parts), _closed)
        self.listen(DiagnosticArray, "shutter", LOSSLESS, lambda m: self._join("notice", m))
        self.listen(Image, "image_preprocessed", STREAM, lambda m: self._join("image", m))
        self._verdicts = queue.SimpleQueue[Header]()
        self.listen(Header, "reference", LATCHED, self._on_reference)
        self.listen(Header, "wanted", LOSSLESS, self._verdicts.put)

    def load(self) -> None:
        extractor = make_extractor(self.config.extractor)
        self._matcher = make_first_matcher(self.config)
        self._front: FrontEnd = DetectAndFollow(extractor, self.config.flow) if self.config.flow.enabled else DetectEach(extractor)

    def work(self, item: Mapping[str, Any]) -> None:
        notice = read_notice(item["notice"])
        if notice.epoch != self._epoch:
            self._epoch = notice.epoch
            self._forget()
        if notice.shutter.recalibrated:
            self._pattern.forget()
        self._see(frame_from_image(item["image"], 0), notice.frame_id)

    def begin_anew(self, why: str) -> None:
        self._forget()

    def facts(self) -> dict[str, object]:
        return {"lost": self._joiner.lost}

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _see(self, frame: Frame, frame_id: str) -> None:
        """Send followed keypoints if there are any and tracking does with them, else detected ones."""
        reference = self._known.get(self._reference_ns)
        followed, wanted = self._front.follow(frame.image, frame.stamp_ns), Wanted.MORE
        if followed is not None:
            features = self._pattern.apply(followed)
            matches = shared_tracks(features, reference) if reference is not None else no_matches(features)
            self._send(features, matches, reference, frame_id, followed=True)
            verdict = self._verdict(frame.stamp_ns)
            if verdict is None:
                return
            wanted = verdict
        features = self._pattern.apply(self._front.detect(wanted))
        matches = self._matcher.match(features, reference) if reference is not None else no_matches(features)
        self._send(features, matches, reference, frame_id, followed=False)

    def _send(self, features: Features, matches: Matches, reference: Features | None, frame_id: str, followed: bool) -> None:
        if reference is not None and self.config.tracking.mask_fixed_pattern:
            matches = self._pattern.learn(features, reference, matches)
        for publisher, cloud in zip((self._features, self._matches), round_clouds(header(features.stamp_ns, frame_id), features, matches, followed), strict=True):
            publisher.publish(cloud)
        self._known[features.stamp_ns] = features
        if len(self._known) > REMEMBERED:
            self._known.pop(next(stamp for stamp in self._known if stamp != self._reference_ns))

    def _verdict(self, stamp: int) -> Wanted | None:
        """What tracking says to followed keypoints; None: they are enough, or it says nothing."""
        end = time.monotonic() + PATIENCE_S
        while not self.stopping.is_set() and (rest := end - time.monotonic()) > 0:
            try:
                message = self._verdicts.get(timeout=min(rest, WAKE_S))
            except queue.Empty:
                continue
            if stamp_ns(message) == stamp:
                return read_verdict(message)
        if not self.stopping.is_set():
            self.get_logger().warning("waiting for the node tracking, which does not answer", throttle_duration_sec=PATIENCE_S)
        return None

    def _forget(self) -> None:
        self._known.clear()
        self._pattern.forget()
        self._front.forget()

    # ---- callbacks ------------------------------------------------------------------------------------------------------------------

    def _join(self, part: str, message: Any) -> None:
        if not self.active:
            return
        if part == "image":
            self.health.image_came()
        for frame in self._joiner.add(part, stamp_ns(message), message):
            if "image" in frame:
                self.enqueue(frame)

    def _on_reference(self, message: Header) -> None:
        self._reference_ns = stamp_ns(message)


def _closed(parts: Mapping[str, Any]) -> bool:
    return "notice" in parts and read_notice(parts["notice"]).shutter.shutter is Shutter.CLOSED


def no_matches(features: Features) -> Matches:
    """Where there is no reference to match to."""
    return Matches(features.stamp_ns, 0, np.empty((0, 2), np.int32), np.empty(0, np.float32))


def main() -> None:
    """The executable `frontend`."""
    sys.exit(run_node(FrontendNode))


if __name__ == "__main__":
    main()
