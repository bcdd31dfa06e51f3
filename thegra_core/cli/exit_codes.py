"""What the exit code of `thegra` tells a script."""

from __future__ import annotations

DONE = 0
NOTHING_TRACKED = 1
WRONG_USE = 2
INTERRUPTED = 130
