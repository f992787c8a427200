"""Experiments and recordings on disk, without ROS."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray
from PIL import Image as Picture

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage, encode, message_class
from livedeform.common.bags.write import BagWriter
from livedeform.common.frames import matrix_pose
from livedeform.common.types import Array, CameraCalibration, MarkerFrame
from livedeform.stereo_node.camera.calibration_file import write_camera
from livedeform.stereo_node.camera.rig import make_rig
from livedeform.synthetic.rig import Rig

NS = 1_000_000_000


def _header(stamp_ns: int, frame: str) -> Any:
    time = message_class("builtin_interfaces/msg/Time")(sec=stamp_ns // NS, nanosec=stamp_ns % NS)
    return message_class("std_msgs/msg/Header")(stamp=time, frame_id=frame)


class ScenarioWriter:
    """Writes one recording; every method takes the header's stamp (the bag's receive time is the same)."""

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self._bag = BagWriter(path, metadata, compression="zstd")

    def __enter__(self) -> ScenarioWriter:
        self._bag.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._bag.__exit__(*error)

    def _write(self, topic: str, stamp_ns: int, message: Any) -> None:
        self._bag.write(topic, message.__msgtype__, stamp_ns, encode(message))

    def copy(self, raw: RawMessage) -> None:
        """A message of another recording, as it is."""
        self._bag.write(raw.topic, raw.type, raw.log_time_ns, raw.data, raw.definition)

    def registration(self, stamp_ns: int, T_phantom_left: Array) -> None:
        """Write where the tracker stands, on ``/tf_static``."""
        pose = matrix_pose(T_phantom_left, stamp_ns)
        RecordingWriter(self._bag).static_transforms({(t.FRAME_PHANTOM, t.FRAME_LEFT): pose}, stamp_ns)

    def pose(self, stamp_ns: int, T: Array) -> None:
        pose = matrix_pose(T, stamp_ns)
        message = message_class("geometry_msgs/msg/Pose")(
            position=message_class("geometry_msgs/msg/Point")(*map(float, pose.position)),
            orientation=message_class("geometry_msgs/msg/Quaternion")(*map(float, pose.orientation_xyzw)),
        )
        header = _header(stamp_ns, t.FRAME_PHANTOM)
        self._write(t.PROBE_POSE, stamp_ns, message_class("geometry_msgs/msg/PoseStamped")(header=header, pose=message))

    def wrench(self, stamp_ns: int, force: Array, torque: Array) -> None:
        vector = message_class("geometry_msgs/msg/Vector3")
        wrench = message_class("geometry_msgs/msg/Wrench")(
            force=vector(*map(float, force)), torque=vector(*map(float, torque))
        )
        header = _header(stamp_ns, t.FRAME_PHANTOM)
        message = message_class("geometry_msgs/msg/WrenchStamped")(header=header, wrench=wrench)
        self._write(t.PROBE_WRENCH, stamp_ns, message)

    def markers(self, frame: MarkerFrame) -> None:
        rows = layouts.pack_marker_frame(frame)
        field = message_class("sensor_msgs/msg/PointField")
        message = message_class("sensor_msgs/msg/PointCloud2")(
            header=_header(frame.stamp_ns, t.FRAME_PHANTOM),
            height=1,
            width=len(rows),
            fields=[
                field(name=r.name, offset=r.offset, datatype=r.datatype, count=1)
                for r in layouts.field_rows(rows.dtype)
            ],
            is_bigendian=False,
            point_step=rows.dtype.itemsize,
            row_step=rows.dtype.itemsize * len(rows),
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=True,
        )
        self._write(t.STEREO_MARKERS, frame.stamp_ns, message)

    def picture(self, side: str, stamp_ns: int, pixels: NDArray[np.uint8]) -> None:
        """PNG on ``.../compressed``."""
        buffer = io.BytesIO()
        Picture.fromarray(pixels).save(buffer, format="PNG", optimize=True)
        left = side == "left"
        message = message_class("sensor_msgs/msg/CompressedImage")(
            header=_header(stamp_ns, t.FRAME_LEFT if left else t.FRAME_RIGHT),
            format="mono8; png compressed mono8",
            data=np.frombuffer(buffer.getvalue(), np.uint8),
        )
        self._write(t.LEFT_COMPRESSED if left else t.RIGHT_COMPRESSED, stamp_ns, message)


def write_rig(folder: Path, rig: Rig) -> None:
    """left.yaml and right.yaml as ROS' camera_calibration writes them."""

    def one(name: str, camera: Any) -> tuple[str, int, int, Array, Array, str]:
        matrix = np.array([[camera.f, 0, camera.centre[0]], [0, camera.f, camera.centre[1]], [0, 0, 1.0]])
        return name, *camera.size, matrix, np.array([camera.k[0], camera.k[1], 0.0, 0.0, 0.0]), "plumb_bob"

    pair = make_rig(one("stereo_left", rig.left), one("stereo_right", rig.right), rig.T_right_left)
    sides: dict[str, CameraCalibration] = {"left": pair.left, "right": pair.right}
    for name, camera in sides.items():
        write_camera(camera, folder / f"{name}.yaml")


def write_surface(path: Path, points: Array, triangles: NDArray[np.int64]) -> None:
    """Binary STL, metres."""
    path.write_bytes(trimesh.exchange.stl.export_stl(trimesh.Trimesh(points, triangles, process=False)))


def write_yaml(path: Path, document: Mapping[str, Any]) -> None:
    path.write_text(yaml.safe_dump(dict(document), sort_keys=False, default_flow_style=None, width=110))
