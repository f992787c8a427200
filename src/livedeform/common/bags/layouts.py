"""PointCloud2 layouts as structured numpy types, and rows of them from and to our types; shared by ROS and bags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, MarkerFrame

COVARIANCE_FIELDS = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]

STEREO_MARKERS = np.dtype(
    [*_XYZ, ("id", "<u4"), *((c, "<f4") for c in COVARIANCE_FIELDS), ("reprojection_error", "<f4")]
)
FEM_SURFACE = np.dtype([*_XYZ, ("node", "<u4")])
FEM_MARKERS = np.dtype([*_XYZ, ("id", "<u4")])
COMPARE_MARKERS = np.dtype([*_XYZ, ("ex", "<f4"), ("ey", "<f4"), ("ez", "<f4"), ("error", "<f4"), ("id", "<u4")])

FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
NO_ID = "the point cloud has no field id"
DATATYPES = {name: number for number, name in FORMATS.items()}


class FieldRow(NamedTuple):
    """sensor_msgs/PointField: ``datatype`` as there, ``count`` 1."""

    name: str
    offset: int
    datatype: int


def field_rows(dtype: np.dtype) -> list[FieldRow]:
    """Return the PointField rows of a structured type."""
    rows = []
    for name in dtype.names or ():
        kind, offset = dtype.fields[name][:2]  # type: ignore[index]
        rows.append(FieldRow(name, offset, DATATYPES[kind.str[1:]]))
    return rows


def pack(dtype: np.dtype, **columns: Array | NDArray[np.uint32]) -> NDArray[Any]:
    """Return a structured array of ``dtype`` with the columns filled in; ``points`` (n, 3) fills x, y and z."""
    points = columns.pop("points")
    rows = np.zeros(len(points), dtype)
    rows["x"], rows["y"], rows["z"] = points.T
    for name, values in columns.items():
        rows[name] = values
    return rows


def pack_marker_frame(frame: MarkerFrame) -> NDArray[Any]:
    """Return the rows of ``/stereo/markers``."""
    rows = pack(STEREO_MARKERS, points=frame.points, id=frame.ids, reprojection_error=frame.reprojection_error_px)
    for name, i, j in zip(COVARIANCE_FIELDS, *_UPPER, strict=True):
        rows[name] = frame.covariances[:, i, j]
    return rows


def unpack_marker_frame(stamp_ns: int, rows: NDArray[Any]) -> MarkerFrame:
    """Read a frame of ``/stereo/markers``; fields left out by another tracker are NaN, so are impossible covariances.

    ``RecordingError`` without ids: the order of the rows says nothing.
    """
    names = rows.dtype.names or ()
    n = len(rows)
    if "id" not in names:
        raise RecordingError(NO_ID, remedy="record x, y, z and id: nothing else says which marker is which")
    covariances = read_covariances(rows)
    covariances[wrong_covariances(covariances)] = np.nan
    ids = rows["id"].astype(np.uint32)
    error = rows["reprojection_error"].astype(float) if "reprojection_error" in names else np.full(n, np.nan)
    return MarkerFrame(stamp_ns, ids, points(rows), covariances, error)


def read_covariances(rows: NDArray[Any]) -> Array:
    """The covariances (n, 3, 3) m2 as they are recorded; NaN where there are none."""
    covariances = np.full((len(rows), 3, 3), np.nan)
    if all(name in (rows.dtype.names or ()) for name in COVARIANCE_FIELDS):
        for name, i, j in zip(COVARIANCE_FIELDS, *_UPPER, strict=True):
            covariances[:, i, j] = covariances[:, j, i] = rows[name]
    return covariances


def wrong_covariances(covariances: Array) -> NDArray[np.bool_]:
    """Return which (n,) are stated and yet no covariances: infinite, in part NaN, or with a negative eigenvalue."""
    unstated = np.isnan(covariances).all(axis=(1, 2))
    finite = np.isfinite(covariances).all(axis=(1, 2))
    wrong: NDArray[np.bool_] = np.asarray(~unstated & ~finite)
    lowest, highest = np.linalg.eigvalsh(covariances[finite])[:, [0, 2]].T
    wrong[finite] = (lowest < -1e-4 * np.abs(highest)) | (highest < 0.0)  # single precision rounds
    return wrong


def points(rows: NDArray[Any]) -> Array:
    """Return x, y, z of the rows as (n, 3)."""
    missing = [name for name in "xyz" if name not in (rows.dtype.names or ())]
    if missing:
        raise RecordingError(f"the point cloud has no field {', '.join(missing)}", remedy="record x, y and z in metres")
    return np.stack([rows[name].astype(float) for name in "xyz"], axis=1)


def unpack(cloud: Any) -> NDArray[Any]:
    """Return the rows (n,) of a sensor_msgs/PointCloud2 of any layout; rclpy's and rosbags' objects have the same
    fields."""
    order = ">" if cloud.is_bigendian else "<"
    fields: Sequence[Any] = cloud.fields
    dtype = np.dtype(
        {
            "names": [f.name for f in fields],
            "formats": [
                (order + FORMATS[f.datatype], (f.count,)) if f.count > 1 else order + FORMATS[f.datatype]
                for f in fields
            ],
            "offsets": [f.offset for f in fields],
            "itemsize": cloud.point_step,
        }
    )
    data = np.frombuffer(cloud.data, np.uint8)
    n = cloud.width * cloud.height
    if cloud.height > 1 and cloud.row_step != cloud.width * cloud.point_step:
        data = data.reshape(cloud.height, cloud.row_step)[:, : cloud.width * cloud.point_step].reshape(-1)
    if len(data) < n * cloud.point_step:
        raise RecordingError(
            f"a point cloud announces {n} points, but holds {len(data) // max(cloud.point_step, 1)}",
            remedy="the message is damaged; record again",
        )
    return np.frombuffer(data.tobytes(), dtype, count=n)
