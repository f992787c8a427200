"""Make what viewers need besides the results: transforms, the probe, error arrows, the prediction on the pictures.

Derived from the messages that pass by, without ROS: a recorder writes them beside the rest, and a live session
publishes them, too. All markers are in the frame ``phantom``, so that they show without transforms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags import layouts, pictures
from livedeform.common.bags.recording import header_stamp_ns
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import RawMessage, decode, encode, message_class
from livedeform.common.errors import CalibrationError, InputError, RecordingError
from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Experiment, Probe
from livedeform.common.frames import apply, inverse, pose_matrix, unit_pose
from livedeform.common.types import Array, CameraCalibration, Pose
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.setup import declared_camera_pose, rig_of

Derived = tuple[str, str, bytes]
"""A message that was derived: topic, type, bytes (CDR)."""

NS = 1_000_000_000
PERIOD_NS = NS // 10  # between two drawings of the same thing: viewers need no more, and a session has other work
LONGER = 10.0  # times: errors of a tenth of a millimetre would not show on a body of a decimetre
SHAFT, HEAD = 0.0006, 0.0015  # m, diameters of an arrow
SPOT = 5.0  # px, of a predicted marker on a picture
SMALL, LARGE = np.array([0.0, 0.45, 0.70]), np.array([0.84, 0.37, 0.0])  # colours of no error, and of the threshold
PROBE_COLOUR = (0.34, 0.71, 0.91, 0.6)
ARROW, CUBE, SPHERE, CYLINDER, TRIANGLES, DELETE_ALL = 0, 1, 2, 3, 11, 3  # visualization_msgs/Marker
SPOTS = 4  # visualization_msgs/ImageMarker: points
STATUS = (t.STEREO_STATUS, t.FEM_STATUS, t.COMPARE_METRICS)
SIDES = {
    "left": (t.LEFT_IMAGE, t.LEFT_COMPRESSED, t.LEFT_CAMERA_INFO, t.FRAME_LEFT, t.SCENE_LEFT),
    "right": (t.RIGHT_IMAGE, t.RIGHT_COMPRESSED, t.RIGHT_CAMERA_INFO, t.FRAME_RIGHT, t.SCENE_RIGHT),
}


class LiveScene:
    """Derives the viewers' messages of one session; what cannot be read gives none."""

    def __init__(self, experiment: Experiment) -> None:
        self._threshold = experiment.thresholds.error
        self._probe = experiment.probe
        self._solid: tuple[Array, Any] | None = None  # of a probe that is a mesh
        self._rig = _declared_rig(experiment)
        self._pose: Pose | None = declared_camera_pose(experiment)
        self._cameras: dict[str, CameraCalibration] = {}
        self._said: set[str] = set()  # camera infos that were recorded or derived
        self._drawn: dict[str, int] = {}  # stamp of the last drawing by topic
        self._handlers: dict[str, Callable[[RawMessage], Iterator[Derived]]] = {
            t.PROBE_POSE: self._of_pose,
            t.COMPARE_MARKERS: self._of_errors,
            t.STEREO_REGISTRATION: self._of_registration,
            **dict.fromkeys(STATUS, self._of_status),
            **dict.fromkeys(t.CAMERA_INFOS, self._of_camera),
            **dict.fromkeys((*t.IMAGES, *t.COMPRESSED_IMAGES), self._of_picture),
        }

    def derive(self, topic: str, type_name: str, data: bytes) -> list[Derived]:
        """The messages that go with one that passed by."""
        handler = self._handlers.get(topic)
        if handler is None:
            return []
        try:
            return list(handler(RawMessage(topic, type_name, 0, data)))
        except (RecordingError, CalibrationError):  # a damaged message is counted where it is used
            return []

    def _due(self, topic: str, stamp_ns: int) -> bool:
        """Tell whether something is to be drawn again; also where the time went back."""
        last = self._drawn.get(topic)
        due = last is None or abs(stamp_ns - last) >= PERIOD_NS
        if due:
            self._drawn[topic] = stamp_ns
        return due

    def _of_pose(self, raw: RawMessage) -> Iterator[Derived]:
        """``/tf`` with every pose, and from time to time the probe as a marker."""
        message = decode(raw)
        p, q = message.pose.position, message.pose.orientation
        pose = unit_pose(header_stamp_ns(raw) or 0, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        yield from written(lambda w: w.transforms({(t.FRAME_PHANTOM, t.FRAME_PROBE): pose}, pose.stamp_ns, t.TF))
        if self._probe is not None and self._due(t.SCENE_PROBE, pose.stamp_ns):
            yield t.SCENE_PROBE, t.MARKER, encode(self._probe_marker(self._probe, pose))

    def _probe_marker(self, probe: Probe, pose: Pose) -> Any:
        """The probe as a primitive, or as triangles where it is a mesh; a primitive's middle lies behind the face."""
        kind, size, depth = _primitive(probe)
        middle = apply(pose_matrix(pose), np.array([[0.0, 0.0, -depth / 2.0]]))[0]
        points: list[Any] = []
        if kind == TRIANGLES:
            self._solid = self._solid or probe_mesh(probe)
            vertices, triangles = self._solid
            points = [_point(v) for v in vertices[triangles.ravel()]]
        return _marker(
            pose.stamp_ns, "probe", 0, kind, position=middle, orientation=pose.orientation_xyzw, scale=size,
            colour=PROBE_COLOUR, points=points,
        )  # fmt: skip

    def _of_errors(self, raw: RawMessage) -> Iterator[Derived]:
        """Arrows from predicted to measured markers, and the predicted ones on the pictures."""
        stamp_ns = header_stamp_ns(raw) or 0
        if not self._due(t.SCENE_ERRORS, stamp_ns):
            return
        rows = layouts.unpack(decode(raw))
        measured, errors = layouts.points(rows), layouts.vectors(rows, ("ex", "ey", "ez"))
        predicted = measured - errors
        arrows = [_marker(stamp_ns, "error", 0, ARROW, action=DELETE_ALL)]
        for marker_id, start, error in zip(layouts.ids(rows), predicted, errors, strict=True):
            arrows.append(self._arrow(stamp_ns, int(marker_id), start, error))
        yield t.SCENE_ERRORS, t.MARKER_ARRAY, encode(message_class(t.MARKER_ARRAY)(arrows))
        if self._rig is None or self._pose is None:
            return
        pixels = self._rig.project(apply(inverse(pose_matrix(self._pose)), predicted))[:2]
        for (_, _, _, frame, topic), px in zip(SIDES.values(), pixels, strict=True):
            yield topic, t.IMAGE_MARKER, encode(_spots(stamp_ns, frame, px))

    def _arrow(self, stamp_ns: int, marker_id: int, start: Array, error: Array) -> Any:
        share = min(1.0, float(np.linalg.norm(error)) / self._threshold)
        colour = (*((1.0 - share) * SMALL + share * LARGE), 1.0)
        tip = start + LONGER * error
        return _marker(
            stamp_ns, "error", marker_id, ARROW, scale=(SHAFT, HEAD, HEAD), colour=colour,
            points=[_point(start), _point(tip)],
        )  # fmt: skip

    def _of_registration(self, raw: RawMessage) -> Iterator[Derived]:
        """``/tf_static`` of the cameras; what stands in ``phantom`` is the left one."""
        message = decode(raw)
        yield t.TF_STATIC, t.TRANSFORMS, encode(message_class(t.TRANSFORMS)([message]))
        if message.header.frame_id == t.FRAME_PHANTOM and message.child_frame_id == t.FRAME_LEFT:
            p, q = message.transform.translation, message.transform.rotation
            self._pose = unit_pose(0, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

    def _of_status(self, raw: RawMessage) -> Iterator[Derived]:
        """The nodes' own status where ROS's tools look for it."""
        yield t.DIAGNOSTICS_ALL, t.DIAGNOSTICS, bytes(raw.data)

    def _of_camera(self, raw: RawMessage) -> Iterator[Derived]:
        """Keep the recorded calibrations, where the experiment has none."""
        self._said.add(raw.topic)
        side = "left" if raw.topic == t.LEFT_CAMERA_INFO else "right"
        if self._rig is None and side not in self._cameras:
            self._cameras[side] = pictures.read_camera_info(decode(raw), side)
            if len(self._cameras) == 2:
                self._rig = StereoRig(self._cameras["left"], self._cameras["right"])
        return iter(())

    def _of_picture(self, raw: RawMessage) -> Iterator[Derived]:
        """The declared calibration with the first picture of a camera that sends none itself."""
        side = next(s for s, names in SIDES.items() if raw.topic in names)
        _, _, topic, frame, _ = SIDES[side]
        if topic in self._said or self._rig is None:
            return
        self._said.add(topic)
        camera = self._rig.left if side == "left" else self._rig.right
        stamp_ns = header_stamp_ns(raw) or 0
        yield from written(lambda w: w.camera_info(camera, stamp_ns, topic, frame))


def _declared_rig(experiment: Experiment) -> StereoRig | None:
    """The experiment's cameras; None where there are none, or none that can be used: nothing is drawn on pictures."""
    try:
        return rig_of(experiment)
    except InputError:  # whoever needs the cameras says what is wrong with them
        return None


class _Sink:
    """Takes what a `RecordingWriter` writes."""

    def __init__(self) -> None:
        self.messages: list[Derived] = []

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self.messages.append((topic, type_name, data))


def written(write: Callable[[RecordingWriter], None]) -> list[Derived]:
    """Return the messages that ``write`` makes."""
    sink = _Sink()
    write(RecordingWriter(sink))
    return sink.messages


def _primitive(probe: Probe) -> tuple[int, tuple[float, float, float], float]:
    """The kind of marker, its size (3,) m along its own axes, and how far it reaches behind the contact face (m)."""
    shape = probe.shape
    if shape.sphere is not None:
        size = 2.0 * shape.sphere
        return SPHERE, (size, size, size), size
    if shape.cylinder is not None:
        radius, height = shape.cylinder
        return CYLINDER, (2.0 * radius, 2.0 * radius, height), height
    if shape.box is not None:
        return CUBE, shape.box, shape.box[2]
    return TRIANGLES, (1.0, 1.0, 1.0), 0.0


def _marker(
    stamp_ns: int,
    namespace: str,
    number: int,
    kind: int,
    *,
    action: int = 0,
    position: Sequence[float] | Array = (0.0, 0.0, 0.0),
    orientation: Sequence[float] | Array = (0.0, 0.0, 0.0, 1.0),
    scale: Sequence[float] = (1.0, 1.0, 1.0),
    colour: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    points: Sequence[Any] = (),
) -> Any:
    """A visualization_msgs/Marker in the frame ``phantom``."""
    cls = message_class
    nothing = cls("sensor_msgs/msg/CompressedImage")(_header(0, ""), "", np.zeros(0, np.uint8))
    return cls(t.MARKER)(
        header=_header(stamp_ns, t.FRAME_PHANTOM),
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=cls("geometry_msgs/msg/Pose")(
            _point(position), cls("geometry_msgs/msg/Quaternion")(*map(float, orientation))
        ),
        scale=cls("geometry_msgs/msg/Vector3")(*map(float, scale)),
        color=_colour(colour),
        lifetime=cls("builtin_interfaces/msg/Duration")(0, 0),
        frame_locked=False,
        points=list(points),
        colors=[],
        texture_resource="",
        texture=nothing,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=cls("visualization_msgs/msg/MeshFile")("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _spots(stamp_ns: int, frame: str, px: Array) -> Any:
    """Points (n, 2) px on a camera's picture."""
    known = px[np.isfinite(px).all(axis=1)]
    return message_class(t.IMAGE_MARKER)(
        header=_header(stamp_ns, frame),
        ns="predicted",
        id=0,
        type=SPOTS,
        action=0,
        position=_point((0.0, 0.0, 0.0)),
        scale=SPOT,
        outline_color=_colour((*SMALL, 1.0)),
        filled=0,
        fill_color=_colour((0.0, 0.0, 0.0, 0.0)),
        lifetime=message_class("builtin_interfaces/msg/Duration")(0, 0),
        points=[_point((x, y, 0.0)) for x, y in known],
        outline_colors=[],
    )


def _header(stamp_ns: int, frame_id: str) -> Any:
    time = message_class("builtin_interfaces/msg/Time")(sec=int(stamp_ns) // NS, nanosec=int(stamp_ns) % NS)
    return message_class("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)


def _point(p: Sequence[float] | Array) -> Any:
    return message_class("geometry_msgs/msg/Point")(float(p[0]), float(p[1]), float(p[2]))


def _colour(rgba: Sequence[float]) -> Any:
    return message_class("std_msgs/msg/ColorRGBA")(*map(float, rgba))
