"""A recording as numpy arrays, without ROS: what the closed loop, the report and the command line read and write.

Time is ``header.stamp`` throughout; the bag's receive times only order what is read.
"""

from __future__ import annotations

import contextlib
import gc
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from livedeform.common import topics as t
from livedeform.common.bags import alike, layouts, pictures
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import NO_ROTATION, odd_norms, unit_pose, unit_poses
from livedeform.common.stamps import bad_stamps, in_stretches, long_pauses, read_stamp, times_set_back
from livedeform.common.types import Array, CameraCalibration, Ids, Image, MarkerFrame, Pose, PredictedMarkers, Wrench

__all__ = ["ErrorFrame", "Recording", "load_poses", "load_recording", "read_images"]

NS = 1_000_000_000
BEGINS = "begins_ns"  # in the metadata of a run: when the recording began that was run
PICTURES = (*t.IMAGES, *t.COMPRESSED_IMAGES)
MEASURED_TOPICS = (t.STEREO_MARKERS, t.STEREO_SURFACE, t.PROBE_POSE, t.PROBE_WRENCH, *PICTURES)
FEW = 32  # pictures of each camera, spread over the recording, by whose arrival a clock is told
SAME_PLACE, SAME_TURN = 1e-4, 1e-3  # m and rad: transforms further apart than that are two
Stamps = list[tuple[int, int]]  # of one topic: header.stamp and receive time of each message, ns
HEADED_TYPES = frozenset(
    {t.IMAGE, t.COMPRESSED_IMAGE, t.CAMERA_INFO, t.POINT_CLOUD, t.POSE_STAMPED, t.WRENCH_STAMPED, t.DIAGNOSTICS}
)


@dataclass(frozen=True)
class ErrorFrame:
    """``/compare/markers`` of one moment: ``measured`` and ``errors`` = measured - predicted, (n, 3) m."""

    stamp_ns: int
    ids: Ids
    measured: Array
    errors: Array


@dataclass(frozen=True)
class Repeats:
    """Messages of a topic whose stamp was there already: so many were ``left_out``, and so many ``joined``."""

    left_out: int = 0
    joined: int = 0

    @property
    def n(self) -> int:
        return self.left_out + self.joined


@dataclass(frozen=True)
class Recording:
    """The content of a bag, in the order of the stamps; two messages of one topic with the same stamp count once.
    Clouds of one stamp that share no marker are one frame.

    ``camera_infos`` by "left" and "right"; ``static_transforms`` by (parent, child): T_parent_child.
    ``uncorrected_marker_frames`` are a run's markers before a measuring effect was corrected (empty if none was).
    ``warnings`` has one line per thing that was left out or looks odd, ``faults`` counts the same by name
    (`common.checks.recorded.FAULTS`). ``unknown_ids`` are of markers that the experiment does not have;
    ``picture_stamps_ns`` of these left pictures. ``repeats`` counts by topic the messages whose stamp was
    there already: how many were ``left_out``, and how many ``joined``; ``other_frames`` by topic the frame that it
    says, where that is not the phantom's; ``arrivals`` by topic of what was measured good stamps and when
    these messages came (of each camera's pictures a few, spread evenly, and those of the last second).
    ``doubts`` say why what a diagnosis concludes from it may be wrong, where that was looked at (`load_checked`).
    """

    path: Path
    start_ns: int
    end_ns: int
    marker_frames: list[MarkerFrame]
    poses: list[Pose]
    wrenches: list[Wrench]
    camera_infos: Mapping[str, CameraCalibration]
    static_transforms: Mapping[tuple[str, str], Pose]
    uncorrected_marker_frames: list[MarkerFrame] = field(default_factory=list)
    predictions: list[PredictedMarkers] = field(default_factory=list)
    predicted_wrenches: list[Wrench] = field(default_factory=list)
    errors: list[ErrorFrame] = field(default_factory=list)
    metadata: Mapping[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    faults: Mapping[str, int] = field(default_factory=dict)
    unknown_ids: tuple[int, ...] = ()
    picture_stamps_ns: tuple[int, ...] = ()
    repeats: Mapping[str, Repeats] = field(default_factory=dict)
    other_frames: Mapping[str, str] = field(default_factory=dict)
    arrivals: Mapping[str, Stamps] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)

    @property
    def measured_frames(self) -> list[MarkerFrame]:
        """Return the measured frames, as they were before any correction."""
        return self.uncorrected_marker_frames or self.marker_frames

    @property
    def own_name(self) -> str:
        """Return its name by which the experiment declares what acts in it (`recording_name`); a run's is that of the
        recording that was run."""
        return own_name(self.path, self.metadata)

    @property
    def camera_pose(self) -> Pose | None:
        """T_phantom_left as ``/tf_static`` has it; None where nobody recorded it."""
        return self.static_transforms.get((t.FRAME_PHANTOM, t.FRAME_LEFT))

    @property
    def left(self) -> Iterator[Image]:
        """The left pictures, read from the bag one after the other."""
        return read_images(self.path, t.LEFT_IMAGE)

    @property
    def right(self) -> Iterator[Image]:
        """The right pictures, read from the bag one after the other."""
        return read_images(self.path, t.RIGHT_IMAGE)


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Do not look for cycles among objects while many are made: there are none, and a third of the time goes there."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


