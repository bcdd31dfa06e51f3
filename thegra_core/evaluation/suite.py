"""The fixed simulated suite: what every version is measured on, the same bytes everywhere.

Four scenes, three ways to carry the camera, with and without the shutter, each with a seed of its own. The first two rooms have the full resolution of
a 640x512 core; the others a quarter of its pixels, so that the suite also runs on a small machine.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from thegra_core.errors import InputError
from thegra_core.outputs.files import write_atomic
from thegra_core.simulation.simulate import SimulationOptions, simulate

_FULL, _SMALL = (640, 512), (320, 256)


def _sequence(scene: str, style: str, shutter: str, seed: int, duration_s: float = 15.0, size: tuple[int, int] = _SMALL) -> SimulationOptions:
    return SimulationOptions.model_validate(
        {"scene": scene, "style": style, "shutter": shutter, "seed": seed, "duration_s": duration_s, "rate_hz": 10.0, "image_size": size}
    )


SUITE: Mapping[str, SimulationOptions] = {
    "room_robust": _sequence("room", "robust", "none", 101, 12.0, _FULL),
    "room_unstable_freeze": _sequence("room", "unstable", "freeze", 102, 12.0, _FULL),
    "room_aggressive": _sequence("room", "aggressive", "none", 103),
    "corridor_robust_gap": _sequence("corridor", "robust", "gap", 201, 20.0),
    "corridor_unstable": _sequence("corridor", "unstable", "none", 202),
    "street_robust": _sequence("street", "robust", "none", 301, 20.0),
    "street_unstable_gap": _sequence("street", "unstable", "gap", 302),
    "street_aggressive": _sequence("street", "aggressive", "none", 303),
    "tunnel_robust_freeze": _sequence("tunnel", "robust", "freeze", 401, 20.0),
    "tunnel_unstable": _sequence("tunnel", "unstable", "none", 402),
}
"""Name to what is simulated; never changed, only added to."""
OPTIONS = "simulation.json"


def make_suite(folder: Path, names: Iterable[str] | None = None, say: Callable[[str, int, int], None] | None = None) -> list[Path]:
    """Recordings of the suite as folders of images; those that are missing are simulated.

    Args:
        names: Of `SUITE`; all if not given.
        say: Told the name, frames done and frames in all while one is simulated.

    Raises:
        InputError: If a folder holds another simulation, cannot be written, or the simulator's libraries are missing.
    """
    return [make_recording(folder / name, SUITE[name], say) for name in (SUITE if names is None else names)]


def make_recording(target: Path, options: SimulationOptions, say: Callable[[str, int, int], None] | None = None) -> Path:
    """The recording of those options in the folder `target`, simulated if it is not there; arguments and errors as for `make_suite`."""
    name = target.name
    content = options.model_dump_json(indent=2) + "\n"
    if target.is_dir():
        told = target / OPTIONS
        if told.is_file() and told.read_text(encoding="utf-8") == content:
            return target
        raise InputError(f"{target} holds something else than this version's {name}: remove it, or name another folder with --suite-dir DIR")
    half_made = target.with_name(f".{name}.part")
    try:
        if half_made.exists():
            shutil.rmtree(half_made)
        simulate(options, half_made, "folder", None if say is None else lambda done, total: say(name, done, total))
        write_atomic(half_made / OPTIONS, content)
        half_made.replace(target)
    except OSError as error:
        raise InputError(f"cannot write to {target.parent}: {error.strerror}; name another folder with --suite-dir DIR") from error
    return target
