"""Camera files and CameraInfo messages to a CameraModel: ROS, Kalibr and OpenCV yaml, and plain numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thegra_core.errors import CalibrationError
from thegra_core.geometry.camera import CameraModel, DistortionModel

BESIDE = ("camera.yaml", "calibration.yaml", "camera_info.yaml", "camchain.yaml", "camera.yml", "calibration.yml", "camera.txt", "calibration.txt")

_MODELS = {
    "": DistortionModel.PLUMB_BOB, "none": DistortionModel.PLUMB_BOB, "plumb_bob": DistortionModel.PLUMB_BOB, "radtan": DistortionModel.PLUMB_BOB,
    "pinhole": DistortionModel.PLUMB_BOB, "radial-tangential": DistortionModel.PLUMB_BOB, "rational_polynomial": DistortionModel.RATIONAL_POLYNOMIAL,
    "equidistant": DistortionModel.EQUIDISTANT, "equi": DistortionModel.EQUIDISTANT, "fisheye": DistortionModel.EQUIDISTANT,
    "kannala_brandt": DistortionModel.EQUIDISTANT, "kannalabrandt8": DistortionModel.EQUIDISTANT, "opencv_fisheye": DistortionModel.EQUIDISTANT,
}  # fmt: skip
_MATRIX_KEYS = ("camera_matrix", "cameramatrix", "k", "m1", "intrinsic_matrix", "intrinsics")
_DISTORTION_KEYS = ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distcoeffs", "d", "d1", "distortion")
_FORMS = "ROS camera_info yaml, Kalibr camchain yaml, OpenCV yaml, or one line: fx,fy,cx,cy or fx fy cx cy width height k1 k2 p1 p2 k3"


def load_camera(path: Path | str, camera: str | None = None, image_size: tuple[int, int] | None = None) -> CameraModel:
    """Read a camera file.

    Args:
        path: ROS camera_info yaml, Kalibr camchain, OpenCV FileStorage yaml, or plain text `fx,fy,cx,cy` or `fx fy cx cy width height [k1 k2 p1 p2 k3]`.
        camera: Which camera of a file with several (`cam0`, or its topic).
        image_size: (width, height) of the images, for files that do not say it.

    Raises:
        CalibrationError: If the file cannot be read or understood, holds several cameras and none was picked, or has no usable intrinsics.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read the camera file {path}: {getattr(error, 'strerror', None) or error}") from error
    numbers = _plain_numbers(text)
    if numbers is not None:
        return _from_numbers(numbers, path, image_size)
    values = _parse_yaml(text, path)
    chain = {key: value for key, value in values.items() if isinstance(value, dict) and "intrinsics" in value and "camera_model" in value}
    if chain:
        return _from_kalibr(chain, camera, path, image_size)
    return _from_matrix_yaml(values, path, image_size)


def is_rectified(topic: str) -> bool:
    """Whether an image topic says by its name that its images have been freed of the lens's distortion: `image_rect`, `image_rect_color`, `image_rect/compressed`."""
    return topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")


def camera_from_info(info: Any, rectified: bool = False) -> CameraModel | None:
    """sensor_msgs/CameraInfo (ROS 1 or 2 field names) to a camera; None when its K (P of rectified images) is all zero, which says: not calibrated.

    Args:
        rectified: The images are those after rectification: a pinhole with the left of the matrix P, and no distortion (sensor_msgs/CameraInfo).

    Raises:
        CalibrationError: If the model is unknown or the numbers are unusable.
    """
    if rectified:
        matrix = np.asarray(getattr(info, "p", None) if hasattr(info, "p") else info.P, dtype=np.float64).reshape(3, 4)[:, :3]
        distortion, model = np.zeros(5), DistortionModel.PLUMB_BOB
    else:
        matrix = np.asarray(getattr(info, "k", None) if hasattr(info, "k") else info.K, dtype=np.float64).reshape(3, 3)
        distortion = np.asarray(getattr(info, "d", None) if hasattr(info, "d") else info.D, dtype=np.float64)
        model = _model(str(info.distortion_model), len(distortion), f"camera_info {info.header.frame_id}") if np.any(matrix) else DistortionModel.PLUMB_BOB
    if not np.any(matrix):
        return None
    return CameraModel(matrix, distortion, model, (int(info.width), int(info.height)), str(info.header.frame_id))