@_uncollected()
def load_recording(path: Path | str, experiment: Experiment | None = None) -> Recording:
    """Load everything but the pictures. With an ``experiment``, unknown markers are left out with a warning."""
    with read_bag(path) as bag:
        collector = _Collector(bag.warnings)
        for raw in bag.messages([name for name in t.LOADED if name in bag.topics]):
            collector.take(raw)
        collector.finish()
        stamps = collector.stamps | stamps_besides(bag)
        start_ns, end_ns = stamp_range(bag, stamps)
        metadata = dict(bag.metadata)
        collector.given = not any(name in bag.topics for name in PICTURES)
        arrivals = arrivals_of(bag, stamps)
        pictures = tuple(stamp for stamp, _ in arrivals.get(picture_topic(bag, t.LEFT_IMAGE) or "", ()))
    known = None if experiment is None else experiment.markers.ids
    marker_frames = [_keep(f, known, collector) for f in collector.sorted(t.STEREO_MARKERS)]
    uncorrected = [_keep(f, known, collector) for f in collector.sorted(t.STEREO_MARKERS_RAW)]
    return Recording(
        path=Path(path),
        start_ns=start_ns,
        end_ns=end_ns,
        marker_frames=marker_frames,
        uncorrected_marker_frames=uncorrected,
        poses=collector.sorted(t.PROBE_POSE),
        wrenches=collector.sorted(t.PROBE_WRENCH),
        camera_infos=collector.cameras,
        static_transforms=collector.transforms,
        predictions=collector.sorted(t.FEM_MARKERS),
        predicted_wrenches=collector.sorted(t.FEM_WRENCH),
        errors=collector.sorted(t.COMPARE_MARKERS),
        metadata=metadata,
        warnings=[*bag.warnings, *collector.report()],
        faults=dict(collector.faults),
        unknown_ids=tuple(sorted(collector.unknown)),
        picture_stamps_ns=pictures,
        repeats=collector.repeats,
        other_frames=collector.other_frames,
        arrivals=arrivals,
    )


def own_name(path: Path, metadata: Mapping[str, str]) -> str:
    """Return the name by which the experiment declares what acts in the recording at ``path`` with these ``metadata``:
    its own, or that of the recording of which a run made it."""
    options: Any = None
    if metadata.get("command") == "run":
        with contextlib.suppress(yaml.YAMLError):  # written by somebody else
            options = yaml.safe_load(metadata.get("options", ""))
    bag = options.get("bag") if isinstance(options, dict) else None
    return recording_name(Path(str(bag)) if bag else path)


def recording_name(path: Path) -> str:
    """Return what a recording is called: its file's name without .mcap, or its folder's."""
    return path.stem if path.suffix == ".mcap" else path.name


