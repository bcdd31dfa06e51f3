"""The version, as the package's manifest states it."""

from __future__ import annotations

import importlib.metadata

DISTRIBUTION = "thegra_ros"


def _installed_version() -> str:
    try:
        return importlib.metadata.version(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:  # run from a checkout that was never installed
        return "unknown"


VERSION = _installed_version()
