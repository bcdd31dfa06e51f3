"""Data sets by the names that the command line takes."""

from __future__ import annotations

from collections.abc import Mapping

from thegra_core.evaluation.datasets.euroc import find_euroc
from thegra_core.evaluation.datasets.generic import find_generic
from thegra_core.evaluation.datasets.kitti import find_kitti
from thegra_core.evaluation.datasets.rovtio import find_rovtio
from thegra_core.evaluation.datasets.sequence import DataSet
from thegra_core.evaluation.datasets.tum import find_tum
from thegra_core.evaluation.datasets.vivid import find_vivid

DATASETS: Mapping[str, DataSet] = {"vivid": find_vivid, "rovtio": find_rovtio, "tum": find_tum, "euroc": find_euroc, "kitti": find_kitti, "generic": find_generic}
