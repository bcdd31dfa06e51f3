"""The formats by name: each writes a recording into a folder and tells what to run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from thegra_core.simulation.recording import Simulated
from thegra_core.simulation.writers.folder import write_folder
from thegra_core.simulation.writers.mcap import write_mcap
from thegra_core.simulation.writers.ros1 import write_rovtio, write_vivid

WRITERS: Mapping[str, Callable[[Path, Simulated], Path]] = {"mcap": write_mcap, "folder": write_folder, "vivid": write_vivid, "rovtio": write_rovtio}
