"""What a node's process needs of its environment."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from thegra_core.lifeline import end_with_parent

PROFILES_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
LIFELINE_VARIABLE = "THEGRA_LIFELINE"
"""Names the file descriptor of the lifeline to what started the node, where that wants the node to end with it."""


def end_with_supervisor() -> None:
    """Have this process end with the one that started it, if that asks for it; processes that this one starts are not asked."""
    line = os.environ.pop(LIFELINE_VARIABLE, None)
    if line is not None:
        end_with_parent(int(line))


def use_large_segments() -> Path | None:
    """Let Fast DDS take shared memory that holds a whole image, unless the user has chosen a profile; the file, or None.

    With its own 512 KiB it cuts a 640x512 image of 16 bit into pieces and loses most of them on a best-effort topic (measured, docs/ros.md).
    """
    if profile_is_set():
        return None
    found = config_file("fastdds.xml")
    if found is not None:
        os.environ[PROFILES_VARIABLE] = str(found)
    return found


def profile_is_set() -> bool:
    """Whether a profile of Fast DDS is chosen for this process."""
    return PROFILES_VARIABLE in os.environ or "FASTDDS_DEFAULT_PROFILES_FILE" in os.environ


def config_file(name: str) -> Path | None:
    """A file of the folder `config`: beside a checkout, or where colcon or pip installed it."""
    prefixes = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    installed = [prefix / "share" / "thegra_ros" / "config" for prefix in [*prefixes, Path(sys.prefix)]]
    folders = [Path(__file__).resolve().parent.parent / "config", *installed]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)
