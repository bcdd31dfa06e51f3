from __future__ import annotations

import base64
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_runs import BEGIN_NS, PERIOD_NS, SIZE, make_camera, make_run, true_pose

from thegra_core.config import load_config
from thegra_core.messages import Revisit, Run
from thegra_core.outputs.metrics import Timing
from thegra_core.outputs.report.timeline import Fate, events, fate_of, stretches
from thegra_core.outputs.trajectory import format_tum, make_trajectory
from thegra_core.outputs.write import RecordingFacts, write_run

SECTIONS = ("summary", "timeline", "trajectory", "error", "counts", "stages", "frames", "events", "details", "configuration")
_VOID = {"meta", "br", "img", "link", "input", "hr"}


class _Page(HTMLParser):
    """Collects ids and text, and checks that tags nest."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.open: list[str] = []
        self.counts: dict[str, int] = {}
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.ids += [value for name, value in attrs if name == "id" and value]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.ids += [value for name, value in attrs if name == "id" and value]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def report_of(run: Run, folder: Path, with_truth: bool = True, **facts) -> str:
    recording = folder / "recording.bag"
    recording.write_bytes(b"thermal")
    truth = folder / "truth.txt"
    truth.write_text(format_tum(make_trajectory((BEGIN_NS + i * PERIOD_NS, true_pose(i)) for i in range(len(run.frames) + 5))))
    told = RecordingFacts(**({"name": "hall & <stairs>", "path": recording, "topic": "/thermal", "camera": make_camera()} | facts))
    write_run(run, folder / "out", load_config(), told, truth if with_truth else None, Timing(2.0, len(run.frames)))
    return (folder / "out" / "report.html").read_text(encoding="utf-8")


def test_every_part_is_there(tmp_path: Path) -> None:
    page = _Page(report_of(make_run(noise=0.01), tmp_path))
    assert page.open == []
    assert set(SECTIONS) <= set(page.ids)
    assert "80.0 %" in page.text
    assert "16 of 20 frames have a pose" in page.text
    assert "ATE RMSE" in page.text
    assert "over 16 frames" in page.text
    assert "shutter closed, pose predicted (2 frames)" in page.text
    assert "max_keypoints: 1024" in page.text
    assert page.counts["svg"] == 2 + 4 + 4  # timeline and its ticks, four figures, four frames


def test_nothing_is_loaded_from_outside(tmp_path: Path) -> None:
    text = report_of(make_run(), tmp_path)
    assert not re.search(r"(https?:)?//[\w.]+", re.sub(r"base64,[A-Za-z0-9+/=]+", "", text))
    for reference in re.findall(r"""(?:href|src)\s*=\s*["']([^"']*)["']|url\(([^)]*)\)""", text):
        assert "".join(reference).startswith(("#", "data:")), reference
    assert "@import" not in text
    assert "<script" not in text


def test_ids_are_unique_and_references_resolve(tmp_path: Path) -> None:
    text = report_of(make_run(), tmp_path)
    ids = _Page(text).ids
    assert len(ids) == len(set(ids))
    used = set(re.findall(r"(?:href=\"#|url\(#)([\w-]+)", text))
    assert used
    assert used <= set(ids)


def test_colours_follow_the_page(tmp_path: Path) -> None:
    text = report_of(make_run(), tmp_path)
    figures = re.findall(r'<svg role="img" aria-label="[^"]*" .*?</svg>', text, re.DOTALL)
    assert len(figures) == 4
    for figure in figures:
        assert "var(--fg)" in figure or "var(--muted)" in figure
        assert not re.search(r"(?:fill|stroke): #", figure)
    defined = set(re.findall(r"(--[\w]+):", text))
    assert set(re.findall(r"var\((--[\w]+)\)", text)) <= defined


def test_names_are_escaped(tmp_path: Path) -> None:
    text = report_of(make_run(), tmp_path, command="thegra run '<script>alert(1)</script>'")
    assert "<script" not in text
    assert "hall &amp; &lt;stairs&gt;" in text


def test_frames_show_the_images_given(tmp_path: Path) -> None:
    run = make_run()
    text = report_of(run, tmp_path)
    encoded = re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", text)
    assert len(encoded) == len(run.snapshots)
    for data, snapshot in zip(encoded, run.snapshots, strict=True):
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, snapshot.image)
    first = run.snapshots[0]
    x, y = first.keypoints[first.tracked][0] + 0.5
    assert f'class="tracked" d="M{x:.1f} {y:.1f}h0' in text
    assert text.count(f"viewBox=\"0 0 {SIZE[0]} {SIZE[1]}\"") == len(run.snapshots)


def test_the_overview_shows_frame_and_map(tmp_path: Path) -> None:
    pictures = []
    for with_truth in (True, False):
        report_of(make_run(noise=0.01), tmp_path, with_truth)
        pictures.append(cv2.imread(str(tmp_path / "out" / "overview.png")))
    for picture in pictures:
        assert picture is not None and min(picture.shape[:2]) > 300
        half = picture.shape[1] // 2
        assert np.ptp(picture[:, :half].astype(int), axis=2).max() > 100, "tracks are coloured on the grey frame"
        assert np.ptp(picture[:, half:].astype(int), axis=2).max() > 100, "the path is coloured"
    assert not np.array_equal(*pictures), "the ground truth is drawn"
    report_of(make_run("iiii", localized=()), tmp_path)
    assert not (tmp_path / "out" / "overview.png").exists(), "no map, no picture, and none of an earlier run"


@pytest.mark.parametrize("states", ["", "i", "iiiii", "t", "tt", "lhlhl"])
@pytest.mark.parametrize("with_truth", [True, False])
def test_runs_with_little_in_them_have_a_page(tmp_path: Path, states: str, with_truth: bool) -> None:
    page = _Page(report_of(replace(make_run(states, localized=()), snapshots=()), tmp_path, with_truth))
    assert set(SECTIONS) <= set(page.ids)
    assert "No frames were kept." in page.text


def test_long_runs_have_a_page_of_bearable_size(tmp_path: Path) -> None:
    text = report_of(replace(make_run("t" * 6000, noise=0.01), snapshots=()), tmp_path)
    assert len(text) < 700_000
    assert "6000 of 6000 frames have a pose" in text


def test_warnings_say_what_must_not_be_overlooked(tmp_path: Path) -> None:
    lost = report_of(make_run("iiiii", localized=()), tmp_path)
    assert "Nothing could be tracked. The last thing that initialisation said: the camera has not moved enough" in lost
    wrong = report_of(make_run("t" * 20, noise=3.0), tmp_path)
    assert "the trajectory is wrong, not just inexact" in wrong
    bad = report_of(replace(make_run(), bad_frames={"stamp repeats": 2}), tmp_path, problems={"damaged png": 4})
    assert "2 × stamp repeats" in bad
    assert "4 × damaged png" in bad
    assert 'id="warnings"' not in report_of(make_run(), tmp_path)


def test_frames_without_ground_truth_are_drawn_in_map_units(tmp_path: Path) -> None:
    text = report_of(make_run(), tmp_path, with_truth=False)
    assert "map units" in text
    assert "--groundtruth FILE" in text
    assert "no ground truth given" in text


def test_fates_of_frames() -> None:
    run = make_run("iittthhltr", localized=(1,), other_map_from=8)
    expected = [Fate.INITIALIZING, Fate.AFTERWARDS, *[Fate.TRACKED] * 3, *[Fate.HELD] * 2, Fate.LOST, Fate.OTHER_MAP, Fate.LOST]
    assert [fate_of(f, run) for f in run.frames] == expected
    spoiled = replace(run.frames[7], result=replace(run.frames[7].result, reason="stamp repeats"))
    assert fate_of(spoiled, replace(run, bad_frames={"stamp repeats": 1})) is Fate.BAD


def test_stretches_cover_the_run_and_leave_gaps() -> None:
    run = make_run("ttttllll")
    frames = tuple(replace(f, result=replace(f.result, stamp_ns=f.stamp_ns + (20 * PERIOD_NS if f.index >= 6 else 0))) for f in run.frames)
    parts = stretches(replace(run, frames=frames))
    assert [(p.fate, p.frames) for p in parts] == [(Fate.TRACKED, 4), (Fate.LOST, 2), (Fate.LOST, 2)]
    np.testing.assert_allclose([(p.begin_s, p.end_s) for p in parts], [(0, 0.4), (0.4, 0.6), (2.6, 2.8)], atol=1e-9)


def test_stamps_that_all_repeat_still_make_a_timeline(tmp_path: Path) -> None:
    run = make_run("i" * 8, localized=())
    frames = tuple(replace(f, result=replace(f.result, stamp_ns=BEGIN_NS)) for f in run.frames)
    (part,) = stretches(replace(run, frames=frames))
    assert (part.frames, part.begin_s, part.end_s) == (8, 0.0, 1.0)
    assert "timeline" in _Page(report_of(replace(run, frames=frames), tmp_path)).ids


def test_events_are_told_in_order_and_never_too_many() -> None:
    told = events(make_run("iitthhttllttt"))
    assert [e.frame for e in told] == [0, 2, 4, 6, 8, 10]
    assert "first map made" in told[1].text
    assert "after the shutter" in told[3].text
    assert "tracking again" in told[5].text
    other = events(make_run("iittllltt", other_map_from=7))
    assert "another map begins, tracking in map 1 (2 frames)" in other[-1].text
    revisits = (Revisit(BEGIN_NS + 4 * PERIOD_NS, 0, 9, 2, 80, 0.25, 1.1), Revisit(BEGIN_NS + 5 * PERIOD_NS, 0, 20, 4, 60, 0.0, 2.0, 1))
    tied = events(replace(make_run("iittttll"), revisits=revisits))
    assert [e.frame for e in tied] == [0, 2, 4, 5, 6]
    assert "loop closed in map 0: keyframe 9 sees by 80 landmarks what keyframe 2 saw; it moves by 0.250" in tied[2].text
    assert "map 1 becomes part of map 0" in tied[3].text
    many = events(make_run("tl" * 100))
    assert len(many) == 61
    assert many[-1].text == "... and 140 more"


@pytest.mark.slow
def test_the_page_opens_in_a_browser(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed")
    report_of(make_run(noise=0.01), tmp_path)
    offline = ("quic", "background-networking", "component-update", "sync")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", *(f"--disable-{name}" for name in offline)]
    page = (tmp_path / "out" / "report.html").as_uri()
    done = subprocess.run(
        [browser, *flags, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page], capture_output=True, text=True, check=True, timeout=120
    )
    dom = done.stdout
    for section in SECTIONS:
        assert f'id="{section}"' in dom, section
    assert dom.count("<svg") == 10
    assert dom.count("<image") == 4
    screenshot = tmp_path / "page.png"
    subprocess.run(
        [browser, *flags, f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,1600", f"--screenshot={screenshot}", page],
        capture_output=True, check=True, timeout=120,
    )  # fmt: skip
    picture = cv2.imread(str(screenshot))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200  # drawn, not blank