def camera_beside(folders: Iterable[Path]) -> tuple[CameraModel | None, list[str]]:
    """The camera of the first camera file found in `folders`, and what to tell the user about it."""
    for folder in folders:
        for name in BESIDE:
            if (folder / name).is_file():
                try:
                    return load_camera(folder / name), [f"camera from {folder / name}"]
                except CalibrationError as error:
                    return None, [f"camera file beside the images not used: {error}"]
    return None, []


def check_image_size(camera: CameraModel, image_shape: Sequence[int]) -> None:
    """Refuse images of another size than the camera's; intrinsics are never scaled silently.

    Args:
        camera: The camera.
        image_shape: (height, width) as numpy says it.

    Raises:
        CalibrationError: Naming both sizes.
    """
    height, width = int(image_shape[0]), int(image_shape[1])
    if (width, height) != camera.image_size:
        raise CalibrationError(
            f"the images are {width}x{height} but the camera {camera.name or 'file'} is for {camera.image_size[0]}x{camera.image_size[1]}: "
            "give the calibration of these images with --camera FILE (intrinsics are not scaled for you: cropping and scaling need different numbers)"
        )


def camera_template(width: int, height: int) -> str:
    """A camera file in ROS camera_info form to fill in, for images of this size."""
    return (
        f"image_width: {width}\nimage_height: {height}\ncamera_name: thermal\n"
        "distortion_model: plumb_bob   # or rational_polynomial, equidistant\n"
        "camera_matrix: {rows: 3, cols: 3, data: [FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [K1, K2, P1, P2, K3]}\n"
    )


def missing_camera(name: str, width: int, height: int) -> CalibrationError:
    """The error for a recording whose intrinsics nobody knows; it shows the file to fill in."""
    return CalibrationError(
        f"no intrinsics for {name}: it has no calibrated camera_info and no camera file beside it. "
        f"Fill in the capitals, save as camera.yaml and add --camera camera.yaml\n\n{camera_template(width, height)}"
    )


def _model(name: str, coefficients: int, where: str) -> DistortionModel:
    key = name.strip().lower().replace(" ", "_")
    if key not in _MODELS:
        raise CalibrationError(f"{where}: unknown distortion model {name!r}; known: {', '.join(sorted(k for k in _MODELS if k))}")
    model = _MODELS[key]
    return DistortionModel.RATIONAL_POLYNOMIAL if model is DistortionModel.PLUMB_BOB and coefficients == 8 else model


def _plain_numbers(text: str) -> list[float] | None:
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    tokens = re.split(r"[,;\s]+", " ".join(line for line in lines if line).strip())
    try:
        return [float(token) for token in tokens]
    except ValueError:
        return None


def _from_numbers(numbers: list[float], path: Path, image_size: tuple[int, int] | None) -> CameraModel:
    if len(numbers) != 4 and not 6 <= len(numbers) <= 14:
        raise CalibrationError(f"{path} holds {len(numbers)} numbers; wanted: fx fy cx cy, or fx fy cx cy width height [k1 k2 p1 p2 k3]")
    if len(numbers) > 4:
        image_size = (round(numbers[4]), round(numbers[5]))
    distortion = numbers[6:]
    return _camera(_matrix(*numbers[:4]), distortion, _model("", len(distortion), str(path)), image_size, path)


