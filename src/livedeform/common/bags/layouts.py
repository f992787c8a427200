"""PointCloud2 layouts as structured numpy types, and rows of them from and to our types; shared by ROS and bags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, Ids, MarkerFrame

COVARIANCE_FIELDS = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]

STEREO_MARKERS = np.dtype(
    [*_XYZ, ("id", "<u4"), *((c, "<f4") for c in COVARIANCE_FIELDS), ("reprojection_error", "<f4")]
)
STEREO_SURFACE = np.dtype(_XYZ)
STEREO_SURFACE_WITH_COVARIANCE = np.dtype([*_XYZ, *((c, "<f4") for c in COVARIANCE_FIELDS)])
FEM_SURFACE = np.dtype([*_XYZ, ("node", "<u4")])
FEM_MARKERS = np.dtype([*_XYZ, ("id", "<u4")])
COMPARE_MARKERS = np.dtype([*_XYZ, ("ex", "<f4"), ("ey", "<f4"), ("ez", "<f4"), ("error", "<f4"), ("id", "<u4")])

FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
POSITIVE = 1e-12  # of a minor of numbers up to 1: a thousand times what rounding can make
MAX_POINT_STEP = 65_536  # bytes of one point
DAMAGED = "the message is damaged; record again"
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


def pack_surface_points(points: Array, covariances: Array | None) -> NDArray[Any]:
    """Return the rows of ``/stereo/surface``, with covariances (n, 3, 3) m2 where they are given."""
    if covariances is None:
        return pack(STEREO_SURFACE, points=points)
    rows = pack(STEREO_SURFACE_WITH_COVARIANCE, points=points)
    for name, i, j in zip(COVARIANCE_FIELDS, *_UPPER, strict=True):
        rows[name] = covariances[:, i, j]
    return rows


def unpack_marker_frame(stamp_ns: int, rows: NDArray[Any]) -> MarkerFrame:
    """Read a frame of ``/stereo/markers``; fields left out by another tracker are NaN, so are impossible covariances.

    Markers of one id that are at two places are left out. ``RecordingError`` without ids: the order of the rows says
    nothing.
    """
    columns = marker_columns(rows)[0]
    once = ~named_twice(columns[0], np.asarray(np.isfinite(columns[1]).all(axis=1)))
    return MarkerFrame(stamp_ns, *(columns if once.all() else (column[once] for column in columns)))


def named_twice(marker_ids: Ids, told: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which (n,) of a frame's rows have an id that another has too, of those that are ``told`` (n,): nobody
    knows which of them is that marker."""
    _, row, count = np.unique(marker_ids[told], return_inverse=True, return_counts=True)
    out = np.zeros(len(marker_ids), bool)
    out[told] = count[row] > 1
    return out


def marker_columns(rows: NDArray[Any]) -> tuple[tuple[Ids, Array, Array, Array], int]:
    """Return what a `MarkerFrame` has of its markers, and how many covariances are impossible."""
    error = np.full(len(rows), np.nan)
    if "reprojection_error" in (rows.dtype.names or ()):
        error = rows["reprojection_error"].astype(float)
    marker_ids, covariances = ids(rows), read_covariances(rows)
    wrong = wrong_covariances(covariances)
    covariances[wrong] = np.nan
    return (marker_ids, points(rows), covariances, error), int(wrong.sum())


def read_covariances(rows: NDArray[Any]) -> Array:
    """The covariances (n, 3, 3) m2 as they are recorded; NaN where there are none."""
    covariances = np.full((len(rows), 3, 3), np.nan)
    if all(name in (rows.dtype.names or ()) for name in COVARIANCE_FIELDS):
        for name, i, j in zip(COVARIANCE_FIELDS, *_UPPER, strict=True):
            covariances[:, i, j] = covariances[:, j, i] = rows[name]
    return covariances


def wrong_covariances(covariances: Array) -> NDArray[np.bool_]:
    """Return which (n,) are stated and yet no covariances: infinite, in part NaN, with a negative eigenvalue, or zero,
    by which ROS says that it is unknown."""
    unstated = np.isnan(covariances).all(axis=(1, 2))
    finite = np.isfinite(covariances).all(axis=(1, 2))
    wrong: NDArray[np.bool_] = np.asarray(~unstated & ~finite)
    rows = np.flatnonzero(finite)
    largest = np.abs(covariances[rows]).max(axis=(1, 2), initial=0.0)[:, None, None]
    scaled = covariances[rows] / np.where(largest > 0, largest, 1.0)  # of any size: eigenvalues do not overflow
    doubtful = ~_surely_positive(scaled)
    lowest, highest = np.linalg.eigvalsh(scaled[doubtful])[:, [0, 2]].T
    wrong[rows[doubtful]] = (lowest < -1e-4 * np.abs(highest)) | (highest <= 0.0)  # single precision rounds
    return wrong


