"""`thegra info`: what a recording holds, and the command that runs it."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.sources.calibration import camera_template
from thegra_core.sources.open import all_topics, image_topics, open_recording
from thegra_core.sources.recording import Recording
from thegra_core.sources.summary import Summary, summarize


def info(
    recording: Annotated[Path, typer.Argument(metavar="INPUT", help="ROS 1 or 2 bag, .mcap, image folder (with images.txt or plain) or video.")],
    topic: Annotated[str | None, typer.Option(help="Image topic to measure; guessed when only one fits.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Tell what a recording holds: topics, images, pace, gaps, repeated frames, camera, and the command to run it.

    Example: `thegra info flight.bag --topic /thermal/image_raw`
    """
    facts = gather(recording, topic)
    if as_json:
        print(json.dumps(facts, indent=2, allow_nan=False))
    else:
        _print(facts)


def gather(path: Path, topic: str | None = None) -> dict[str, Any]:
    """Everything that `thegra info` tells, ready for JSON.

    Raises:
        InputError: If nothing can be read, or `topic` is given and missing. An image topic that cannot be guessed is no error: it is said in `problem`.
    """
    facts: dict[str, Any] = {"path": str(path), "topics": [{"name": name, "type": kind, "messages": count} for name, kind, count in all_topics(path)]}
    try:
        recording = open_recording(path, topic)
    except InputError as error:
        if topic is not None or not facts["topics"]:
            raise
        images = [asdict(image) for image in image_topics(path)]
        return facts | {"image_topics": images, "problem": str(error), "command": None}
    summary = summarize(recording)
    camera = recording.camera
    return facts | {
        "name": recording.name,
        "topic": recording.topic,
        "stored_images": recording.frame_count,
        "images": asdict(summary),
        "camera": None if camera is None else _camera_facts(camera),
        "camera_template": None if camera is not None else _template(summary),
        "groundtruth": None if recording.groundtruth is None else str(recording.groundtruth),
        "unreadable": dict(recording.problems),
        "notes": recording.notes,
        "command": command_line(recording, topic),
    }


def command_line(recording: Recording, topic: str | None = None) -> str:
    """The `thegra run` that processes a recording."""
    words = ["thegra", "run", str(recording.path)]
    if topic is not None and recording.topic is not None:
        words += ["--topic", recording.topic]
    if recording.camera is None:
        words += ["--camera", "camera.yaml"]
    return shlex.join(words)


def _camera_facts(camera: CameraModel) -> dict[str, Any]:
    matrix = camera.matrix
    return {
        "name": camera.name, "model": camera.model.value, "width": camera.image_size[0], "height": camera.image_size[1],
        "fx": float(matrix[0, 0]), "fy": float(matrix[1, 1]), "cx": float(matrix[0, 2]), "cy": float(matrix[1, 2]),
        "distortion": [float(value) for value in camera.distortion],
    }  # fmt: skip


def _template(summary: Summary) -> str:
    size = max(summary.sizes, key=summary.sizes.__getitem__).split()[0] if summary.sizes else "0x0"
    width, height = size.split("x")
    return camera_template(int(width), int(height))


def _print(facts: dict[str, Any]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    table = Table(title=facts["path"], show_header=False, title_justify="left")
    for name, value in rows(facts):
        table.add_row(name, value)
    console.print(table)
    if facts.get("camera_template"):
        console.print("\nNo intrinsics are known. Fill in the capitals and save as camera.yaml:\n", markup=False)
        console.print(facts["camera_template"], markup=False)
    if facts["command"]:
        console.print(f"\nRun it with:\n  {facts['command']}", markup=False)
    elif facts.get("problem"):
        console.print(f"\n{facts['problem']}", markup=False)


def rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and text of each fact, topics first."""
    result = [("topic", f"{t['name']}  {t['type']}  {'?' if t['messages'] is None else t['messages']} messages") for t in facts["topics"]]
    if "images" not in facts:
        return result
    images = facts["images"]
    result.append(("images", f"{images['frames']} readable of {facts['stored_images'] if facts['stored_images'] is not None else '?'}" + (f" on {facts['topic']}" if facts["topic"] else "")))
    result += [("size", f"{size}, {count} images") for size, count in images["sizes"].items()]
    if images["frames"]:
        result += _pace_rows(images)
        result.append(("raw values", "{:.6g} / {:.6g} / {:.6g} at 1 / 50 / 99 %".format(*images["quantiles"])))
    result += [("unreadable", f"{count} x {reason}") for reason, count in facts["unreadable"].items()]
    camera = facts["camera"]
    if camera:
        result.append(("camera", f"{camera['model']}, {camera['width']}x{camera['height']}, fx {camera['fx']:.6g} fy {camera['fy']:.6g} cx {camera['cx']:.6g} cy {camera['cy']:.6g}"))
    result.append(("ground truth", facts["groundtruth"] or "none beside it"))
    return result + [("note", note) for note in facts["notes"]]


def _pace_rows(images: dict[str, Any]) -> list[tuple[str, str]]:
    result = [("duration", f"{images['duration_s']:.2f} s")]
    if images["period_s"]:
        result.append(("period", f"{images['period_s']:.4g} s ({1 / images['period_s']:.4g} Hz), jitter {100 * images['jitter']:.0f} %"))
    if images["gaps"]:
        longest = max(length for _, length in images["gaps"])
        result.append(("gaps", f"{len(images['gaps'])} of more than 3 periods, the longest {longest:.2f} s"))
    if images["stamps_not_increasing"]:
        result.append(("stamps", f"{images['stamps_not_increasing']} do not increase"))
    result.append(("repeated", f"{images['repeated']} frames equal the one before"))
    if images["closures"]:
        spans = ", ".join(f"{begin:.2f}-{end:.2f} s" for begin, end in images["closures"][:6])
        result.append(("shutter", f"closed {len(images['closures'])} times: {spans}"))
    return result
