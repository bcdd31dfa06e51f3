"""Lets kornia 0.9 run on Python 3.10.

kornia 0.9 asks for Python 3.11 but its networks need only these standard names of it; `kornia.augmentation`, which needs more, is imported by
`kornia/__init__.py` alone, so a bare package takes that module's place.
"""

from __future__ import annotations

import datetime
import enum
import importlib.util
import sys
import types
import typing

import typing_extensions


class StrEnum(str, enum.Enum):
    """`enum.StrEnum` of Python 3.11, as far as kornia uses it."""

    __str__ = str.__str__


def prepare() -> None:
    """Add the missing names to the standard library's modules and let `import kornia` skip its own `__init__`; does nothing where kornia is absent."""
    vars(enum).setdefault("StrEnum", StrEnum)
    vars(datetime).setdefault("UTC", datetime.timezone.utc)
    for name in ("Self", "NotRequired"):
        vars(typing).setdefault(name, getattr(typing_extensions, name))
    spec = importlib.util.find_spec("kornia")
    if "kornia" in sys.modules or spec is None or spec.submodule_search_locations is None:
        return
    package = types.ModuleType("kornia")
    package.__path__ = list(spec.submodule_search_locations)
    package.__spec__ = spec
    sys.modules["kornia"] = package
