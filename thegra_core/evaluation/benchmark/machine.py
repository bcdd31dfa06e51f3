"""What figures were measured on."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from typing import Any

from thegra_core.features.device import accelerator_name


def machine() -> dict[str, Any]:
    """This machine, as results tell it: platform, python, processors that this process may use, accelerator (None without)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"platform": platform.platform(), "python": platform.python_version(), "processors": cores, "accelerator": accelerator_name()}


def described(told: Mapping[str, Any]) -> str:
    """The same in words, for the end of a table's caption."""
    networks = f", networks on {told['accelerator']}" if told["accelerator"] else ""
    return f"{told['processors']} processors{networks}, {told['platform']}"
