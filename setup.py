"""Installs `thegra_core`, `thegra_ros` and the command `thegra`, with pip or with colcon (build type ament_python)."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "thegra_ros"
ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()

# On Python 3.10 the newest gtsam is 4.2, which was built for numpy 1 and crashes with numpy 2; and kornia 0.9, which works there
# (thegra_core/features/python310.py), says that it does not, so pip must be told to take it: README.md, Installation.
REQUIRES = [
    "numpy>=1.26,<2; python_version < '3.11'",
    "numpy>=2.0; python_version >= '3.11'",
    "gtsam==4.2; python_version < '3.11'",
    "gtsam>=4.2.1; python_version >= '3.11'",
    "kornia>=0.9,<0.10; python_version >= '3.11'",
    "opencv-python-headless>=4.8",
    "scikit-image>=0.22",
    "scipy>=1.11",
    "rosbags>=0.11",
    "mcap>=1.2",
    "numba>=0.60",
    "threadpoolctl>=3.1",
    "poselib>=2.0.4",
    "pydantic>=2.7",
    "PyYAML>=6.0",
    "typer>=0.12",
    "rich>=13",
    "jinja2>=3.1",
    "matplotlib>=3.8",
    "torch>=2.4",
]
DASK = ["distributed>=2024.1"]
SIM = ["trimesh>=4.4", "embreex>=2.17.7"]
TEST = ["pytest>=8", "pytest-timeout>=2.2", "hypothesis>=6.100", "evo>=1.28", "pytransform3d>=3.5", *SIM]
ONNX = ["onnx>=1.17", "onnxscript>=0.3", "onnxruntime>=1.20"]
EXTRAS = {
    "onnx": ONNX,
    "openvino": [*ONNX[:2], "openvino>=2024.6"],
    "sim": SIM,
    "test": TEST,
    "dev": [*TEST, *DASK, *ONNX, "ruff>=0.5", "mypy>=1.10", "types-PyYAML", "import-linter>=2.1"],
    "dask": DASK,
    "viz": ["rerun-sdk>=0.23"],
    "ros": [
        "ros-jazzy-rclpy",
        "ros-jazzy-common-interfaces",
        "ros-jazzy-lifecycle-msgs",
        "ros-jazzy-rosgraph-msgs",
        "ros-jazzy-rmw-fastrtps-cpp",
    ],
}
NODES = ("slam", "preprocessing", "frontend", "tracking", "mapping")
"""Executables that `ros2 run thegra_ros` finds."""


def tree(target: str, folder: str, patterns: tuple[str, ...]) -> list[tuple[str, list[str]]]:
    """`data_files` entries that install `folder` with its sub-folders under `target`."""
    by_folder: dict[str, list[str]] = {}
    for pattern in patterns:
        for path in sorted((ROOT / folder).rglob(pattern)):
            relative = path.relative_to(ROOT)
            by_folder.setdefault(f"{target}/{relative.parent.as_posix()}", []).append(relative.as_posix())
    return sorted(by_folder.items())


setup(
    name=PACKAGE,
    version=MANIFEST.findtext("version"),
    description="Monocular SLAM for thermal cameras with learned features, for ROS 2 and the command line",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=["thegra_core", "thegra_core.*", "thegra_ros", "thegra_ros.*"]),
    package_data={
        "thegra_core": ["py.typed", "profiles/*.yaml", "**/*.j2", "**/*.css", "**/*.js"],
        "thegra_ros": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *tree(f"share/{PACKAGE}", "launch", ("*.py",)),
        *tree(f"share/{PACKAGE}", "config", ("*.yaml", "*.rviz", "*.xml", "*.json")),
    ],
    zip_safe=False,
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    entry_points={
        "console_scripts": ["thegra = thegra_core.cli.main:main", *(f"{name} = thegra_ros.nodes.{name}:main" for name in NODES)],
        "thegra.commands": ["live = thegra_ros.commands:live", "play = thegra_ros.commands:play"],
        "thegra.benchmarks": ["ros = thegra_ros.benchmark.commands:ros", "soak = thegra_ros.benchmark.commands:soak"],
    },
)
