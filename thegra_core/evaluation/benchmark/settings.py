"""What the benchmarks that run the system in their own process run it with."""

from __future__ import annotations

from dataclasses import dataclass

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Extractor, Matcher


@dataclass(frozen=True, slots=True)
class Settings:
    """Extractor and matcher are shared by all runs; those of the configuration where not given."""

    config: ThegraConfig
    extractor: Extractor | None = None
    matcher: Matcher | None = None
