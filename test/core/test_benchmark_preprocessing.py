"""The benchmark of the filters: its report's form, and that ours and the libraries' results are the same picture."""

from __future__ import annotations

import json

import numpy as np
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.evaluation.benchmark.preprocessing import reference_chain
from thegra_core.preprocessing.chain import FILTERS


def test_every_filter_is_timed_and_the_chain_compared() -> None:
    done = CliRunner().invoke(app, ["benchmark", "preprocessing", "--frames", "1", "--repeats", "1", "--json"])
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["image_size"] == [640, 512] and report["frames"] == 1
    assert report["filters"].keys() == FILTERS.keys()
    assert all(figures["ms"] > 0 for figures in report["filters"].values())
    assert report["chain"]["ms"] > 0 and report["chain"]["reference_ms"] > 0
    assert report["chain"]["within_one_level_pct"] >= 99.9


def test_the_reference_is_a_picture() -> None:
    image = np.random.default_rng(0).integers(3000, 3400, (64, 80)).astype(np.uint16)
    out = reference_chain(image)
    assert out.dtype == np.uint8 and out.shape == image.shape and out.std() > 20