def _surely_positive(C: Array) -> NDArray[np.bool_]:
    """Return which symmetric matrices (n, 3, 3) of numbers up to 1 are positive definite, far beyond rounding
    (Sylvester's criterion)."""
    a, b, c, d, e, f = C[:, 0, 0], C[:, 0, 1], C[:, 0, 2], C[:, 1, 1], C[:, 1, 2], C[:, 2, 2]
    minor = a * d - b * b
    whole = f * minor - a * e * e + 2.0 * b * c * e - d * c * c
    return np.asarray((a > POSITIVE) & (minor > POSITIVE) & (whole > POSITIVE))


def points(rows: NDArray[Any]) -> Array:
    """Return x, y, z of the rows as (n, 3)."""
    return vectors(rows)


def ids(rows: NDArray[Any]) -> Ids:
    """Return the ids (n,) of the rows; ``RecordingError`` where there are none, or no whole numbers."""
    if "id" not in (rows.dtype.names or ()):
        raise RecordingError(NO_ID, remedy="record x, y, z and id: nothing else says which marker is which")
    given = rows["id"]
    whole = np.isfinite(given) & (given >= 0) & (given < 2**32)
    if not whole.all() or (given != np.floor(given)).any():
        raise RecordingError("the point cloud has ids that are no whole numbers", remedy="record ids as uint32")
    return np.asarray(given, np.uint32)


def vectors(rows: NDArray[Any], names: Sequence[str] = ("x", "y", "z")) -> Array:
    """Return the fields ``names`` of the rows as (n, k), whatever their precision."""
    missing = [name for name in names if name not in (rows.dtype.names or ())]
    if missing:
        raise RecordingError(f"the point cloud has no field {', '.join(missing)}", remedy="record x, y and z in metres")
    with np.errstate(invalid="ignore"):  # NaN of another precision
        return np.stack([rows[name].astype(float) for name in names], axis=1)


def unpack(cloud: Any) -> NDArray[Any]:
    """Return the rows (n,) of a sensor_msgs/PointCloud2 of any layout, without fields that hold several values.

    rclpy's and rosbags' objects have the same fields. ``RecordingError`` where they contradict each other.
    """
    dtype = _row_type(cloud)
    data = np.frombuffer(cloud.data, np.uint8)
    n_bytes = cloud.width * cloud.point_step  # of a line
    line = cloud.row_step if cloud.height > 1 else n_bytes
    if line < n_bytes or len(data) < line * max(cloud.height - 1, 0) + n_bytes * min(cloud.height, 1):
        raise RecordingError(
            f"a point cloud announces {cloud.width * cloud.height} points, but holds "
            f"{len(data) // max(cloud.point_step, 1)}",
            remedy=DAMAGED,
        )
    if line != n_bytes:
        starts = range(0, line * cloud.height, line)
        data = np.concatenate([data[start : start + n_bytes] for start in starts])
    n = cloud.width * cloud.height
    return np.frombuffer(data[: n * cloud.point_step].tobytes(), dtype, count=n) if n else np.zeros(0, dtype)


def _row_type(cloud: Any) -> np.dtype:
    """Return the structured type of one point: the fields with one value."""
    order = ">" if cloud.is_bigendian else "<"
    names = [f.name for f in cloud.fields]
    if len(set(names)) < len(names) or "" in names:
        raise RecordingError("a point cloud has two fields of one name, or one without", remedy=DAMAGED)
    unknown = [f for f in cloud.fields if f.datatype not in FORMATS]
    if unknown:
        what = f"a point cloud's field '{unknown[0].name}' has the datatype {unknown[0].datatype}"
        raise RecordingError(what, remedy="known are 1 to 8, see sensor_msgs/PointField")
    beyond = [f for f in cloud.fields if f.offset + _size(f) > cloud.point_step]
    if beyond or not 0 < cloud.point_step <= MAX_POINT_STEP:
        what = f"a point cloud's points of {cloud.point_step} bytes"
        what += f" do not hold their field '{beyond[0].name}'" if beyond else " can hold nothing"
        raise RecordingError(what, remedy=DAMAGED)
    single = [f for f in cloud.fields if f.count <= 1]
    return np.dtype(
        {
            "names": [f.name for f in single],
            "formats": [order + FORMATS[f.datatype] for f in single],
            "offsets": [f.offset for f in single],
            "itemsize": cloud.point_step,
        }
    )


def _size(field: Any) -> int:
    return max(int(field.count), 1) * int(FORMATS[field.datatype][1:])