def load_poses(path: Path | str) -> list[Pose]:
    """Load the probe's poses alone, which is faster."""
    with read_bag(path) as bag:
        collector = _Collector(bag.warnings)
        for raw in bag.messages([t.PROBE_POSE] if t.PROBE_POSE in bag.topics else []):
            collector.take(raw)
        collector.finish()
    return collector.sorted(t.PROBE_POSE)


def stamp_range(bag: BagReader, known: Mapping[str, Stamps] | None = None) -> tuple[int, int]:
    """Return the first and the last ``header.stamp`` of what was measured, ns: the start from which a timeline counts.

    (0, 0) if nothing with a header was measured. The stamps of the topics in ``known`` are not read again. A run from
    the middle on (`BEGINS`) counts from where the recording began that was run.
    """
    stamps: list[int] = []
    for name in MEASURED_TOPICS:
        if name in bag.topics:
            stamps += good_stamps((known or {}).get(name) or header_stamps(ends(bag, name)))
    begins = bag.metadata.get(BEGINS, "")
    if stamps and begins.isdecimal():
        stamps.append(min(int(begins), *stamps))
    return (min(stamps), max(stamps)) if stamps else (0, 0)


def header_stamps(messages: Iterable[RawMessage]) -> Stamps:
    """Return the header stamps of messages, each with the receive time."""
    return [(stamp, raw.log_time_ns) for raw in messages if (stamp := header_stamp_ns(raw)) is not None]


def good_stamps(known: Stamps) -> list[int]:
    """Return one topic's header stamps without those that cannot be right (`bad_stamps`)."""
    return [stamp for stamp, _ in good_messages(known)]


def good_messages(known: Stamps) -> Stamps:
    """Return one topic's header stamps with the receive times, without those that cannot be right."""
    bad = bad_stamps([k[0] for k in known], [k[1] for k in known])
    return [pair for pair, wrong in zip(known, bad, strict=True) if not wrong]


def arrivals_of(bag: BagReader, known: Mapping[str, Stamps]) -> dict[str, Stamps]:
    """Return by topic the good stamps of what was measured, of those that are ``known``, and when these messages came.
    Markers and surfaces that are found in pictures came as late as that took, and tell nothing of a clock."""
    filmed = any(name in bag.topics for name in PICTURES)
    names = [name for name in (*PICTURES, *clocked(filmed)) if name in known]
    return {name: each for name in names if (each := good_messages(known[name]))}


def clocked(filmed: bool) -> tuple[str, ...]:
    """Return the topics, beside pictures, whose messages come as soon as they are stamped: markers and surfaces, unless
    they are found in what was ``filmed``."""
    robot = (t.PROBE_POSE, t.PROBE_WRENCH)
    return robot if filmed else (*robot, t.STEREO_MARKERS, t.STEREO_SURFACE)


def stamps_besides(bag: BagReader) -> dict[str, Stamps]:
    """Return by topic the stamps of what was measured and is not loaded: of surfaces, and of some of the pictures of
    each camera (`spread`)."""
    surfaces = {t.STEREO_SURFACE} & bag.topics.keys()
    cameras = {name for topic in t.IMAGES if (name := picture_topic(bag, topic)) is not None}
    return {name: header_stamps(bag.messages([name])) for name in surfaces} | {
        name: header_stamps(spread(bag, name)) for name in cameras
    }


