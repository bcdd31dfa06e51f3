"""Memory of processes that belong together. Pages that several have, as of the networks' libraries, count once (PSS)."""

from __future__ import annotations

from pathlib import Path


class PeakMemory:
    """The most memory that was seen of a process and its descendants, MB; call it now and then with the process's id."""

    def __init__(self) -> None:
        self.mb = 0.0

    def __call__(self, pid: int) -> None:
        self.mb = max(self.mb, resident_mb(pid))


def resident_mb(pid: int) -> float:
    """Memory of a process and its descendants, shared pages shared out among who has them (PSS), MB. 0 where it has ended."""
    total = 0.0
    for member in [pid, *descendants(pid)]:
        try:
            rollup = Path(f"/proc/{member}/smaps_rollup").read_text()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) / 1024
    return total


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and those that they have."""
    try:
        children = [int(text) for task in Path(f"/proc/{pid}/task").iterdir() for text in (task / "children").read_text().split()]
    except OSError:
        return []
    return [member for child in children for member in (child, *descendants(child))]
