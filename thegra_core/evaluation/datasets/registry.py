"""Data sets by the names that the command line takes."""

from __future__ import annotations

from collections.abc import Mapping

from thegra_core.evaluation.datasets.rovtio import find_rovtio
from thegra_core.evaluation.datasets.sequence import DataSet
from thegra_core.evaluation.datasets.vivid import find_vivid

DATASETS: Mapping[str, DataSet] = {"vivid": find_vivid, "rovtio": find_rovtio}
