"""Pre-processed images in; features, and their matches to the reference keyframe, out."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.messages import Features, Shutter
from thegra_core.tracking.fixed_pattern import FixedPatternMask
from thegra_ros.codec.clouds import cloud_message
from thegra_ros.codec.images import frame_from_image
from thegra_ros.codec.records import features_table, matches_table
from thegra_ros.codec.shutter import read_notice
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.joiner import FrameJoiner
from thegra_ros.lifecycle import run_node
from thegra_ros.qos import LATCHED, LOSSLESS, STREAM
from thegra_ros.stage_node import StageNode

REMEMBERED = 300
"""Frames whose features are kept: the reference is one of them. Matches to an older one are tracking's own."""


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
        self.listen(Header, "reference", LATCHED, self._on_reference)

    def load(self) -> None:
        self._extractor, self._matcher = make_extractor(self.config.extractor), make_matcher(self.config.matcher, self.config.extractor)

    def work(self, item: Mapping[str, Any]) -> None:
        notice = read_notice(item["notice"])
        if notice.epoch != self._epoch:
            self._epoch = notice.epoch
            self._known.clear()
            self._pattern.forget()
        if notice.shutter.recalibrated:
            self._pattern.forget()
        frame = frame_from_image(item["image"], 0)
        features = self._pattern.apply(self._extractor.extract(frame.image, frame.stamp_ns))
        stamped = header(frame.stamp_ns, notice.frame_id)
        table = features_table(features)
        self._features.publish(cloud_message(stamped, table.columns, table.facts))
        reference = self._known.get(self._reference_ns)
        matches = self._matcher.match(features, reference) if reference is not None else self._matcher.match(features, features_of_nothing(features))
        if reference is not None and self.config.tracking.mask_fixed_pattern:
            matches = self._pattern.learn(features, reference, matches)
        table = matches_table(matches)
        self._matches.publish(cloud_message(stamped, table.columns, table.facts))
        self._known[frame.stamp_ns] = features
        if len(self._known) > REMEMBERED:
            self._known.pop(next(stamp for stamp in self._known if stamp != self._reference_ns))

    def begin_anew(self, why: str) -> None:
        self._known.clear()
        self._pattern.forget()

    def facts(self) -> dict[str, object]:
        return {"lost": self._joiner.lost}

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


def features_of_nothing(like: Features) -> Features:
    """A reference without keypoints: what a frame is matched to while there is none."""
    return Features(0, like.keypoints[:0], like.scores[:0], like.descriptors[:0], like.image_size, like.extractor)


def main() -> None:
    """The executable `frontend`."""
    sys.exit(run_node(FrontendNode))


if __name__ == "__main__":
    main()
