"""`thegra run`: frames of a recording through the system, results into a folder."""

from __future__ import annotations

import logging
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from thegra_core.cli import exit_codes
from thegra_core.cli.progress import News, Progress, headline, make_progress, print_summary
from thegra_core.config import ThegraConfig, load_config, parse_assignments
from thegra_core.errors import InputError, ThegraError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, MapSummary, Run, Snapshot, TrackingResult
from thegra_core.outputs.files import writing_to
from thegra_core.outputs.metrics import Timing
from thegra_core.outputs.trajectory import NS_PER_S, read_tum
from thegra_core.outputs.viewer import Viewer, make_viewer
from thegra_core.outputs.write import RecordingFacts, write_run
from thegra_core.preprocessing.stage import Prepared
from thegra_core.process import Usage, set_threads
from thegra_core.sources.open import camera_for, open_recording
from thegra_core.sources.playback import Playback
from thegra_core.sources.read_ahead import read_ahead
from thegra_core.sources.recording import Recording
from thegra_core.version import VERSION

if TYPE_CHECKING:
    from thegra_core.features.cache import CachedExtractor, CachedMatcher
    from thegra_core.features.protocols import Extractor, Matcher

_log = logging.getLogger(__name__)
STRAYS = 3
"""Frames in a row that may be stamped behind the end of the wanted part before it has ended."""
READ_AHEAD = 2
"""Frames of a recording that are read and pre-processed before they are asked for."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The command's options; None: not given."""

    recording: Path
    topic: str | None = None
    shutter_topic: str | None = None
    camera: str | None = None
    profile: str | None = None
    config: Path | None = None
    assignments: tuple[str, ...] = ()
    out: Path | None = None
    groundtruth: Path | None = None
    max_frames: int | None = None
    start_s: float = 0.0
    duration_s: float | None = None
    seed: int | None = None
    viewer: str = "none"
    quiet: bool = False
    cache: Path | None = None
    map: Path | None = None
    localization_only: bool = False
    save_map: Path | None = None
    realtime: bool = False


class System(Protocol):
    """What the command needs of `slam.Slam`."""

    localization_only: bool

    def warm_up(self) -> None: ...
    def prepare(self, frame: Frame) -> Prepared: ...
    def track(self, prepared: Prepared) -> TrackingResult: ...
    def snapshot(self) -> Snapshot | None: ...
    def current_map(self) -> MapSummary | None: ...
    def map_size(self) -> tuple[int, int]: ...
    def load_map(self, path: Path) -> None: ...
    def save_map(self, path: Path) -> None: ...
    def finish(self, progress: Callable[[str], None] | None = None) -> Run: ...
    def usage(self) -> Usage: ...
    def close(self) -> None: ...


@dataclass
class _Done:
    """How far the loop came, also when it ends early."""

    frames: int = 0
    interrupted: bool = False
    error: ThegraError | None = None
    reason: str = ""
    unreadable: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    latency_ms: list[float] = field(default_factory=list)
    cpu_s: float = 0.0


def run_recording(options: RunOptions) -> int:
    """Run the system over a recording and write every output.

    Returns:
        The exit code: done, nothing tracked, or interrupted.

    Raises:
        ThegraError: If the input or an option cannot be used; what was processed until then is written.
    """
    started = datetime.now(timezone.utc)
    _check_options(options)
    config = load_config(options.profile, options.config, _overrides(options))
    recording = open_recording(options.recording, options.topic, options.shutter_topic)
    camera = camera_for(recording, options.camera)
    groundtruth = _groundtruth(options, recording)
    viewer = make_viewer(options.viewer)
    out = options.out or Path("runs") / f"{recording.name}_{started:%Y%m%dT%H%M%SZ}"
    with log_file(out), make_progress(options.quiet, _expected_frames(options, recording)) as progress, _interrupts() as interrupted:
        for line in (f"thegra {VERSION}, profile {config.profile}, seed {config.seed}", f"input {recording.path}", f"arguments {shlex.join(sys.argv[1:])}", *recording.notes):
            _log.info("%s", line)
        front_end = cached_front_end(config, options.cache)
        system = make_live_system(camera, config) if options.realtime else make_system(camera, config, *front_end)
        with closing(system):
            if options.map is not None:
                progress.stage("reading the map")
                system.load_map(options.map)
                system.localization_only = options.localization_only
            frames = _window(recording, options)
            if options.realtime:
                progress.stage("warming up")
                system.warm_up()
                done, wall_s = _play(system, frames, recording, progress, viewer, interrupted)
            else:
                done, wall_s = _process(system, read_ahead(map(system.prepare, frames), READ_AHEAD), recording, progress, viewer, interrupted)
            if done.frames == 0 and done.interrupted:
                raise KeyboardInterrupt
            if done.frames == 0:
                raise done.error or InputError(_no_frames(options, done))
            begin = time.perf_counter()
            run = system.finish(progress.stage)
            finish_s = time.perf_counter() - begin
            if options.save_map is not None:
                done.error = _save_map(system, options.save_map, run) or done.error
            apart = system.usage()
        timing = Timing(
            wall_s=wall_s, frames_read=done.frames, finish_s=finish_s, dropped_frames=done.dropped, cached_pct=_cached_pct(front_end),
            latency_ms=done.latency_ms, cpu_s=done.cpu_s, apart_rss_mb=apart.peak_rss_mb,
        )  # fmt: skip
        viewer.finish(run)
        facts = RecordingFacts(
            name=recording.name, path=recording.path, topic=recording.topic, camera=camera, weights=_weights(config), problems=done.unreadable,
            notes=tuple(recording.notes), command=shlex.join(["thegra", *sys.argv[1:]]), started_utc=f"{started:%Y-%m-%dT%H:%M:%SZ}",
        )  # fmt: skip
        progress.stage("writing the results")
        written = write_run(run, out, config, facts, groundtruth, timing)
        _log.info("%s", headline(written.metrics))
        done.interrupted = done.interrupted or interrupted()
    print_summary(written, options.quiet, done.interrupted, done.reason)
    if done.error is not None:
        raise done.error
    if done.interrupted:
        return exit_codes.INTERRUPTED
    return exit_codes.DONE if written.metrics["frames_tracked"] else exit_codes.NOTHING_TRACKED


