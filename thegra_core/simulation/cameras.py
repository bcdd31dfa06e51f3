"""Lenses of real thermal cameras, scaled to the image size."""

from __future__ import annotations

from typing import Literal

import numpy as np

from thegra_core.geometry.camera import CameraModel, DistortionModel

Lens = Literal["a65", "tau2"]

_A65 = ((437.38861, 437.29476, 323.52845, 256.36315), (-0.431640703, 0.178116499, -0.001490512, -0.001138988, 0.0), DistortionModel.PLUMB_BOB)
"""FLIR A65 of ViViD++'s hand-held rig, as the data set publishes it: config/cameras/vivid_handheld_thermal.yaml."""
_TAU2 = ((440.381678762, 440.34105427, 328.082910449, 257.335140534), (-0.125172452973, -0.0158508045529, 0.00552041769855, 0.00188160221577), DistortionModel.EQUIDISTANT)
"""FLIR Tau 2 of ROVTIO, as published with it: config/cameras/rovtio_tau2.yaml."""
_WIDTH = 640


def thermal_camera(image_size: tuple[int, int] = (640, 512), lens: Lens = "a65") -> CameraModel:
    """The camera of ViViD++ (a65: 72 x 61 degrees, plumb_bob) or ROVTIO (tau2: 91 x 70 degrees, equidistant) with `image_size` (width, height) px.

    Focal lengths and centre are scaled by the width, about the outer corner of the top-left pixel.
    """
    (fx, fy, cx, cy), distortion, model = _A65 if lens == "a65" else _TAU2
    scale = image_size[0] / _WIDTH
    crop = (image_size[1] - scale * 512) / 2  # another aspect ratio cuts or adds rows on both sides
    matrix = np.array([[scale * fx, 0, scale * (cx + 0.5) - 0.5], [0, scale * fy, scale * (cy + 0.5) - 0.5 + crop], [0, 0, 1]])
    return CameraModel(matrix, np.array(distortion), model, image_size, name="thermal_camera")
