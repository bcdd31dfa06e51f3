"""The thermal image topic of a bag, by message type and encoding; names only decide between topics that fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from thegra_core.errors import InputError
from thegra_core.sources.open import image_topics
from thegra_core.sources.recording import ImageTopic

_COUNTS = re.compile(r"mono16|16UC1|16SC1", re.IGNORECASE)
_DEPTH = re.compile(r"depth|disparity", re.IGNORECASE)


def thermal_topic(path: Path, known: Sequence[str], size: tuple[int, int]) -> tuple[str, str]:
    """Name of the topic, and what told it.

    Of the topics with 16-bit single-channel images that are no depth: the one of the right size, then the one of a known name, then the longest.

    Raises:
        InputError: If there is none; the message lists the image topics.
    """
    topics = [t for t in image_topics(path) if t.count != 0]
    counts = [t for t in topics if _COUNTS.search(t.encoding) and not _DEPTH.search(t.name)]
    if not counts:
        listing = "".join(f"\n  {topic}" for topic in topics) or " none"
        raise InputError(f"{path} has no topic of 16-bit single-channel images that are no depth; its image topics are:{listing}")
    counts = [t for t in counts if t.size == size] or counts
    counts = [t for t in counts if _plain(t) in known] or counts
    picked = max(counts, key=lambda t: (t.count or 0, not t.compressed))
    renamed = "" if _plain(picked) in known else f", known names are {', '.join(known)}"
    return picked.name, f"topic {picked.name} ({picked.encoding}{'' if picked.size is None else f', {picked.size[0]}x{picked.size[1]}'}{renamed})"


def _plain(topic: ImageTopic) -> str:
    return topic.name.removesuffix("/compressed")
