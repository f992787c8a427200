"""PointCloud2 layouts as structured numpy types, and pictures from and to bytes; shared by ROS messages and bags."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, CameraCalibration, Image, MarkerFrame

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
    """The PointField rows of a structured type."""
    rows = []
    for name in dtype.names or ():
        kind, offset = dtype.fields[name][:2]  # type: ignore[index]
        rows.append(FieldRow(name, offset, DATATYPES[kind.str[1:]]))
    return rows


def pack(dtype: np.dtype, **columns: Array | NDArray[np.uint32]) -> NDArray[Any]:
    """A structured array of ``dtype`` with the columns filled in; ``points`` (n, 3) fills x, y and z."""
    points = columns.pop("points")
    rows = np.zeros(len(points), dtype)
    rows["x"], rows["y"], rows["z"] = points.T
    for name, values in columns.items():
        rows[name] = values
    return rows


def pack_marker_frame(frame: MarkerFrame) -> NDArray[Any]:
    """The rows of ``/stereo/markers``."""
    rows = pack(STEREO_MARKERS, points=frame.points, id=frame.ids, reprojection_error=frame.reprojection_error_px)
    for name, i, j in zip(COVARIANCE_FIELDS, *_UPPER, strict=True):
        rows[name] = frame.covariances[:, i, j]
    return rows


def unpack_marker_frame(stamp_ns: int, rows: NDArray[Any]) -> MarkerFrame:
    """A frame of ``/stereo/markers``; fields that another tracker leaves out are NaN, as are covariances that are none.

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
    """Which (n,) are stated and yet no covariances: infinite, in part NaN, or with a negative eigenvalue."""
    unstated = np.isnan(covariances).all(axis=(1, 2))
    finite = np.isfinite(covariances).all(axis=(1, 2))
    wrong = ~unstated & ~finite
    lowest, highest = np.linalg.eigvalsh(covariances[finite])[:, [0, 2]].T
    wrong[finite] = (lowest < -1e-4 * np.abs(highest)) | (highest < 0.0)  # single precision rounds
    return wrong


def points(rows: NDArray[Any]) -> Array:
    """x, y, z of the rows as (n, 3)."""
    missing = [name for name in "xyz" if name not in (rows.dtype.names or ())]
    if missing:
        raise RecordingError(f"the point cloud has no field {', '.join(missing)}", remedy="record x, y and z in metres")
    return np.stack([rows[name].astype(float) for name in "xyz"], axis=1)


def unpack(cloud: Any) -> NDArray[Any]:
    """The rows (n,) of a sensor_msgs/PointCloud2 of any layout; rclpy's and rosbags' objects have the same fields."""
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


# --- cameras and pictures --------------------------------------------------------------------------------------------


def read_camera_info(message: Any, name: str = "") -> CameraCalibration:
    """The calibration in a sensor_msgs/CameraInfo; its ``name`` is the frame's unless one is given."""
    return CameraCalibration(
        name=name or message.header.frame_id,
        width=int(message.width),
        height=int(message.height),
        camera_matrix=np.array(message.k, float).reshape(3, 3),
        dist_coeffs=np.array(message.d, float),
        rectification=np.array(message.r, float).reshape(3, 3),
        projection=np.array(message.p, float).reshape(3, 4),
        distortion_model=message.distortion_model,
    )


CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "rgb8": 3, "8UC3": 3, "bgra8": 4, "rgba8": 4, "8UC4": 4}
NAMES = {"8UC1": "mono8", "8UC3": "bgr8", "bgra8": "bgr8", "rgba8": "rgb8", "8UC4": "bgr8"}


def read_image(message: Any, stamp_ns: int) -> Image:
    """The picture of a sensor_msgs/Image (no copy where rows are not padded)."""
    frame_id = message.header.frame_id
    if message.encoding in ("mono16", "16UC1"):
        kind = ">u2" if message.is_bigendian else "<u2"
        wide = np.frombuffer(message.data, kind).reshape(message.height, message.step // 2)[:, : message.width]
        return Image(stamp_ns, (wide >> 8).astype(np.uint8), "mono8", frame_id)
    n_channels = CHANNELS.get(message.encoding)
    if n_channels is None:
        raise RecordingError(
            f"pictures of encoding '{message.encoding}' cannot be read", remedy="record mono8, bgr8 or rgb8"
        )
    rows = np.frombuffer(message.data, np.uint8)
    if len(rows) < message.height * message.step or message.step < message.width * n_channels:
        raise RecordingError("a picture holds fewer bytes than its size", remedy="the message is damaged; record again")
    rows = rows[: message.height * message.step].reshape(message.height, message.step)
    pixels = rows[:, : message.width * n_channels]
    if n_channels > 1:
        pixels = pixels.reshape(message.height, message.width, n_channels)[..., :3]
    return Image(stamp_ns, pixels, NAMES.get(message.encoding, message.encoding), frame_id)


def read_compressed_image(message: Any, stamp_ns: int) -> Image:
    """The picture of a sensor_msgs/CompressedImage, mono8 or rgb8."""
    from PIL import Image as Picture
    from PIL import UnidentifiedImageError

    try:
        with Picture.open(io.BytesIO(bytes(message.data))) as picture:
            gray = picture.mode in ("L", "1", "I", "I;16")
            if picture.mode in ("I", "I;16"):
                pixels = (np.asarray(picture).astype(np.uint16) >> 8).astype(np.uint8)
            else:
                pixels = np.array(picture.convert("L" if gray else "RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise RecordingError(
            f"a compressed picture ('{message.format}') cannot be read ({error})", remedy="record png or jpeg"
        ) from error
    return Image(stamp_ns, pixels, "mono8" if gray else "rgb8", message.header.frame_id)


def encode_picture(image: Image, kind: str = "png", quality: int = 90) -> bytes:
    """PNG (lossless) or JPEG bytes of a picture."""
    from PIL import Image as Picture

    pixels = image.pixels[..., ::-1] if image.encoding == "bgr8" else image.pixels
    out = io.BytesIO()
    options: dict[str, Any] = {"quality": quality} if kind == "jpeg" else {"compress_level": 1}
    Picture.fromarray(np.ascontiguousarray(pixels)).save(out, kind.upper(), **options)
    return out.getvalue()
