"""The other side of the nodes' topics: what cameras and robots publish, and what viewers read from our messages."""

from __future__ import annotations

from array import array

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.pictures import encode_picture
from livedeform.common.ros import messages
from livedeform.common.types import Array, CameraCalibration, Ids, Image, Pose, Wrench


def to_pose_stamped(pose: Pose, frame_id: str = t.FRAME_PHANTOM) -> PoseStamped:
    message = PoseStamped(header=messages.to_header(pose.stamp_ns, frame_id))
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = (float(v) for v in pose.position)
    orientation.x, orientation.y, orientation.z, orientation.w = (float(v) for v in pose.orientation_xyzw)
    return message


def from_wrench(message: WrenchStamped) -> Wrench:
    f, m = message.wrench.force, message.wrench.torque
    return Wrench(messages.from_time(message.header.stamp), np.array([f.x, f.y, f.z]), np.array([m.x, m.y, m.z]))


def to_compressed_image(image: Image, kind: str = "png") -> CompressedImage:
    message = CompressedImage(header=messages.to_header(image.stamp_ns, image.frame_id), format=kind)
    message.data = array("B", encode_picture(image, kind))
    return message


def to_camera_info(camera: CameraCalibration, stamp_ns: int, frame_id: str) -> CameraInfo:
    message = CameraInfo(header=messages.to_header(stamp_ns, frame_id))
    message.height, message.width = int(camera.height), int(camera.width)
    message.distortion_model = camera.distortion_model
    message.d = [float(v) for v in np.ravel(camera.dist_coeffs)]
    message.k = np.ravel(camera.camera_matrix).astype(float)
    message.r = np.ravel(camera.rectification).astype(float)
    message.p = np.ravel(camera.projection).astype(float)
    return message


def from_predicted_surface(message: PointCloud2) -> tuple[int, Ids, Array]:
    """Return stamp (ns), node numbers (m,) and points (m, 3) m of ``/fem/surface``."""
    rows = layouts.unpack(message)
    return messages.from_time(message.header.stamp), rows["node"].astype(np.uint32), layouts.points(rows)


def from_compare_cloud(message: PointCloud2) -> tuple[int, Ids, Array, Array]:
    """Return stamp (ns), ids (n,), measured (n, 3) m and error (n, 3) m of ``/compare/markers``."""
    rows = layouts.unpack(message)
    error = np.stack([rows[name].astype(float) for name in ("ex", "ey", "ez")], axis=1)
    return messages.from_time(message.header.stamp), rows["id"].astype(np.uint32), layouts.points(rows), error


def from_lesions(message: MarkerArray) -> tuple[list[str], Array, Array]:
    """Return names, centres (l, 3) m (NaN where deleted) and diameters (l,) m of ``/fem/lesions``."""
    centres = [
        (m.pose.position.x, m.pose.position.y, m.pose.position.z) if m.action == Marker.ADD else (np.nan,) * 3
        for m in message.markers
    ]
    diameters = np.array([m.scale.x for m in message.markers], float)
    return [m.ns for m in message.markers], np.array(centres, float).reshape(-1, 3), diameters


def from_diagnostics(message: DiagnosticArray) -> tuple[int, str, str, dict[str, str]]:
    """Return stamp (ns), level, message and values of the first status."""
    status = message.status[0]
    names = {number: name for name, number in messages.LEVELS.items()}
    return (
        messages.from_time(message.header.stamp),
        names[status.level],
        status.message,
        {v.key: v.value for v in status.values},
    )
