"""The study: which pairs, what is measured of a pair by hand, and the command from recording to pictures."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.config import PreprocessingConfig
from thegra_core.evaluation.study.measure import measure_pair
from thegra_core.evaluation.study.pairs import pairs_at_interval
from thegra_core.evaluation.study.run import Plan, variants
from thegra_core.evaluation.study.variants import CHAINS, FRONT_ENDS, PAPER_CHAIN
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.messages import Features, Frame, Matches
from thegra_core.preprocessing.chain import Chain

SECOND = 1_000_000_000
CAMERA = CameraModel(np.array([[200.0, 0, 160], [0, 200, 120], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (320, 240))


@pytest.mark.parametrize(
    ("stamps_s", "interval_s", "most", "expected"),
    [
        ([0, 1, 2, 3], 1.0, 9, [(0, 1), (1, 2), (2, 3)]),
        ([0, 1, 2, 3], 2.0, 9, [(0, 2), (1, 3)]),
        ([0, 1, 2, 3], 1.4, 9, [(0, 1), (1, 2), (2, 3)]),
        ([0, 3, 6], 0.5, 9, [(0, 1), (1, 2)]),  # a photo flight: neighbours
        ([0, 1, 2, 9, 10], 1.0, 9, [(0, 1), (1, 2), (3, 4)]),  # nothing across the gap
        (list(range(11)), 1.0, 3, [(0, 1), (4, 5), (9, 10)]),
        ([5], 1.0, 9, []),
    ],
)
def test_pairs_by_hand(stamps_s: list[float], interval_s: float, most: int, expected: list[tuple[int, int]]) -> None:
    assert pairs_at_interval([int(s * SECOND) for s in stamps_s], interval_s, most) == expected


class _Given:
    """An extractor that gives a frame's own keypoints, told by its stamp."""

    name = "given"

    def __init__(self, keypoints: dict[int, np.ndarray]) -> None:
        self._keypoints = keypoints

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        points = self._keypoints[stamp_ns].astype(np.float32)
        return Features(stamp_ns, points, np.ones(len(points), np.float32), np.ones((len(points), 1), np.float32), (320, 240), self.name)


class _InOrder:
    name = "in order"

    def match(self, query: Features, reference: Features) -> Matches:
        count = min(len(query), len(reference))
        return Matches(query.stamp_ns, reference.stamp_ns, np.stack([np.arange(count)] * 2, axis=1).astype(np.int32), np.ones(count, np.float32))

    def match_many(self, query: Features, references: list[Features]) -> list[Matches]:
        return [self.match(query, r) for r in references]


def test_a_pair_by_hand() -> None:
    """A camera that moves along x: true epipolar lines are rows. 100 right matches, 20 that lie 10 rows off."""
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-1, 1, 120), rng.uniform(-1, 1, 120), rng.uniform(2, 6, 120)], axis=1)
    first = CAMERA.project(points)
    second = CAMERA.project(points - [0.4, 0, 0])
    second[100:, 1] += 10
    motion = np.eye(4)
    motion[0, 3] = -0.4
    extractor = _Given({1: first, 2: second})
    blank = np.zeros((240, 320), np.uint8)
    result = measure_pair(Chain(PreprocessingConfig()), extractor, _InOrder(), Frame(1, 0, blank), Frame(2, 1, blank), CAMERA, motion)  # type: ignore[arg-type]
    assert (result.keypoints, result.matches, result.right) == (120, 120, 100)
    assert 95 <= result.inliers <= 102
    assert result.epipolar_px == pytest.approx(0, abs=1e-3)
    cells = {(int(x * 8 / 320), int(y * 8 / 240)) for x, y in second[:100]}
    assert result.spread == pytest.approx(len(cells) / 64, abs=0.05)
    unknown = measure_pair(Chain(PreprocessingConfig()), extractor, _InOrder(), Frame(1, 0, blank), Frame(2, 1, blank), CAMERA)  # type: ignore[arg-type]
    assert unknown.right is None and unknown.epipolar_px is None


