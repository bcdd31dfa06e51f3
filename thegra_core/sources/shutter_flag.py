"""What a camera's own topic says of its shutter."""

from __future__ import annotations

from typing import Any

import numpy as np

FFC_IN_PROGRESS = 2
"""State of the flat-field correction as FLIR's Lepton and Boson number it: 0 never or none, 1 imminent, 2 in progress, 3 complete."""
FLAG_TYPES = tuple(f"std_msgs/msg/{name}" for name in ("Bool", "UInt8", "UInt16", "UInt32", "Int8", "Int16", "Int32"))


def shutter_closed(message: Any) -> bool:
    """Whether a message of one of `FLAG_TYPES` says that the shutter is closed: true, or the number of a correction in progress."""
    data = message.data
    return bool(data) if isinstance(data, bool | np.bool_) else int(data) == FFC_IN_PROGRESS