def spread(bag: BagReader, topic: str) -> Iterator[RawMessage]:
    """Return some messages of a topic: the first, `FEW` that are spread evenly over the bag, and those of the last
    second; all where the file cannot be read but from its beginning on."""
    if not bag.seeks:
        yield from bag.messages([topic])
        return
    last = max(bag.end_ns - NS, bag.start_ns)
    begins = [bag.start_ns + (last - bag.start_ns) * k // FEW for k in range(FEW)]
    for begin, end in pairwise([*begins, last]):
        yield from islice(bag.messages([topic], begin, end), 1)
    yield from bag.messages([topic], start_ns=last)


def ends(bag: BagReader, topic: str) -> Iterator[RawMessage]:
    """Return the messages of a topic; of pictures, which are large, just the first and those of the last second."""
    if topic not in PICTURES:
        yield from bag.messages([topic])
        return
    yield from islice(bag.messages([topic]), 1)
    yield from bag.messages([topic], start_ns=bag.end_ns - NS)


def header_stamp_ns(raw: RawMessage) -> int | None:
    """Read ``header.stamp`` without decoding the message; None where its type does not begin with a header."""
    return first_stamp_ns(raw) if raw.type in HEADED_TYPES else None


def first_stamp_ns(raw: RawMessage) -> int | None:
    """Read the stamp of a message that begins with a header, without decoding it; None where it is too short."""
    if len(raw.data) < 12:
        return None
    sec, nanosec = struct.unpack_from("<iI" if raw.data[1] & 1 else ">iI", raw.data, 4)
    return int(sec * NS + nanosec)


def picture_topic(bag: BagReader, topic: str) -> str | None:
    """Return the raw ``topic`` or ``<topic>/compressed``, which holds more pictures (the raw one if as many); None
    where neither is there."""
    names = [name for name in (topic, topic + "/compressed") if name in bag.topics]
    return max(names, key=lambda name: bag.topics[name].count) if names else None


def read_images(path: Path | str, topic: str) -> Iterator[Image]:
    """Read the pictures of a topic, raw or compressed (`picture_topic`), in the order of their receive time."""
    with read_bag(path) as bag:
        name = picture_topic(bag, topic)
        for raw in bag.messages([name] if name is not None else []):
            yield to_image(raw)


def to_image(raw: RawMessage) -> Image:
    """Return the picture of a serialised Image or CompressedImage."""
    message = decode(raw)
    stamp_ns = _stamp(message)
    if raw.type.endswith("CompressedImage"):
        return pictures.read_compressed_image(message, stamp_ns)
    return pictures.read_image(message, stamp_ns)


# --- reading one message ---------------------------------------------------------------------------------------------


def _stamp(message: Any) -> int:
    return read_stamp(message.header.stamp)


_CLOUDS: dict[str, Callable[[NDArray[Any]], tuple[tuple[NDArray[Any], ...], int]]] = {
    t.STEREO_MARKERS: layouts.marker_columns,
    t.STEREO_MARKERS_RAW: layouts.marker_columns,
    t.FEM_MARKERS: lambda rows: ((layouts.ids(rows), layouts.points(rows)), 0),
    t.COMPARE_MARKERS: lambda rows: (
        (layouts.ids(rows), layouts.points(rows), layouts.vectors(rows, ("ex", "ey", "ez"))),
        0,
    ),
}
"""What is read of the rows (n,) of clouds: arrays of n rows, and how many impossible covariances there are."""
_FRAMES: dict[str, Callable[..., Any]] = {
    t.STEREO_MARKERS: MarkerFrame,
    t.STEREO_MARKERS_RAW: MarkerFrame,
    t.FEM_MARKERS: PredictedMarkers,
    t.COMPARE_MARKERS: ErrorFrame,
}


def _one(topic: str, message: Any) -> tuple[Any, int]:
    """Return what is read of one message, and its number of impossible covariances."""
    stamp_ns = _stamp(message)
    if topic in _CLOUDS:
        columns, n_wrong = _CLOUDS[topic](layouts.unpack(message))
        return _FRAMES[topic](stamp_ns, *columns), n_wrong
    if topic == t.PROBE_POSE:
        p, q = message.pose.position, message.pose.orientation
        return unit_pose(stamp_ns, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)), 0
    f, m = message.wrench.force, message.wrench.torque
    wrench = Wrench(stamp_ns, np.array([f.x, f.y, f.z], float), np.array([m.x, m.y, m.z], float))
    if not _is_finite(wrench):
        raise RecordingError("its force or torque is not finite", where=topic, remedy="check the sensor")
    return wrench, 0


