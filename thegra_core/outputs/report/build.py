"""The report page: figures and tables of a run, put into the template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jinja2

from thegra_core.config import ThegraConfig
from thegra_core.messages import Run
from thegra_core.outputs.metrics import RunScores
from thegra_core.outputs.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class ReportInput:
    """All that the page tells about."""

    run: Run
    config: ThegraConfig
    metrics: Mapping[str, Any]
    name: str
    path: str
    topic: str | None
    image_size: tuple[int, int]
    problems: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    command: str = ""
    started_utc: str = ""
    groundtruth: Trajectory | None = None
    scores: RunScores | None = None


def build_report(report: ReportInput) -> str:
    """The page as HTML that needs nothing from outside."""
    environment = jinja2.Environment(loader=jinja2.PackageLoader("thegra_core.outputs.report", "templates"), autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template("report.html.j2").render(report=report, metrics=report.metrics)
