"""Our types <-> ROS messages. Every number passes ``float()``: rclpy serialises anything else to garbage silently."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2, PointField
from sensor_msgs.msg import Image as ImageMessage
from std_msgs.msg import Float64, Header
from visualization_msgs.msg import Marker, MarkerArray

from livedeform.common import topics as t
from livedeform.common.bags import layouts, pictures
from livedeform.common.experiment.schema import Lesion
from livedeform.common.frames import inverse, matrix_pose, unit_pose
from livedeform.common.stamps import read_stamp
from livedeform.common.types import (
    Array,
    CameraCalibration,
    Ids,
    Image,
    MarkerFrame,
    Pose,
    PredictedMarkers,
    Prediction,
    Wrench,
)

NS = 1_000_000_000


# --- time and header -------------------------------------------------------------------------------------------------


def to_time(stamp_ns: int) -> Time:
    return Time(sec=int(stamp_ns) // NS, nanosec=int(stamp_ns) % NS)


def from_time(time: Time) -> int:
    """Return the time in ns; ``RecordingError`` for one that no clock shows."""
    return read_stamp(time)


def to_header(stamp_ns: int, frame_id: str = t.FRAME_PHANTOM) -> Header:
    return Header(stamp=to_time(stamp_ns), frame_id=frame_id)


# --- pose, wrench, scalar --------------------------------------------------------------------------------------------


def from_pose_stamped(message: PoseStamped) -> Pose:
    """Return the pose with a unit quaternion; ``RecordingError`` for one that is no rotation or not finite."""
    p, q = message.pose.position, message.pose.orientation
    return unit_pose(from_time(message.header.stamp), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def to_wrench(wrench: Wrench, frame_id: str = t.FRAME_PHANTOM) -> WrenchStamped:
    message = WrenchStamped(header=to_header(wrench.stamp_ns, frame_id))
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z = (float(v) for v in wrench.force)
    torque.x, torque.y, torque.z = (float(v) for v in wrench.torque)
    return message


def to_transform(pose: Pose, parent: str, child: str) -> TransformStamped:
    """Make the message of T_parent_child."""
    message = TransformStamped(header=to_header(pose.stamp_ns, parent), child_frame_id=child)
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = (float(v) for v in pose.position)
    rotation.x, rotation.y, rotation.z, rotation.w = (float(v) for v in pose.orientation_xyzw)
    return message


def to_camera_transforms(stamp_ns: int, T_phantom_left: Array, T_right_left: Array) -> list[TransformStamped]:
    """Make the messages of where the cameras are: T_phantom_left and T_left_right."""
    left, right = matrix_pose(T_phantom_left, stamp_ns), matrix_pose(inverse(T_right_left), stamp_ns)
    return [to_transform(left, t.FRAME_PHANTOM, t.FRAME_LEFT), to_transform(right, t.FRAME_LEFT, t.FRAME_RIGHT)]


def to_float64(value: float) -> Float64:
    return Float64(data=float(value))


# --- pictures and cameras --------------------------------------------------------------------------------------------


def to_image(image: Image, frame_id: str | None = None) -> ImageMessage:
    pixels = np.ascontiguousarray(image.pixels)
    message = ImageMessage(header=to_header(image.stamp_ns, image.frame_id if frame_id is None else frame_id))
    message.height, message.width = int(pixels.shape[0]), int(pixels.shape[1])
    message.encoding = image.encoding
    message.step = int(pixels.strides[0])
    data = array("B")  # 0.13 ms for 720p; a numpy array takes 97 ms
    data.frombytes(pixels.data.cast("B"))
    message.data = data
    return message


def from_image(message: ImageMessage | CompressedImage) -> Image:
    """Return a raw or a compressed (png, jpeg) picture; ``RecordingError`` for an encoding that is not known."""
    stamp_ns = from_time(message.header.stamp)
    if isinstance(message, CompressedImage):
        return pictures.read_compressed_image(message, stamp_ns)
    return pictures.read_image(message, stamp_ns)


def from_camera_info(message: CameraInfo, name: str = "") -> CameraCalibration:
    return pictures.read_camera_info(message, name)


# --- point clouds ----------------------------------------------------------------------------------------------------


def to_cloud(stamp_ns: int, rows: NDArray[Any], frame_id: str = t.FRAME_PHANTOM) -> PointCloud2:
    """Return a PointCloud2 of a structured array (n,)."""
    message = PointCloud2(header=to_header(stamp_ns, frame_id))
    message.height, message.width = 1, len(rows)
    message.fields = [
        PointField(name=row.name, offset=row.offset, datatype=row.datatype, count=1)
        for row in layouts.field_rows(rows.dtype)
    ]
    message.is_bigendian = False
    message.point_step = int(rows.dtype.itemsize)
    message.row_step = int(rows.nbytes)
    message.is_dense = bool(np.isfinite(rows["x"]).all())
    data = array("B")
    data.frombytes(rows.tobytes())
    message.data = data
    return message


def to_marker_cloud(frame: MarkerFrame, frame_id: str = t.FRAME_PHANTOM) -> PointCloud2:
    """Make ``/stereo/markers`` of a frame."""
    return to_cloud(frame.stamp_ns, layouts.pack_marker_frame(frame), frame_id)


def from_marker_cloud(message: PointCloud2) -> MarkerFrame:
    return layouts.unpack_marker_frame(from_time(message.header.stamp), layouts.unpack(message))


def to_predicted_markers(prediction: Prediction) -> PointCloud2:
    """Make ``/fem/markers`` of a prediction."""
    rows = layouts.pack(layouts.FEM_MARKERS, points=prediction.markers, id=prediction.ids)
    return to_cloud(prediction.stamp_ns, rows)


def from_predicted_markers(message: PointCloud2) -> PredictedMarkers:
    """Return predicted markers of ``/fem/markers``."""
    rows = layouts.unpack(message)
    return PredictedMarkers(from_time(message.header.stamp), layouts.ids(rows), layouts.points(rows))


def to_predicted_surface(prediction: Prediction) -> PointCloud2:
    """Make ``/fem/surface`` of a prediction."""
    rows = layouts.pack(layouts.FEM_SURFACE, points=prediction.surface, node=prediction.surface_nodes)
    return to_cloud(prediction.stamp_ns, rows)


def from_predicted_surface(message: PointCloud2) -> tuple[int, Array]:
    """Return stamp (ns) and points (m, 3) m of ``/fem/surface``."""
    return from_time(message.header.stamp), layouts.points(layouts.unpack(message))


def to_compare_cloud(stamp_ns: int, ids: Ids, measured: Array, error: Array) -> PointCloud2:
    """Make ``/compare/markers``: ``measured`` (n, 3) and ``error`` (n, 3) = measured - predicted, m."""
    ex, ey, ez = error.T
    size = np.linalg.norm(error, axis=1)
    rows = layouts.pack(layouts.COMPARE_MARKERS, points=measured, ex=ex, ey=ey, ez=ez, error=size, id=ids)
    return to_cloud(stamp_ns, rows)


# --- for viewers -----------------------------------------------------------------------------------------------------


def to_lesions(prediction: Prediction, lesions: Sequence[Lesion]) -> MarkerArray:
    """Make ``/fem/lesions``: one sphere per lesion; deleted where the prediction did not converge."""
    message = MarkerArray()
    for i, (lesion, centre) in enumerate(zip(lesions, prediction.lesions, strict=True)):
        sphere = Marker(header=to_header(prediction.stamp_ns), ns=lesion.name, id=i, type=Marker.SPHERE)
        known = bool(np.isfinite(centre).all())
        sphere.action = Marker.ADD if known else Marker.DELETE
        position = sphere.pose.position
        position.x, position.y, position.z = (float(v) if known else 0.0 for v in centre)
        sphere.scale.x = sphere.scale.y = sphere.scale.z = float(lesion.diameter)
        _paint(sphere, (0.9, 0.2, 0.2, 0.9))
        message.markers.append(sphere)
    return message


def to_mesh_data(prediction: Prediction, colour: tuple[float, float, float, float] = (0.9, 0.7, 0.6, 0.6)) -> bytes:
    """Make ``/fem/mesh``, serialised: the surface as a Marker's TRIANGLE_LIST; deleted where the prediction did not
    converge.

    Of thousands of points, objects and their serialisation take 20 ms, during which no other thread of the node works.
    """
    message = Marker(header=to_header(prediction.stamp_ns), ns="fem", id=0, type=Marker.TRIANGLE_LIST)
    message.pose.orientation.w = 1.0
    message.scale.x = message.scale.y = message.scale.z = 1.0
    _paint(message, colour)
    if not prediction.converged:
        message.action = Marker.DELETE
        return bytes(serialize_message(message))
    return _with_points(message, prediction.surface[prediction.triangles.ravel()])


def _with_points(message: Marker, points: Array) -> bytes:
    """Return the message serialised with ``points`` (n, 3); its own may be any."""
    with_one, with_two = (_serialised(message, n) for n in (1, 2))
    words = np.stack([np.frombuffer(data[: len(with_one) // 4 * 4], "<u4") for data in (with_one, with_two)])
    count = 4 * int(np.flatnonzero((words[0] == 1) & (words[1] == 2))[0])  # where the number of points stands
    first = count + 4 + -count % 8  # doubles are aligned to 8 bytes, counted from behind the 4 of encapsulation
    number, doubles = np.array(len(points), "<u4"), np.asarray(points, "<f8")
    return (
        with_one[:count] + number.tobytes() + with_one[count + 4 : first] + doubles.tobytes() + with_one[first + 24 :]
    )


def _serialised(message: Marker, n_points: int) -> bytes:
    message.points = [Point()] * n_points
    return bytes(serialize_message(message))


def from_mesh_marker(message: Marker) -> tuple[Array, NDArray[np.int64]] | None:
    """Return points (m, 3) m and triangles (k, 3) of ``/fem/mesh``; None where it is deleted.

    The message has three corners for each triangle. Those that are equal are one point, which its triangles share:
    a surface whose corners are all alone has no neighbours, and no smooth normals.
    """
    if message.action != Marker.ADD or not message.points:
        return None
    corners = np.array([(p.x, p.y, p.z) for p in message.points])
    points, rows = np.unique(corners, axis=0, return_inverse=True)
    return points, np.asarray(rows, np.int64).reshape(-1, 3)


def _paint(message: Marker, colour: tuple[float, float, float, float]) -> None:
    message.color.r, message.color.g, message.color.b, message.color.a = colour


# --- diagnostics -----------------------------------------------------------------------------------------------------

LEVELS = {"OK": DiagnosticStatus.OK, "WARN": DiagnosticStatus.WARN, "ERROR": DiagnosticStatus.ERROR}
LEVELS["STALE"] = DiagnosticStatus.STALE


def to_diagnostics(stamp_ns: int, name: str, level: str, message: str, values: Mapping[str, object]) -> DiagnosticArray:
    """Return one status with key-value pairs; ``level`` OK, WARN, ERROR or STALE.

    Floats are written with all their digits.
    """
    status = DiagnosticStatus(level=LEVELS[level], name=name, message=message, hardware_id="livedeform")
    status.values = [KeyValue(key=k, value=repr(v) if isinstance(v, float) else str(v)) for k, v in values.items()]
    return DiagnosticArray(header=to_header(stamp_ns), status=[status])