def _is_finite(wrench: Wrench) -> bool:
    return bool(np.isfinite(wrench.force).all() and np.isfinite(wrench.torque).all())


def _together(topic: str, found: alike.Alike) -> tuple[list[Any], int]:
    """Return what is read of each of many messages, None where one has to be looked at, and the number of impossible
    covariances."""
    values = found.values
    if topic == t.PROBE_POSE:
        return [*unit_poses(found.stamps_ns, values[:, :3], values[:, 3:])], 0
    if topic not in _CLOUDS:
        rows = zip(found.stamps_ns, values[:, :3], values[:, 3:], strict=True)
        wrenches = [Wrench(stamp_ns, force, torque) for stamp_ns, force, torque in rows]
        return [wrench if _is_finite(wrench) else None for wrench in wrenches], 0
    columns, n_wrong = _CLOUDS[topic](values.reshape(-1))
    shaped = [column.reshape(*values.shape, *column.shape[1:]) for column in columns]
    return [
        _FRAMES[topic](stamp_ns, *parts) for stamp_ns, *parts in zip(found.stamps_ns, *shaped, strict=True)
    ], n_wrong


_CAMERAS = {t.LEFT_CAMERA_INFO: "left", t.RIGHT_CAMERA_INFO: "right"}
_PHANTOM_TOPICS = (t.STEREO_MARKERS, t.PROBE_POSE, t.PROBE_WRENCH)
_TOGETHER = 2000  # messages of a topic that are read at a time: what is read of them is kept, their bytes are not