def make_system(camera: CameraModel, config: ThegraConfig, extractor: Extractor | None = None, matcher: Matcher | None = None) -> System:
    """The SLAM system; imported here because the networks take seconds to load."""
    set_threads(config.threads)
    from thegra_core.slam import Slam

    return Slam(camera, config, extractor, matcher)


def make_live_system(camera: CameraModel, config: ThegraConfig) -> System:
    """The SLAM system with mapping in a process of its own."""
    set_threads(config.threads)
    from thegra_core.features.registry import make_frame_matcher
    from thegra_core.mapping.process import MappingProcess
    from thegra_core.slam import Slam

    return Slam(camera, config, mapping=MappingProcess(camera, config, make_frame_matcher))


def cached_front_end(config: ThegraConfig, folder: Path | None) -> tuple[()] | tuple[CachedExtractor, CachedMatcher]:
    """Extractor and matcher of the configuration that keep their results in a folder; nothing without one."""
    if folder is None:
        return ()
    from thegra_core.features.cache import cached_extractor, cached_matcher

    return cached_extractor(config.extractor, folder), cached_matcher(config.matcher, config.extractor, folder)


def _cached_pct(front_end: Sequence[CachedExtractor | CachedMatcher]) -> float | None:
    hits, misses = (sum(getattr(part.store, name) for part in front_end) for name in ("hits", "misses"))
    return round(100 * hits / (hits + misses), 2) if hits + misses else None


def _play(
    system: System, frames: Iterator[Frame], recording: Recording, progress: Progress, viewer: Viewer, interrupted: Callable[[], bool]
) -> tuple[_Done, float]:
    """As `_process`, at the recording's own rate; frames that come too fast are dropped."""
    latency_ms: list[float] = []
    with Playback(frames) as playback:
        prepared = map(system.prepare, playback)  # not ahead: what waits may be dropped
        done, wall_s = _process(system, prepared, recording, progress, viewer, interrupted, lambda: latency_ms.append(playback.latency_ms()))
    done.dropped, done.latency_ms = playback.dropped, latency_ms
    return done, wall_s


def _process(
    system: System, frames: Iterator[Prepared], recording: Recording, progress: Progress, viewer: Viewer, interrupted: Callable[[], bool],
    processed: Callable[[], None] = lambda: None,
) -> tuple[_Done, float]:
    """All frames through the system, `processed` called after each; returns also the seconds it took."""
    done, news, before = _Done(), News(), dict(recording.problems)
    begin, cpu_begin = time.perf_counter(), time.process_time() + system.usage().cpu_s
    try:
        for prepared in frames:
            frame, result = prepared.frame, system.track(prepared)
            processed()
            done.frames += 1
            done.reason = result.reason or done.reason
            if news.is_new(result):
                _log.info("frame %d %s %s (%d matches, %d inliers)", frame.index, result.state.value, result.reason, result.matches, result.inliers)
            progress.frame(result, system, sum(recording.problems.values()))
            viewer.show(result, system)
            if interrupted():
                break
    except KeyboardInterrupt:
        done.interrupted = True
    except ThegraError as error:
        done.error = error
    wall_s = time.perf_counter() - begin
    done.cpu_s = time.process_time() + system.usage().cpu_s - cpu_begin
    done.interrupted = done.interrupted or interrupted()
    done.unreadable = {reason: count - before.get(reason, 0) for reason, count in recording.problems.items() if count > before.get(reason, 0)}
    if done.interrupted:
        _log.warning("interrupted after %d frames; finishing what is there (again Ctrl-C to stop at once)", done.frames)
    return done, wall_s


