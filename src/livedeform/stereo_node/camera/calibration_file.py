"""ROS ``camera_calibration`` files: reading, checking and writing one camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform.common.errors import CalibrationError, InputError
from livedeform.common.types import Array, CameraCalibration
from livedeform.common.yaml_text import parse_yaml

__all__ = ["camera_from_mapping", "read_camera", "write_camera"]

N_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12), "equidistant": (4,)}
LARGEST = 65_536  # pixels along a side
KEYS = (
    "image_width", "image_height", "camera_matrix", "distortion_coefficients", "rectification_matrix",
    "projection_matrix",
)  # fmt: skip


def read_camera(path: Path) -> CameraCalibration:
    """Read a ROS ``camera_calibration`` YAML file; ``CalibrationError`` names the key that is wrong."""
    try:
        _, document = parse_yaml(Path(path).read_text(), str(path))
    except OSError as error:
        raise CalibrationError(
            f"cannot read it ({error.strerror})", where=str(path), remedy="check stereo.left and stereo.right"
        ) from error
    except (InputError, UnicodeDecodeError) as error:
        raise CalibrationError(
            "not a YAML file",
            where=str(path),
            remedy="give a ROS camera_calibration file, as livedeform calibrate writes",
        ) from error
    if not isinstance(document, Mapping):
        raise CalibrationError("holds no keys", where=str(path), remedy="give a ROS camera_calibration file")
    return camera_from_mapping(document, where=str(path))


def camera_from_mapping(document: Mapping[str, Any], where: str = "") -> CameraCalibration:
    """Return the camera of a parsed ROS ``camera_calibration`` document; ``where`` names it in errors."""
    missing = [key for key in KEYS if key not in document]
    if missing:
        raise CalibrationError(
            f"has no {missing[0]}", where=where, remedy="give a ROS camera_calibration file of a stereo calibration"
        )
    return checked(
        CameraCalibration(
            name=str(document.get("camera_name", "camera")),
            width=_size(document, "image_width", where),
            height=_size(document, "image_height", where),
            camera_matrix=_matrix(document, "camera_matrix", (3, 3), where),
            dist_coeffs=_matrix(document, "distortion_coefficients", (-1,), where),
            rectification=_matrix(document, "rectification_matrix", (3, 3), where),
            projection=_matrix(document, "projection_matrix", (3, 4), where),
            distortion_model=str(document.get("distortion_model", "plumb_bob")),
        ),
        where,
    )


def _size(document: Mapping[str, Any], key: str, where: str) -> int:
    """Return a whole number of pixels."""
    value = document[key]
    if not isinstance(value, int | float) or not 0 <= value <= LARGEST:  # nan is neither
        raise CalibrationError(f"{key} is no number of pixels", where=where, remedy="calibrate again")
    return int(value)


def _matrix(document: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Array:
    """Return the numbers of ``key`` in ``shape`` (-1: any length)."""
    entry = document.get(key)
    data = entry.get("data") if isinstance(entry, Mapping) else entry
    try:
        values = np.asarray(data, float).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{key} holds no numbers", where=where, remedy=f"give {key}.data as a list") from error
    if (-1 not in shape and values.size != np.prod(shape)) or not np.isfinite(values).all() or values.size == 0:
        raise CalibrationError(
            f"{key} must hold {'x'.join(map(str, shape))} finite numbers", where=where, remedy="calibrate again"
        )
    return values.reshape(shape)


def checked(camera: CameraCalibration, where: str = "") -> CameraCalibration:
    """Return the camera itself, or ``CalibrationError`` where its numbers cannot be a calibration."""
    where = where or camera.name
    if camera.distortion_model not in N_COEFFICIENTS:
        raise CalibrationError(
            f"distortion_model '{camera.distortion_model}' is unknown",
            where=where,
            remedy=f"use one of {', '.join(N_COEFFICIENTS)}",
        )
    allowed = N_COEFFICIENTS[camera.distortion_model]
    n = camera.dist_coeffs.size
    if (camera.distortion_model == "plumb_bob" and n == 0) or n > max(allowed):
        raise CalibrationError(
            f"{n} distortion coefficients for the model {camera.distortion_model}",
            where=where,
            remedy=f"give {allowed[-1]}",
        )
    fx, fy = camera.camera_matrix[0, 0], camera.camera_matrix[1, 1]
    if fx <= 0 or fy <= 0 or camera.projection[0, 0] <= 0 or camera.width <= 0 or camera.height <= 0:
        raise CalibrationError(
            "the focal length or the picture size is not positive",
            where=where,
            remedy="calibrate; an empty file has zeros",
        )
    if not np.allclose(camera.rectification @ camera.rectification.T, np.eye(3), atol=1e-3):
        raise CalibrationError("rectification_matrix is no rotation", where=where, remedy="calibrate the pair again")
    return camera


def write_camera(camera: CameraCalibration, path: Path) -> None:
    """Write the ROS ``camera_calibration`` YAML that ``read_camera`` and ROS' tools read."""

    def matrix(values: Array) -> dict[str, Any]:
        rows, cols = np.atleast_2d(values).shape
        return {"rows": rows, "cols": cols, "data": [float(v) for v in values.ravel()]}

    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": camera.name,
        "camera_matrix": matrix(camera.camera_matrix),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": matrix(camera.dist_coeffs),
        "rectification_matrix": matrix(camera.rectification),
        "projection_matrix": matrix(camera.projection),
    }
    Path(path).write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None))
