"""Makes the recording of `make demo`: python -m thegra_core.simulation.demo OUT."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import ThegraError
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.simulation.bag_writer import write_bag
from thegra_core.simulation.paths import PATHS
from thegra_core.simulation.renderer import pixel_rays, render
from thegra_core.simulation.scene import SCENES

FloatArray = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000


def thermal_camera(image_size: tuple[int, int] = (320, 256)) -> CameraModel:
    """A camera with a 63 degree wide view and the moderate distortion of a thermal lens."""
    width, height = image_size
    focal = 0.8125 * width
    matrix = np.array([[focal, 0.0, (width - 1) / 2 + 1.7], [0.0, focal, (height - 1) / 2 - 2.3], [0.0, 0.0, 1.0]])
    return CameraModel(matrix, np.array([-0.18, 0.05, 4e-4, -3e-4, 0.0]), DistortionModel.PLUMB_BOB, image_size, name="thermal_camera")


def make_demo_bag(
    out_dir: Path,
    scene: str = "room",
    duration_s: float = 10.0,
    rate_hz: float = 10.0,
    image_size: tuple[int, int] = (320, 256),
    noise_counts: float = 3.0,
    seed: int = 0,
) -> Path:
    """Write a rosbag2 folder of a camera that sways through a scene, with ground truth.

    Args:
        scene: A name in `scene.SCENES`.
        image_size: (width, height) px.
        noise_counts: White noise, standard deviation in counts.
        seed: Of the scene's textures and the noise.

    Raises:
        InputError: If the folder exists already.
    """
    camera = thermal_camera(image_size)
    rays, world, path = pixel_rays(camera), SCENES[scene](seed), PATHS[scene]
    rng = np.random.default_rng([seed, 1])

    def frames() -> Iterator[tuple[int, NDArray[np.uint16], FloatArray]]:
        for index in range(round(duration_s * rate_hz)):
            pose = path.world_from_camera(index / rate_hz)
            yield START_NS + round(index * 1e9 / rate_hz), render(world, rays, pose, noise_counts, rng).image, pose

    return write_bag(out_dir, camera, frames())


def main() -> int:
    """Command line: the folder to make."""
    if len(sys.argv) != 2:
        print("usage: python -m thegra_core.simulation.demo OUT", file=sys.stderr)
        return 2
    try:
        print(f"wrote {make_demo_bag(Path(sys.argv[1]))}")
    except ThegraError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
