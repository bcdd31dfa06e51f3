"""What several tests use.

Tests marked `slow` need minutes, or recordings that do not ship with the repository; `pytest -m slow` runs them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; skips where they are not."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}")
    return folder