@contextmanager
def _interrupts() -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C is only noted, so that the map stays whole and the results are written; the second is a KeyboardInterrupt at once."""
    seen = False

    def note(_signal: int, _frame: Any) -> None:
        nonlocal seen
        seen = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    previous = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: seen
    finally:
        signal.signal(signal.SIGINT, previous)


def _window(recording: Recording, options: RunOptions) -> Iterator[Frame]:
    """Frames of the wanted part; the time is counted from the first frame's stamp. Once it has begun, stamps that lie before it are the system's to judge, and only
    several in a row behind its end are its end: one may be wrong."""
    first: int | None = None
    begun, given, behind = False, 0, 0
    for frame in recording.frames():
        first = frame.stamp_ns if first is None else first
        offset_s = (frame.stamp_ns - first) / NS_PER_S
        begun = begun or offset_s >= options.start_s
        if not begun:
            continue
        if options.duration_s is not None and offset_s >= options.start_s + options.duration_s:
            behind += 1
            if behind > STRAYS:
                return
            continue
        behind = 0
        yield frame
        given += 1
        if given == options.max_frames:
            return


def _save_map(system: System, file: Path, run: Run) -> ThegraError | None:
    """Why the map is not in the file, None if it is: the other results are written all the same."""
    if not run.maps:
        _log.warning("there is no map that could be written to %s", file)
        return None
    try:
        system.save_map(file)
    except ThegraError as error:
        return error
    return None


def _expected_frames(options: RunOptions, recording: Recording) -> int | None:
    known = recording.frame_count if options.start_s == 0 and options.duration_s is None else None
    limits = [n for n in (known, options.max_frames) if n is not None]
    return min(limits) if limits else None


def _no_frames(options: RunOptions, done: _Done) -> str:
    unreadable = "".join(f"\n  {count} x {reason}" for reason, count in done.unreadable.items())
    return f"no frame of {options.recording} lies in the part that --start and --duration choose{unreadable}\nits length is told by: thegra info {options.recording}"


def _check_options(options: RunOptions) -> None:
    """Tell before the work what could not be done after it."""
    if options.localization_only and options.map is None:
        raise InputError("--localization-only needs a map to find the camera in: add --map FILE; a run writes one with --save-map FILE")
    if options.realtime and options.cache is not None:
        raise InputError("--realtime measures what the networks cost: leave --cache out")
    if options.save_map is not None and options.save_map.is_dir():
        raise InputError(f"--save-map {options.save_map}: this is a folder; give the name of a file, e.g. --save-map {shlex.quote(str(options.save_map / 'map.thegra'))}")
    if options.save_map is not None and not options.save_map.absolute().parent.is_dir():
        raise InputError(f"--save-map {options.save_map}: the folder is not there; make it with: mkdir -p {shlex.quote(str(options.save_map.parent))}")


def _overrides(options: RunOptions) -> dict[str, Any]:
    overrides = parse_assignments(options.assignments)
    return overrides if options.seed is None else overrides | {"seed": options.seed}


def _groundtruth(options: RunOptions, recording: Recording) -> Path | None:
    """The file to score against, read once so that a bad one is told before the work; one that was only found beside the input is left out then."""
    if options.groundtruth is not None:
        read_tum(options.groundtruth)
        return options.groundtruth
    if recording.groundtruth is None:
        return None
    try:
        read_tum(recording.groundtruth)
    except InputError as error:
        recording.notes.append(f"ground truth beside the input not used: {error}")
        return None
    return recording.groundtruth


def _weights(config: ThegraConfig) -> dict[str, str]:
    from thegra_core.features.registry import weights_for
    from thegra_core.features.weights import cache_dir, sha256_of, weight_named

    files = [cache_dir() / weight_named(name).file for name in weights_for(config.extractor, config.matcher)]
    return {file.name: sha256_of(file) for file in files if file.is_file()}


@contextmanager
def log_file(out: Path) -> Iterator[None]:
    """Write what the package logs to `out`/thegra.log.

    Raises:
        InputError: If it cannot be written.
    """
    logger = logging.getLogger("thegra_core")
    with writing_to(out):
        handler = logging.FileHandler(out / "thegra.log", mode="w", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
    level = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    except ThegraError as error:
        _log.error("%s", error)
        raise
    except Exception:
        _log.exception("the run ended with an error")
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        handler.close()
