"""Looks at what comes in during a live session with the checks of recordings, and says at once what is wrong."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.layouts import NO_ID, unpack, unpack_marker_frame
from livedeform.common.bags.recording import Recording, header_stamp_ns
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.recorded import check_recording
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import odd_norms, unit_pose
from livedeform.common.stamps import SetBacks
from livedeform.common.types import MarkerFrame, Pose

EVERY = 5.0  # s
MOST_FRAMES, MOST_POSES = 50, 400
NOT_YET = ("never touches", "are never seen", "there is no", "timeline.release")  # may still come


class LiveWatch:
    """Keeps the first marker frames and some of the poses; ``news`` are findings that were not there before."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._frames: list[MarkerFrame] = []
        self._poses: list[Pose] = []
        self._faults: Counter[str] = Counter()
        self._frame_ids: dict[str, str] = {}
        self._clocks: defaultdict[str, SetBacks] = defaultdict(SetBacks)
        self._every = self._n_poses = 0
        self._looked, self._changed = 0.0, False
        self._said: set[str] = set()

    def take(self, topic: str, type_name: str, data: bytes) -> None:
        """One serialised message, as it is recorded."""
        raw = RawMessage(topic, type_name, 0, data)
        try:
            if topic in (t.STEREO_MARKERS, t.PROBE_POSE):
                self._clocks[topic].take(header_stamp_ns(raw) or 0)
            if topic == t.STEREO_MARKERS and len(self._frames) < MOST_FRAMES:
                cloud = decode(raw)
                self._frames.append(unpack_marker_frame(header_stamp_ns(raw) or 0, unpack(cloud)))
                self._keep_frame(topic, cloud.header.frame_id)
            elif topic == t.PROBE_POSE:
                self._take_pose(raw)
        except RecordingError as error:
            self._faults["no_id"] += error.what == NO_ID

    def _keep_frame(self, topic: str, frame_id: str) -> None:
        if frame_id not in (t.FRAME_PHANTOM, ""):
            self._frame_ids.setdefault(topic, frame_id)
        self._changed = True

    def _take_pose(self, raw: RawMessage) -> None:
        self._n_poses += 1
        if self._n_poses % max(self._every, 1):
            return
        message = decode(raw)
        p, q = message.pose.position, message.pose.orientation
        self._poses.append(unit_pose(header_stamp_ns(raw) or 0, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))
        self._faults["norm"] += odd_norms(np.array([[q.x, q.y, q.z, q.w]]))
        self._keep_frame(t.PROBE_POSE, message.header.frame_id)
        if len(self._poses) > MOST_POSES:  # half of them, twice as far apart
            self._poses, self._every = self._poses[::2], 2 * max(self._every, 1)

    def news(self) -> list[Finding]:
        """Errors and warnings that are new, looked for every few seconds."""
        if not self._changed or time.monotonic() - self._looked < EVERY:
            return []
        self._looked, self._changed = time.monotonic(), False
        frames, poses = list(self._frames), list(self._poses)  # more come in, in another thread
        stamps = [*(f.stamp_ns for f in frames), *(p.stamp_ns for p in poses)]
        faults = dict(self._faults) | {"set_back": sum(clock.n for clock in list(self._clocks.values()))}
        recording = Recording(
            Path(), min(stamps, default=0), max(stamps, default=0), frames, poses, [], {}, {},
            faults=faults, other_frames=dict(self._frame_ids),
        )  # fmt: skip
        found = [f for f in check_recording(recording, self._experiment) if f.level != "NOTE"]
        new = [f for f in found if not any(word in f.text for word in NOT_YET) and self._key(f) not in self._said]
        self._said |= {self._key(f) for f in new}
        return new

    def _key(self, finding: Finding) -> str:
        """The finding without its numbers, which change while more comes in."""
        return "".join(c for c in finding.text if not c.isdigit())