def test_every_variant_can_be_made() -> None:
    for config in CHAINS.values():
        assert Chain(config)(np.arange(64 * 64, dtype=np.uint16).reshape(64, 64), 0).dtype == np.uint8
    assert PAPER_CHAIN in CHAINS
    for name in ("SIFT", "ORB"):
        make_extractor(FRONT_ENDS[name].extractor)
        make_matcher(FRONT_ENDS[name].matcher, FRONT_ENDS[name].extractor)
    plan = Plan((), Path(), 1.0, front_end="ORB", chains=("HE", PAPER_CHAIN), front_ends=("ORB", "SIFT"))
    assert variants(plan) == [("HE", "ORB"), (PAPER_CHAIN, "ORB"), (PAPER_CHAIN, "SIFT")]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A textured plane that slides by 6 px a frame, with calibration and ground truth."""
    folder = tmp_path / "slide"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(3)
    plane = cv2.GaussianBlur(rng.integers(0, 4000, (240, 420)).astype(np.float32), (0, 0), 2.0)
    lines, truth = [], []
    for index in range(6):
        image = (7000 + 6 * plane[:, 6 * index : 6 * index + 320] + rng.normal(0, 4, (240, 320))).astype(np.uint16)
        cv2.imwrite(str(folder / "images" / f"{index}.png"), image)
        lines.append(f"{index}.0 images/{index}.png\n")
        truth.append(f"{index}.0 {index * 0.06} 0 0 0 0 0 1\n")  # 2 m away, f 200: 6 px
    (folder / "images.txt").write_text("".join(lines))
    (folder / "groundtruth.txt").write_text("".join(truth))
    (folder / "camera.yaml").write_text(
        "image_width: 320\nimage_height: 240\ndistortion_model: plumb_bob\ncamera_matrix: {rows: 3, cols: 3, data: [200, 0, 160, 0, 200, 120, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    return folder


def test_the_command_writes_table_and_pictures(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["study", str(recording), "--interval", "1", "--front-end", "ORB", "--front-end", "SIFT", "--chain", "HE", "--chain", PAPER_CHAIN, "--out", str(out)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    with (out / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 5 * 3
    orb = [row for row in rows if (row["chain"], row["front_end"]) == (PAPER_CHAIN, "ORB")]
    assert np.median([int(row["matches"]) for row in orb]) > 50
    assert np.median([float(row["epipolar_px"]) for row in orb]) < 1.0
    assert all(int(row["right"]) > 0.8 * int(row["matches"]) for row in orb)
    for name in ("contrast.png", "filters.png", "front_ends.png", "detections.png"):
        assert cv2.imread(str(out / name)) is not None, name
    assert "| slide | HE | ORB |" in (out / "study.md").read_text()


def test_wrong_use_says_what_to_type(recording: Path, tmp_path: Path) -> None:
    for arguments, message in (
        (["--front-end", "FAST"], "known: 'SuperPoint + LightGlue'"),
        (["--chain", "magic", "--front-end", "ORB"], "known: 'stretch', 'HE'"),
    ):
        done = CliRunner().invoke(app, ["study", str(recording), "--interval", "1", *arguments, "--out", str(tmp_path / "o")])
        assert done.exit_code == 2 and message in done.output
    done = CliRunner().invoke(app, ["study", str(recording), "--interval", "60", "--front-end", "ORB", "--out", str(tmp_path / "o")])
    assert done.exit_code == 2 and "thegra info" in done.output
    (tmp_path / "file").touch()
    done = CliRunner().invoke(app, ["study", str(recording), "--interval", "60", "--front-end", "ORB", "--out", str(tmp_path / "file")])
    assert done.exit_code == 2 and f"cannot write to {tmp_path / 'file'}" in done.output, "told before the recording is read"
