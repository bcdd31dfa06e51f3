"""How `frontend` and `tracking` talk of one image: followed keypoints first, detected ones where tracking wants them.

Each round is a message on `features` and one on `matches`, marked by its kind; what tracking says to followed keypoints is a Header on `wanted`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from thegra_core.features.protocols import Wanted
from thegra_core.messages import Features, Matches
from thegra_ros.codec.clouds import Table, cloud_message
from thegra_ros.codec.records import features_table, matches_table
from thegra_ros.codec.stamps import header

_FOLLOWED = "followed"
_ENOUGH = "enough"


def round_clouds(stamped: Header, features: Features, matches: Matches, followed: bool) -> tuple[PointCloud2, PointCloud2]:
    """Both messages of a round."""
    mark = {_FOLLOWED: "yes"} if followed else {}
    tables = (replace(table, facts={**table.facts, **mark}) for table in (features_table(features), matches_table(matches)))
    first, second = (cloud_message(stamped, table.columns, table.facts) for table in tables)
    return first, second


def is_followed(table: Table) -> bool:
    """Whether a message belongs to a round of followed keypoints, which wait for what tracking says to them."""
    return _FOLLOWED in table.facts


def verdict_message(stamp_ns: int, wanted: Wanted | None) -> Header:
    """What tracking says to followed keypoints: what is wanted besides; None: they are enough."""
    return header(stamp_ns, wanted.value if wanted is not None else _ENOUGH)


def read_verdict(message: Header) -> Wanted | None:
    """The inverse of `verdict_message`."""
    return None if message.frame_id == _ENOUGH else Wanted(message.frame_id)


class SecondRound:
    """Collects the two parts of the round that a frame was asked for; parts of other frames are passed by."""

    def __init__(self) -> None:
        self.stamp_ns: int | None = None
        self._parts: dict[str, Features | Matches] = {}

    def expect(self, stamp_ns: int) -> None:
        """From now on parts of this frame that were not followed are meant."""
        self._parts, self.stamp_ns = {}, stamp_ns

    def add(self, part: str, value: Features | Matches) -> Mapping[str, Features | Matches] | None:
        """Add a part; both, once they are there."""
        self._parts[part] = value
        if len(self._parts) < 2:
            return None
        self.stamp_ns = None
        return self._parts
