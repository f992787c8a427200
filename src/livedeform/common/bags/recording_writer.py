"""Writing our types to a bag as ROS messages, without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.pictures import encode_picture
from livedeform.common.bags.types import encode, message_class
from livedeform.common.types import Array, CameraCalibration, Image, MarkerFrame, Pose, Wrench

__all__ = ["RecordingWriter"]

NS = 1_000_000_000


class Bag(Protocol):
    """The taker of serialised messages: a `BagWriter`."""

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        """Take one message."""


class RecordingWriter:
    """Writes our types to a bag without ROS; receive times equal the stamps."""

    def __init__(self, bag: Bag) -> None:
        self.bag = bag

    def _write(self, topic: str, message: Any, stamp_ns: int) -> None:
        self.bag.write(topic, message.__msgtype__, stamp_ns, encode(message))

    def marker_frame(self, frame: MarkerFrame, frame_id: str = t.FRAME_PHANTOM, topic: str = t.STEREO_MARKERS) -> None:
        self._cloud(topic, frame.stamp_ns, layouts.pack_marker_frame(frame), frame_id)

    def surface_points(self, stamp_ns: int, points: Array, covariances: Array | None = None) -> None:
        """Write points (n, 3) m of the body's surface, of which nobody knows which is which, to ``/stereo/surface``."""
        self._cloud(t.STEREO_SURFACE, stamp_ns, layouts.pack_surface_points(points, covariances), t.FRAME_PHANTOM)

    def _cloud(self, topic: str, stamp_ns: int, rows: NDArray[Any], frame_id: str) -> None:
        field_class = message_class("sensor_msgs/msg/PointField")
        cloud = message_class("sensor_msgs/msg/PointCloud2")(
            header=_header(stamp_ns, frame_id),
            height=1,
            width=len(rows),
            fields=[field_class(row.name, row.offset, row.datatype, 1) for row in layouts.field_rows(rows.dtype)],
            is_bigendian=False,
            point_step=rows.dtype.itemsize,
            row_step=rows.nbytes,
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=bool(np.isfinite(rows["x"]).all()),
        )
        self._write(topic, cloud, stamp_ns)

    def pose(self, pose: Pose, topic: str = t.PROBE_POSE) -> None:
        kind = message_class("geometry_msgs/msg/PoseStamped")
        body = message_class("geometry_msgs/msg/Pose")(
            position=message_class("geometry_msgs/msg/Point")(*map(float, pose.position)),
            orientation=message_class("geometry_msgs/msg/Quaternion")(*map(float, pose.orientation_xyzw)),
        )
        self._write(topic, kind(_header(pose.stamp_ns, t.FRAME_PHANTOM), body), pose.stamp_ns)

    def wrench(self, wrench: Wrench, topic: str = t.PROBE_WRENCH) -> None:
        vector = message_class("geometry_msgs/msg/Vector3")
        body = message_class("geometry_msgs/msg/Wrench")(
            force=vector(*map(float, wrench.force)), torque=vector(*map(float, wrench.torque))
        )
        kind = message_class("geometry_msgs/msg/WrenchStamped")
        self._write(topic, kind(_header(wrench.stamp_ns, t.FRAME_PHANTOM), body), wrench.stamp_ns)

    def image(self, image: Image, topic: str) -> None:
        pixels = np.ascontiguousarray(image.pixels)
        message = message_class("sensor_msgs/msg/Image")(
            header=_header(image.stamp_ns, image.frame_id),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=image.encoding,
            is_bigendian=0,
            step=pixels.strides[0],
            data=pixels.reshape(-1).view(np.uint8),
        )
        self._write(topic, message, image.stamp_ns)

    def compressed_image(self, image: Image, topic: str, kind: str = "png", quality: int = 90) -> None:
        """Write a compressed picture to ``<topic>/compressed``, ``topic`` being the raw topic's name."""
        message = message_class("sensor_msgs/msg/CompressedImage")(
            header=_header(image.stamp_ns, image.frame_id),
            format=kind,
            data=np.frombuffer(encode_picture(image, kind, quality), np.uint8),
        )
        self._write(topic + "/compressed", message, image.stamp_ns)

    def camera_info(self, camera: CameraCalibration, stamp_ns: int, topic: str, frame_id: str) -> None:
        region = message_class("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        message = message_class("sensor_msgs/msg/CameraInfo")(
            header=_header(stamp_ns, frame_id),
            height=int(camera.height),
            width=int(camera.width),
            distortion_model=camera.distortion_model,
            d=np.ravel(camera.dist_coeffs).astype(float),
            k=np.ravel(camera.camera_matrix).astype(float),
            r=np.ravel(camera.rectification).astype(float),
            p=np.ravel(camera.projection).astype(float),
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        self._write(topic, message, stamp_ns)

    def static_transforms(self, transforms: Mapping[tuple[str, str], Pose], stamp_ns: int) -> None:
        """Write ``/tf_static``: T_parent_child by (parent, child)."""
        self.transforms(transforms, stamp_ns, t.TF_STATIC)

    def transforms(self, transforms: Mapping[tuple[str, str], Pose], stamp_ns: int, topic: str = t.TF) -> None:
        """Write ``/tf`` or ``/tf_static``: T_parent_child by (parent, child)."""
        entries = []
        for (parent, child), pose in transforms.items():
            entries.append(
                message_class("geometry_msgs/msg/TransformStamped")(
                    header=_header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=message_class("geometry_msgs/msg/Transform")(
                        translation=message_class("geometry_msgs/msg/Vector3")(*map(float, pose.position)),
                        rotation=message_class("geometry_msgs/msg/Quaternion")(*map(float, pose.orientation_xyzw)),
                    ),
                )
            )
        self._write(topic, message_class(t.TRANSFORMS)(entries), stamp_ns)


def _header(stamp_ns: int, frame_id: str) -> Any:
    time = message_class("builtin_interfaces/msg/Time")(sec=int(stamp_ns) // NS, nanosec=int(stamp_ns) % NS)
    return message_class("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)