def _from_kalibr(chain: Mapping[str, Mapping[str, Any]], camera: str | None, path: Path, image_size: tuple[int, int] | None) -> CameraModel:
    picked = [name for name, entry in chain.items() if camera is None or camera in (name, entry.get("rostopic"))]
    if len(picked) != 1:
        listed = "\n".join(f"  {name}  {entry.get('rostopic', '')}  {entry.get('resolution', '')}" for name, entry in chain.items())
        wanted = "holds several cameras" if camera is None else f"has no camera {camera!r}"
        raise CalibrationError(f"{path} {wanted}:\n{listed}\npick one with --camera {path}:{next(iter(chain))}")
    entry = chain[picked[0]]
    if entry["camera_model"] != "pinhole":
        raise CalibrationError(f"{path}, {picked[0]}: camera_model {entry['camera_model']!r} is not supported; calibrate as pinhole-radtan or pinhole-equi")
    distortion = _floats(entry.get("distortion_coeffs", []), path)
    size = entry.get("resolution", image_size)
    model = _model(str(entry.get("distortion_model", "none")), len(distortion), f"{path}, {picked[0]}")
    values = _floats(entry["intrinsics"], path)
    if len(values) != 4:
        raise CalibrationError(f"{path}, {picked[0]}: intrinsics must be [fx, fy, cx, cy], got {len(values)} numbers")
    return _camera(_matrix(*values), distortion, model, size, path, picked[0])


def _from_matrix_yaml(values: Mapping[str, Any], path: Path, image_size: tuple[int, int] | None) -> CameraModel:
    flat = {str(key).lower().removeprefix("camera.").removeprefix("camera1."): value for key, value in values.items()}
    matrix_value = next((flat[key] for key in _MATRIX_KEYS if key in flat), None)
    if matrix_value is None and {"fx", "fy", "cx", "cy"} <= flat.keys():
        matrix_value = [flat[key] for key in ("fx", "fy", "cx", "cy")]
    if matrix_value is None:
        raise CalibrationError(f"{path} holds no camera matrix; understood are: {_FORMS}")
    numbers = _floats(matrix_value, path)
    if len(numbers) not in (4, 9):
        raise CalibrationError(f"{path}: a camera matrix has 9 numbers, or fx, fy, cx, cy; found {len(numbers)}")
    matrix = _matrix(*numbers) if len(numbers) == 4 else numbers
    if not any(numbers):
        raise CalibrationError(f"{path}: the camera matrix is all zero, which says that the camera is not calibrated")
    named = str(flat.get("distortion_model", flat.get("model", flat.get("type", ""))))
    single = ("k1", "k2", "k3", "k4") if _model(named, 0, str(path)) is DistortionModel.EQUIDISTANT else ("k1", "k2", "p1", "p2", "k3")
    distortion = _floats(next((flat[key] for key in _DISTORTION_KEYS if key in flat), [flat.get(key, 0.0) for key in single]), path)
    size = (flat.get("image_width", flat.get("width")), flat.get("image_height", flat.get("height")))
    model = _model(named, len(distortion), str(path))
    return _camera(matrix, distortion, model, size if all(size) else image_size, path, str(flat.get("camera_name", "")))


def _camera(matrix: Any, distortion: Sequence[float], model: DistortionModel, size: Any, path: Path, name: str = "") -> CameraModel:
    if size is None:
        raise CalibrationError(f"{path} does not say the image size; add it: image_width / image_height, or the plain form fx fy cx cy width height")
    array = np.asarray(matrix, dtype=np.float64).reshape(3, 3)
    try:
        return CameraModel(array, np.asarray(distortion, dtype=np.float64), model, (int(size[0]), int(size[1])), name or path.stem)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def _floats(value: Any, path: Path) -> list[float]:
    if isinstance(value, Mapping):
        value = value.get("data", [])
    try:
        return [float(x) for x in np.asarray(value, dtype=np.float64).ravel()]
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {value!r} are no numbers; fill in the capitals of the template") from error


def _parse_yaml(text: str, path: Path) -> dict[str, Any]:
    # OpenCV writes a directive that is no YAML 1.1 and tags its matrices, which are plain mappings
    body = re.sub(r"\A\ufeff?%YAML:?\s*[\d.]+\s*\n", "", text).replace("!!opencv-matrix", "")
    try:
        values = next(iter(yaml.safe_load_all(body)), None)  # `ros2 topic echo` ends each message with a document mark
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path} is not YAML ({error}); understood are: {_FORMS}") from error
    if not isinstance(values, dict):
        raise CalibrationError(f"{path} holds no camera; understood are: {_FORMS}")
    return values