class _Collector:
    """Sorts decoded messages by topic, and counts what had to be left out."""

    def __init__(self, warnings: list[str]) -> None:
        self.items: dict[str, list[Any]] = {name: [] for name in t.NUMBERS}
        self.cameras: dict[str, CameraCalibration] = {}
        self.transforms: dict[tuple[str, str], Pose] = {}
        self.counts: dict[str, int] = {}
        self.received: dict[str, list[int]] = {name: [] for name in t.NUMBERS}
        self.stamps: dict[str, Stamps] = {name: [] for name in t.NUMBERS}
        self.faults: Counter[str] = Counter()
        self.unknown: set[int] = set()
        self.sound_ids: set[bytes] = set()  # of frames that are kept as they are
        self.repeats: dict[str, Repeats] = {}
        self.other_frames: dict[str, str] = {}
        self.given = True  # markers, which are found in the pictures where there are any
        self._bad_ns: set[int] = set()
        self._good_ns: set[int] = set()
        self._waiting: dict[str, list[RawMessage]] = {name: [] for name in t.NUMBERS}

    def count(self, what: str, n: int = 1) -> None:
        self.counts[what] = self.counts.get(what, 0) + n

    def take(self, raw: RawMessage) -> None:
        """Take one message; those with a stamp are read when there are many, or in the end."""
        if raw.topic not in self.items:
            self._read(raw)
            return
        self._waiting[raw.topic].append(raw)
        if len(self._waiting[raw.topic]) >= _TOGETHER:
            self._read_waiting(raw.topic)

    def finish(self) -> None:
        """Read what is left."""
        for topic in self._waiting:
            self._read_waiting(topic)

    def _read_waiting(self, topic: str) -> None:
        """Read the messages that are alike together, and the others one by one."""
        raws, self._waiting[topic] = self._waiting[topic], []
        read: dict[int, Any] = {}
        for found in alike.groups(raws, t.TOPICS[topic].type):
            try:
                items, n_wrong = _together(topic, found)
            except RecordingError:  # of which, is found out one by one
                continue
            read |= {row: item for row, item in zip(found.rows, items, strict=True) if item is not None}
            self._check(topic, found.frame_id, n_wrong, sum(item is not None for item in items))
            if topic == t.PROBE_POSE:
                self.faults["norm"] += odd_norms(found.values[[item is not None for item in items], 3:])
        for row, raw in enumerate(raws):
            item = read.get(row)
            if item is not None:
                self.stamps[topic].append((item.stamp_ns, raw.log_time_ns))
                self.items[topic].append(item)
                self.received[topic].append(raw.log_time_ns)
            else:
                self.stamps[topic] += header_stamps([raw])
                self._read(raw)

    def _read(self, raw: RawMessage) -> None:
        try:
            message = decode(raw)
            if raw.topic in self.items:
                item, n_wrong = _one(raw.topic, message)
                self._check(raw.topic, message.header.frame_id, n_wrong)
                if raw.topic == t.PROBE_POSE:
                    q = message.pose.orientation
                    self.faults["norm"] += odd_norms(np.array([[q.x, q.y, q.z, q.w]]))
                self.items[raw.topic].append(item)
                self.received[raw.topic].append(raw.log_time_ns)
            elif raw.topic in _CAMERAS:
                self.cameras.setdefault(_CAMERAS[raw.topic], pictures.read_camera_info(message))
            else:
                self._transforms(message)
        except RecordingError as error:
            self.count(f"{raw.topic}: left out, {error.what}")
            self.faults["no_id"] += error.what == layouts.NO_ID
            self.faults["quaternion"] += error.what.startswith(NO_ROTATION)
        except (AttributeError, TypeError, ValueError):  # a bag brings the definitions of its types
            self.count(f"{raw.topic}: left out, it is no {t.TOPICS[raw.topic].type} (its type is {raw.type})")

    def _check(self, topic: str, frame_id: str, n_wrong: int, n: int = 1) -> None:
        """Count what is odd about ``n`` messages of one frame, with ``n_wrong`` impossible covariances."""
        if n and topic in _PHANTOM_TOPICS and frame_id not in (t.FRAME_PHANTOM, ""):
            self.other_frames.setdefault(topic, frame_id)
        if n_wrong:
            self.count(
                f"{topic}: covariances that are zero, negative, infinite or incomplete are taken as unknown", n_wrong
            )
            self.faults["covariance"] += n_wrong

    def _transforms(self, message: Any) -> None:
        for entry in message.transforms:
            p, q = entry.transform.translation, entry.transform.rotation
            key = (entry.header.frame_id, entry.child_frame_id)
            pose = unit_pose(_stamp(entry), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
            if key == (t.FRAME_PHANTOM, t.FRAME_LEFT):
                self.faults["cameras_moved"] += not _is_same(self.transforms.get(key, pose), pose)
            self.transforms[key] = pose

    def sorted(self, topic: str) -> list[Any]:
        """Sort by stamp, without those whose stamp cannot be right. Of two with the same stamp the first stays, but
        clouds that share no marker become one."""
        stamps = [item.stamp_ns for item in self.items[topic]]
        bad = self._bad(topic, stamps)
        if bad.any():
            stretches = int(in_stretches(bad).sum()) if t.TOPICS[topic].input else 0
            self.count(f"{topic}: left out, the stamp cannot be right", int(bad.sum()))
            self.faults["stamp"] += int(bad.sum()) - stretches
            self.faults["stretch"] += stretches
        self.faults["unset"] += len(stamps) > 1 and not any(stamps)
        good = [item for item, wrong in zip(self.items[topic], bad, strict=True) if not wrong]
        if t.TOPICS[topic].input:
            self.faults["set_back"] += times_set_back([item.stamp_ns for item in good])
            self.faults["pause"] = max(self.faults["pause"], long_pauses([item.stamp_ns for item in good]))
        unique: list[Any] = []
        joined = 0
        for item in sorted(good, key=lambda item: item.stamp_ns):
            if not unique or item.stamp_ns != unique[-1].stamp_ns:
                unique.append(item)
            elif (both := _joined(unique[-1], item)) is not None:
                unique[-1], joined = both, joined + 1
        repeats = Repeats(len(good) - len(unique) - joined, joined)
        if repeats.n:
            self.repeats[topic] = repeats
        if repeats.left_out:
            self.count(f"{topic}: left out, the stamp was there already", repeats.left_out)
        if joined:
            self.count(f"{topic}: added to the frame of the same stamp, with which they share no marker", joined)
        return unique

    def _bad(self, topic: str, stamps: Sequence[int]) -> NDArray[np.bool_]:
        """Return which of a topic's ``stamps`` cannot be right. What is computed has its input's stamp, and comes when
        it is done: it is wrong where that is, however late it came."""
        if t.TOPICS[topic].input and (self.given or topic not in (t.STEREO_MARKERS, t.STEREO_MARKERS_RAW)):
            bad = bad_stamps(stamps, self.received[topic])
            self._bad_ns |= set(np.array(stamps)[bad].tolist())
            self._good_ns |= set(np.array(stamps)[~bad].tolist())
            return bad
        wrong = self._bad_ns - self._good_ns
        return np.array([stamp in wrong for stamp in stamps], bool)

    def report(self) -> list[str]:
        return [f"{what} ({n} messages)" if n > 1 else what for what, n in self.counts.items()]


def _joined(one: Any, other: Any) -> Any:
    """Return two measured clouds of one stamp, or two clouds of errors, as one; None where they are no such clouds, or
    share a marker."""
    if not isinstance(one, MarkerFrame | ErrorFrame) or np.intersect1d(one.ids, other.ids).size:
        return None
    values = [getattr(cloud, f.name) for f in fields(one)[1:] for cloud in (one, other)]
    return type(one)(one.stamp_ns, *(np.concatenate(values[k : k + 2]) for k in range(0, len(values), 2)))


def _is_same(one: Pose, other: Pose) -> bool:
    """Tell whether two transforms are one, but for what they are rounded by."""
    turn = 2.0 * np.arccos(min(abs(float(one.orientation_xyzw @ other.orientation_xyzw)), 1.0))
    return bool(np.linalg.norm(one.position - other.position) < SAME_PLACE and turn < SAME_TURN)


@dataclass(frozen=True)
class SoundFrame:
    """A measured ``frame`` without what nobody can use: so many markers were ``not_finite``, the ids of the ``unknown``
    are none of the experiment's, and so many ids were there ``twice``."""

    frame: MarkerFrame
    not_finite: int = 0
    unknown: frozenset[int] = frozenset()
    twice: int = 0


def sound_frame(frame: MarkerFrame, known: Ids | None) -> SoundFrame:
    """Leave out the markers of a frame that are not finite, none of the ``known`` (all are where None), or there twice:
    what is recorded and what comes in live is looked at alike."""
    finite = np.asarray(np.isfinite(frame.points).all(axis=1))
    unknown = np.zeros(len(finite), bool) if known is None else finite & ~np.isin(frame.ids, known)
    twice = layouts.named_twice(frame.ids, finite & ~unknown)
    keep = finite & ~unknown & ~twice
    if keep.all():
        return SoundFrame(frame)
    kept = MarkerFrame(
        frame.stamp_ns, frame.ids[keep], frame.points[keep], frame.covariances[keep], frame.reprojection_error_px[keep]
    )
    ids = frozenset(frame.ids[unknown].tolist())
    return SoundFrame(kept, int((~finite).sum()), ids, len(np.unique(frame.ids[twice])))


def _keep(frame: MarkerFrame, known: Ids | None, collector: _Collector) -> MarkerFrame:
    """Return the frame without markers that are not finite, not known, or there twice, which are counted."""
    key = frame.ids.tobytes()
    if key in collector.sound_ids and np.isfinite(frame.points).all():
        return frame
    found = sound_frame(frame, known)
    if found.frame is frame:
        collector.sound_ids.add(key)
        return frame
    why = {
        "their coordinates are not finite": found.not_finite,
        "the experiment does not know their ids": len(found.unknown),
        "their id is there twice": found.twice,
    }
    for reason in (reason for reason, n in why.items() if n):
        collector.count(f"{t.STEREO_MARKERS}: markers left out in some frames, {reason}")
    collector.faults.update({name: n for name, n in (("not_finite", found.not_finite), ("twice", found.twice)) if n})
    collector.unknown |= found.unknown
    return found.frame
