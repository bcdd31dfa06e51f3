"""What is installed is whole: one version, the command, the data files; and the core imports without ROS."""

from __future__ import annotations

import configparser
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import thegra_core
from thegra_core.config import PROFILES
from thegra_core.sources.calibration import load_camera

ROOT = Path(__file__).resolve().parents[2]
IMPORT_ALL = """
import pkgutil, sys
sys.modules["rclpy"] = None  # any import of it fails
import thegra_core
names = [module.name for module in pkgutil.walk_packages(thegra_core.__path__, "thegra_core.")]
for name in names:
    if name.rsplit(".", 1)[-1] not in ("__main__", "python310"):
        __import__(name)
print(len(names))
"""


def test_version_is_that_of_the_manifest() -> None:
    assert thegra_core.__version__ == ElementTree.parse(ROOT / "package.xml").getroot().findtext("version")


def test_the_command_is_installed() -> None:
    (command,) = entry_points(group="console_scripts", name="thegra")
    assert callable(command.load())


def test_profiles_and_typing_marker_are_package_data() -> None:
    folder = files("thegra_core")
    assert folder.joinpath("py.typed").is_file()
    assert all(folder.joinpath(f"profiles/{name}.yaml").is_file() for name in PROFILES)


@pytest.mark.parametrize(
    ("name", "model", "half_field_deg"),
    [("vivid_handheld_thermal", "plumb_bob", (43.9, 35.2)), ("vivid_driving_thermal", "equidistant", None), ("rovtio_tau2", "equidistant", (43.9, 34.6))],
)
def test_camera_presets_load(name: str, model: str, half_field_deg: tuple[float, float] | None) -> None:
    """Half fields of view right of and below the principal point, from the published numbers by hand (equidistant: theta from r / f by iteration)."""
    camera = load_camera(ROOT / "config" / "cameras" / f"{name}.yaml")
    assert camera.image_size == (640, 512) and camera.model.value == model
    if half_field_deg is not None:
        edges = np.array([[639.0, camera.matrix[1, 2]], [camera.matrix[0, 2], 511.0]])
        angles = np.degrees(np.arctan(np.linalg.norm(camera.undistort(edges), axis=1)))
        np.testing.assert_allclose(angles, half_field_deg, atol=0.1)


def test_colcon_finds_the_package() -> None:
    assert (ROOT / "resource" / "thegra_ros").is_file()
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    assert settings["install"]["install_scripts"] == settings["develop"]["script_dir"] == "$base/lib/thegra_ros"
    assert settings["build_scripts"]["executable"] == "/usr/bin/env python3", "colcon's own Python may lack torch"


def test_every_module_of_the_core_imports_without_ros() -> None:
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20
