"""Single runs of `thegra run` as tasks: each a process of its own, done once, and told from each other by all that their result depends on."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thegra_core.outputs.files import sha256_of, write_atomic
from thegra_core.version import VERSION

RAN = (0, 1)
"""Exit codes of `thegra run` that come with results: done, nothing tracked."""
IDENTITY = "task.json"
WATCH_S = 0.5
"""Between two looks at a process: one takes some milliseconds of a core."""
_ERROR_CHARACTERS = 2000


@dataclass(frozen=True, slots=True)
class RunTask:
    """One run: `options` are those of `thegra run` that its result depends on; cache and threads only change how long it takes."""

    name: str
    recording: Path
    folder: Path
    options: tuple[str, ...] = ()
    groundtruth: Path | None = None
    cache: Path | None = None
    threads: int = 0

    def command(self) -> list[str]:
        """The command line."""
        words = ["run", str(self.recording), "--out", str(self.folder), "--quiet", *self.options]
        words += ["--groundtruth", str(self.groundtruth)] if self.groundtruth is not None else []
        words += ["--cache", str(self.cache)] if self.cache is not None else []
        return [sys.executable, "-m", "thegra_core.cli.main", *words]

    def identity(self) -> dict[str, Any]:
        """What the result depends on; two tasks of equal identity need one run."""
        truth = None if self.groundtruth is None or not self.groundtruth.is_file() else sha256_of(self.groundtruth)
        named = {word: Path(word.rpartition(":")[0] or word) for word in self.options}  # a camera may be FILE:cam0
        files = {word: sha256_of(path) for word, path in named.items() if path.is_file()}
        return {"version": VERSION, "recording": fingerprint(self.recording), "options": list(self.options), "files": files, "groundtruth": truth}


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended: `metrics` is what the run wrote, empty where it failed, and `error` says why; `resumed`: it had been run before."""

    exit_code: int = 0
    metrics: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None
    resumed: bool = False


def execute(task: RunTask) -> Outcome:
    """Run a task, unless its folder holds the finished run of an equal one. Fails as a result, never by raising."""
    try:
        identity = task.identity()
        done = finished(task.folder, identity)
        if done is not None:
            return done
        task.folder.mkdir(parents=True, exist_ok=True)
        for stale in (*task.folder.glob("*.json"), *task.folder.glob("*.txt")):
            stale.unlink()
        code, said = run_process(task.command(), task.threads)
        if code not in RAN or not (task.folder / "metrics.json").is_file():
            return Outcome(code, error=said or f"exit code {code}")
        write_atomic(task.folder / IDENTITY, json.dumps(identity | {"exit_code": code}, indent=2) + "\n")
        return Outcome(code, json.loads((task.folder / "metrics.json").read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        return Outcome(-1, error=f"{type(error).__name__}: {error}")


def finished(folder: Path, identity: Mapping[str, Any]) -> Outcome | None:
    """The outcome of an equal task that was run to its end in this folder."""
    try:
        before = json.loads((folder / IDENTITY).read_text(encoding="utf-8"))
        code = before.pop("exit_code")
        if before != identity:
            return None
        return Outcome(code, json.loads((folder / "metrics.json").read_text(encoding="utf-8")), resumed=True)
    except (OSError, ValueError, KeyError, AttributeError):
        return None


def run_process(command: list[str], threads: int = 0, watch: Callable[[int], None] | None = None) -> tuple[int, str]:
    """Exit code of a command and the end of what it said on stderr; `threads` (0: not set) is told to OpenMP unless the environment does.

    watch: called with the process's id now and then, while it runs.
    """
    environment = dict(os.environ)
    if threads:
        environment.setdefault("OMP_NUM_THREADS", str(threads))
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace", env=environment) as child:
        try:
            while True:
                try:
                    errors = child.communicate(timeout=WATCH_S if watch else None)[1]
                    break
                except subprocess.TimeoutExpired:
                    assert watch is not None
                    watch(child.pid)
        except BaseException:
            child.kill()
            raise
    said = errors.strip()[-_ERROR_CHARACTERS:]
    if child.returncode < 0:
        said = f"{said}\nended by {signal.Signals(-child.returncode).name}".strip()
    return child.returncode, said


def fingerprint(path: Path) -> str:
    """Tells an input from a changed one without reading it: names, sizes and times of its files."""
    files = [path] if path.is_file() else sorted(f for f in path.rglob("*") if f.is_file())
    digest = hashlib.sha256(str(path.resolve()).encode())
    for file in files:
        status = file.stat()
        digest.update(f"{file.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()
