"""Choose what of a bag is played to the nodes, and to which topic. No ROS here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

from livedeform.common import topics as t
from livedeform.common.bags.read import BagReader
from livedeform.common.bags.recording import Recording, Stamps, header_stamp_ns
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.checks.beginning import check_left_out, check_start, last_clear
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.probe_path import ProbeRecord, check_probe
from livedeform.common.checks.recorded import POSES_APART_NS
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.stamps import APART_NS, bad_stamps
from livedeform.common.types import Pose
from livedeform.comparing.identity import is_part
from livedeform.fem_node.declared import declared_physics
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.physics.memory import Memory, memory_of
from livedeform.stereo_node.effects import EFFECTS

Measured = Literal["images", "markers", "surface"]
Trigger = Literal["poses", "frames", "no_poses"]


Message = tuple[str, int, int | None]
"""A message of a recording: topic, receive time, stamp (ns)."""


@dataclass(frozen=True)
class Plan:
    """``topics``: recorded topic -> the topic that it is played on; ``measured``: where the markers come from;
    ``trigger``: at whose stamps the model predicts; ``corrected``: whether the model has measuring effects;
    ``bad``: messages that are not played, since the stamp cannot be right or nothing can decode them;
    ``start_ns``, ``end_ns``: receive times of the first and last message that is; ``longest_pause_ns`` between those;
    ``warnings`` one line each."""

    topics: dict[str, str]
    measured: Measured
    trigger: Trigger
    corrected: bool
    start_ns: int
    end_ns: int
    bad: frozenset[Message] = frozenset()
    longest_pause_ns: int = 0
    warnings: tuple[str, ...] = ()


def plan(bag: BagReader, experiment: Experiment, *, at_frames: bool = False) -> Plan:
    """The inputs among the bag's topics, without what an earlier run computed; ``InputError`` if one is missing.

    ``at_frames``: predict at the stamps of the measured frames, not of the poses.
    """
    have = {name for name, info in bag.topics.items() if info.count}
    for name in have & t.TOPICS.keys():
        if bag.topics[name].type != t.TOPICS[name].type:
            raise RecordingError(
                f"topic {name} is {bag.topics[name].type}, not {t.TOPICS[name].type}",
                where=str(bag.path),
                remedy="record it so",
            )
    corrected = any(effect.name in EFFECTS for effect in experiment.effects)
    played, measured = _measurements(bag, experiment, have, t.STEREO_MARKERS_RAW if corrected else t.STEREO_MARKERS)
    if t.STEREO_SURFACE in have:
        played[t.STEREO_SURFACE] = t.STEREO_SURFACE
    warnings = list(bag.warnings)
    trigger: Trigger = "no_poses"
    if t.PROBE_POSE in have and experiment.probe is not None:
        played[t.PROBE_POSE] = t.PROBE_POSE
        trigger = "frames" if at_frames else "poses"
    elif t.PROBE_POSE in have:
        warnings.append(f"the bag has {t.PROBE_POSE}, but the experiment declares no probe: the poses are not used")
    if t.PROBE_WRENCH in have:
        played[t.PROBE_WRENCH] = t.PROBE_WRENCH
    seen, damaged = _scanned(bag, list(played))
    start_ns, end_ns, bad = _line_of_time(bag, seen)
    if damaged:
        names = ", ".join(sorted({name for name, _, _ in damaged}))
        warnings.append(f"{len(damaged)} messages of {names} are left out: they cannot be decoded")
    if bad:
        names = ", ".join(sorted({name for name, _, _ in bad}))
        what = "their stamps cannot be right, or their receive times"
        warnings.append(f"{len(bad)} messages of {names} are left out: {what}")
    left_out = frozenset(bad | damaged)
    pause = _longest_pause([m for m in seen if m not in left_out])
    return Plan(played, measured, trigger, corrected, start_ns, end_ns, left_out, pause, tuple(warnings))


def _scanned(bag: BagReader, topics: Sequence[str]) -> tuple[list[Message], set[Message]]:
    """Return the messages of the topics but the camera infos, and of all those that no node would get, since nothing
    can decode them: a replay in lock step would wait for them."""
    seen: list[Message] = []
    damaged: set[Message] = set()
    for raw in bag.messages(topics):
        message = raw.topic, raw.log_time_ns, header_stamp_ns(raw)
        if raw.topic not in t.CAMERA_INFOS:
            seen.append(message)
        try:
            decode(raw)
        except RecordingError:
            damaged.add(message)
    return seen, damaged


def _line_of_time(bag: BagReader, seen: Sequence[Message]) -> tuple[int, int, set[Message]]:
    """Receive times (ns) of the first and last message with a good stamp, and the messages with a bad one."""
    bad: set[Message] = set()
    received: list[int] = []
    for name in dict.fromkeys(topic for topic, _, _ in seen):
        known = [(log, stamp) for topic, log, stamp in seen if topic == name and stamp is not None]
        logs = [log for log, _ in known]
        wrong = bad_stamps([stamp for _, stamp in known], logs) | bad_stamps(logs, logs)
        bad |= {(name, *pair) for pair, is_bad in zip(known, wrong, strict=True) if is_bad}
        received += [pair[0] for pair, is_bad in zip(known, wrong, strict=True) if not is_bad]
    return (min(received), max(received), bad) if bad and received else (bag.start_ns, bag.end_ns, bad)


def _longest_pause(played: Sequence[Message]) -> int:
    """Return the longest pause (ns) between the receive times of messages."""
    return max((b - a for a, b in pairwise(sorted(log for _, log, _ in played))), default=0)


def _measurements(
    bag: BagReader, experiment: Experiment, have: set[str], markers_to: str
) -> tuple[dict[str, str], Measured]:
    """Pictures if there are both and cameras for them, otherwise recorded markers (uncorrected ones first), or
    points without ids alone."""
    if not len(experiment.markers.ids):
        if t.STEREO_SURFACE in have:
            return {}, "surface"
        raise InputError(
            f"the experiment names no markers, and the bag has no points without ids ({t.STEREO_SURFACE})",
            where=str(bag.path), remedy="name phantom.markers in the experiment",
        )  # fmt: skip
    calibrated = experiment.stereo is not None and experiment.stereo.left is not None
    both = [pair for pair in (t.IMAGES, t.COMPRESSED_IMAGES) if set(pair) <= have]
    pictures = max(both, key=lambda pair: min(bag.topics[name].count for name in pair), default=None)
    if pictures and (calibrated or set(t.CAMERA_INFOS) <= have):
        return {name: name for name in (*pictures, *t.CAMERA_INFOS) if name in have}, "images"
    for name in (t.STEREO_MARKERS_RAW, t.STEREO_MARKERS):
        if name in have:
            return {name: markers_to}, "markers"
    if t.STEREO_SURFACE in have:
        return {}, "surface"
    if pictures:
        raise InputError(
            "the bag has pictures, but nothing says how the cameras see",
            where=str(bag.path),
            remedy="name stereo.left and stereo.right in the experiment, or record camera_info",
        )
    remedy = f"it needs {t.LEFT_IMAGE} and {t.RIGHT_IMAGE}, {t.STEREO_MARKERS} or {t.STEREO_SURFACE}"
    found = ", ".join(sorted(have)) or "no messages"
    raise InputError(f"nothing measured is in the bag (it has {found})", where=str(bag.path), remedy=remedy)


def refuse_pauses(bag: BagReader, plan: Plan) -> None:
    """Raise ``RecordingError`` where the receive times pause for so long that nobody waits for a replay's next message.

    Of a topic whose messages have a header; the others come with them.
    """
    if plan.longest_pause_ns > APART_NS:
        raise RecordingError(
            f"the receive times pause for {plan.longest_pause_ns / APART_NS:.3g} hours",
            where=str(bag.path),
            remedy="replay it with --rate max, or record again with a clock that is set",
        )


def is_whole(plan: Plan, start: float, duration: float | None) -> bool:
    """Tell whether everything is played; ``start`` and ``duration`` in s."""
    return start <= 0.0 and (duration is None or plan.start_ns + round(duration * 1e9) > plan.end_ns)


def cut(recording: Recording, bag: BagReader, plan: Plan, start: float, duration: float | None) -> Recording:
    """Return the ``recording`` that is in the ``bag`` without what is not played of it, which nodes do not see either.
    When it begins and ends stays: a timeline counts from there. ``InputError`` where no pose is left."""
    if is_whole(plan, start, duration):
        return recording
    played: dict[str, set[int]] = {}
    for raw in messages(bag, plan, start, duration):
        stamp_ns = header_stamp_ns(raw)
        if stamp_ns is not None and raw.topic not in t.CAMERA_INFOS:
            played.setdefault(raw.topic, set()).add(stamp_ns)

    def of(*topics: str) -> set[int]:
        return set().union(*(played.get(topic, set()) for topic in topics))

    measured, poses, wrenches = of(t.STEREO_MARKERS, t.STEREO_MARKERS_RAW), of(t.PROBE_POSE), of(t.PROBE_WRENCH)
    stamps = {name: measured if name == t.STEREO_MARKERS else of(name) for name in recording.arrivals}
    if recording.poses and t.PROBE_POSE in plan.topics and not poses:
        what = f"there is no {t.PROBE_POSE} in the part that is to be played"
        raise InputError(what, where="--start, --duration", remedy="play more of the recording")
    return replace(
        recording,
        marker_frames=[frame for frame in recording.marker_frames if frame.stamp_ns in measured],
        uncorrected_marker_frames=[f for f in recording.uncorrected_marker_frames if f.stamp_ns in measured],
        poses=[pose for pose in recording.poses if pose.stamp_ns in poses],
        wrenches=[wrench for wrench in recording.wrenches if wrench.stamp_ns in wrenches],
        arrivals={name: kept for name, came in recording.arrivals.items() if (kept := _kept(came, stamps[name]))},
        picture_stamps_ns=tuple(sorted(of(t.LEFT_IMAGE, t.LEFT_COMPRESSED))),
    )


def _kept(came: Stamps, stamps: set[int]) -> Stamps:
    return [pair for pair in came if pair[0] in stamps]


@dataclass(frozen=True)
class Beginning:
    """A ``whole`` recording and the part of it that is ``played``: what comes before that is the beginning, which is
    empty where both begin together."""

    whole: Recording
    played: Recording
    experiment: Experiment

    @cached_property
    def poses(self) -> list[Pose]:
        """Return the probe's poses before the first that is played."""
        first_ns = self.played.poses[0].stamp_ns if self.played.poses else 0
        return [pose for pose in self.whole.poses if pose.stamp_ns < first_ns]

    @cached_property
    def seconds(self) -> float:
        """Return how long (s) after the whole recording began the first pose is played."""
        return 1e-9 * (self.played.poses[0].stamp_ns - self.whole.start_ns) if self.played.poses else 0.0

    @cached_property
    def _probe(self) -> ProbeRecord:
        return ProbeRecord(self.whole, self.experiment, read_body(self.experiment))

    @cached_property
    def _memory(self) -> Memory:
        return memory_of(apply_effects(declared_physics(self.experiment), self.experiment.effects))

    @property
    def _lasting(self) -> list[str]:
        """Return why the model remembers what was before the probe let go."""
        return [reason for reason in self._memory.path_dependent if reason not in self._memory.rubs]

    @cached_property
    def to_pass(self) -> list[Pose]:
        """Return the poses through which the model is led before it predicts: all that it remembers, and of a body that
        does not, the press that is under way, which may lead to one of several answers."""
        if self._memory.path_dependent or not self.poses:
            return self.poses
        clear_ns = self.whole.start_ns + round(1e9 * last_clear(self._probe, self.seconds))
        return [pose for pose in self.poses if pose.stamp_ns >= clear_ns]

    def findings(self, plan: Plan) -> list[Finding]:
        """Check the probe's path, and doubt cameras that are registered while the body is pressed; and a beginning that
        the model would remember, where the recording is a run of a part and does not hold it."""
        if not self.poses:
            return self._not_held()
        stereo = self.experiment.stereo
        registers = plan.measured == "images" and (stereo is None or isinstance(stereo.pose, str))
        return [*check_probe(self._probe), *check_start(self._probe, self.seconds, registers=registers)]

    def _not_held(self) -> list[Finding]:
        late_ns = self.played.poses[0].stamp_ns - self.whole.start_ns if self.played.poses else 0
        reasons = ", ".join(self._lasting)
        if not is_part(self.whole.metadata) or late_ns < POSES_APART_NS or not reasons:
            return []
        text = (
            f"it is a run from {1e-9 * late_ns:.3g} s on, without what the model would remember of before ({reasons})"
        )
        return [Finding("WARN", text, "run the recording that was run, with --start", doubts=True)]

    def left_out(self) -> list[Finding]:
        """Doubt a model that could not be led through all of it, where that matters."""
        return check_left_out(self._probe, self.seconds, self._lasting, self._memory.rubs)


def messages(bag: BagReader, plan: Plan, start: float = 0.0, duration: float | None = None) -> Iterator[RawMessage]:
    """The planned messages in the order of their receive times, renamed; ``start`` and ``duration`` in s.

    Camera calibrations are always given, first of all: a bag often holds them once, at its start.
    """
    infos = [name for name in plan.topics if name in t.CAMERA_INFOS]
    others = [name for name in plan.topics if name not in t.CAMERA_INFOS]
    begin = plan.start_ns + round(start * 1e9)
    end = begin + round(duration * 1e9) if duration is not None else None
    for name in infos:
        sound = (m for m in bag.messages([name]) if (name, m.log_time_ns, header_stamp_ns(m)) not in plan.bad)
        first = next(sound, None)
        if first is not None:
            yield replace(first, topic=plan.topics[name], log_time_ns=begin)
    for raw in bag.messages(others, begin, end):
        if not plan.bad or (raw.topic, raw.log_time_ns, header_stamp_ns(raw)) not in plan.bad:
            yield replace(raw, topic=plan.topics[raw.topic])
