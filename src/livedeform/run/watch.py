"""Looks at what comes in during a live session with the checks of recordings, and says at once what is wrong."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.layouts import NO_ID, marker_columns, unpack
from livedeform.common.bags.recording import PICTURES, Recording, clocked, good_messages, header_stamp_ns, sound_frame
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.recorded import check_recording
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import odd_norms, unit_pose
from livedeform.common.stamps import SetBacks
from livedeform.common.types import MarkerFrame, Pose

EVERY = 5.0  # s
MOST_FRAMES, MOST = 50, 400  # marker frames, and messages of other streams, that are kept
ONE_OF = 5  # later frames that is looked at: to read one takes half a millisecond of the thread that records
LONG_NS = 20_000_000_000  # before so much has come, a queue that is full for a second looks like a clock that was set
NOT_YET = ("never touches", "are never seen", "there is no", "timeline.release")  # may still come

Item = TypeVar("Item")


class Spread(Generic[Item]):
    """Keeps some items of a stream, spread evenly over it: where they become more than `MOST`, half of them go."""

    def __init__(self) -> None:
        self.items: list[Item] = []
        self._n, self._every = 0, 1

    def is_due(self) -> bool:
        """Count one more item, and tell whether it is one to be kept."""
        self._n += 1
        return self._n % self._every == 0

    def keep(self, item: Item) -> None:
        self.items.append(item)
        if len(self.items) > MOST:
            self.items, self._every = self.items[::2], 2 * self._every


class LiveWatch:
    """Keeps the first marker frames, and some of the poses and of when messages came; ``news`` are findings that were
    not there before. ``clock`` gives the receive time (ns) of a message."""

    def __init__(self, experiment: Experiment, clock: Callable[[], int] = time.time_ns) -> None:
        self._experiment, self._clock = experiment, clock
        self._frames: list[MarkerFrame] = []
        self._n_frames = 0
        self._poses = Spread[Pose]()
        self._arrivals: defaultdict[str, Spread[tuple[int, int]]] = defaultdict(Spread)
        self._faults: Counter[str] = Counter()
        self._unknown: set[int] = set()
        self._frame_ids: dict[str, str] = {}
        self._set_backs: defaultdict[str, SetBacks] = defaultdict(SetBacks)
        self._looked, self._changed = 0.0, False
        self._said: set[str] = set()

    def take(self, topic: str, type_name: str, data: bytes) -> None:
        """One serialised message, as it is recorded."""
        raw = RawMessage(topic, type_name, 0, data)
        try:
            if topic in (*clocked(False), *PICTURES):
                self._take_arrival(topic, header_stamp_ns(raw) or 0)
            if topic == t.STEREO_MARKERS:
                self._n_frames += 1
                if self._n_frames <= MOST_FRAMES or self._n_frames % ONE_OF == 0:
                    self._take_frame(raw)
            elif topic == t.PROBE_POSE and self._poses.is_due():
                self._take_pose(raw)
        except RecordingError as error:
            self._faults["no_id"] += error.what == NO_ID

    def _take_arrival(self, topic: str, stamp_ns: int) -> None:
        if self._arrivals[topic].is_due():
            self._arrivals[topic].keep((stamp_ns, self._clock()))
        if topic not in PICTURES:
            self._set_backs[topic].take(stamp_ns)

    def _take_frame(self, raw: RawMessage) -> None:
        cloud = decode(raw)
        columns, n_wrong = marker_columns(unpack(cloud))
        found = sound_frame(MarkerFrame(header_stamp_ns(raw) or 0, *columns), self._experiment.markers.ids)
        self._faults.update({"not_finite": found.not_finite, "twice": found.twice, "covariance": n_wrong})
        self._unknown |= found.unknown
        if len(self._frames) < MOST_FRAMES:
            self._frames.append(found.frame)
        self._keep_frame(raw.topic, cloud.header.frame_id)

    def _keep_frame(self, topic: str, frame_id: str) -> None:
        if frame_id not in (t.FRAME_PHANTOM, ""):
            self._frame_ids.setdefault(topic, frame_id)
        self._changed = True

    def _take_pose(self, raw: RawMessage) -> None:
        message = decode(raw)
        p, q = message.pose.position, message.pose.orientation
        self._poses.keep(unit_pose(header_stamp_ns(raw) or 0, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))
        self._faults["norm"] += odd_norms(np.array([[q.x, q.y, q.z, q.w]]))
        self._keep_frame(t.PROBE_POSE, message.header.frame_id)

    def news(self) -> list[Finding]:
        """Errors and warnings that are new, looked for every few seconds."""
        if not self._changed or time.monotonic() - self._looked < EVERY:
            return []
        self._looked, self._changed = time.monotonic(), False
        frames, poses = list(self._frames), list(self._poses.items)  # more come in, in another thread
        stamps = [*(f.stamp_ns for f in frames), *(p.stamp_ns for p in poses)]
        faults = dict(self._faults) | {"set_back": sum(clock.n for clock in list(self._set_backs.values()))}
        recording = Recording(
            Path(), min(stamps, default=0), max(stamps, default=0), frames, poses, [], {}, {},
            faults=faults, other_frames=dict(self._frame_ids), unknown_ids=tuple(sorted(self._unknown)),
            arrivals=self._came(),
        )  # fmt: skip
        found = [f for f in check_recording(recording, self._experiment) if f.level != "NOTE"]
        new = [f for f in found if not any(word in f.text for word in NOT_YET) and self._key(f) not in self._said]
        self._said |= {self._key(f) for f in new}
        return new

    def _came(self) -> dict[str, list[tuple[int, int]]]:
        """Return when messages came, as of a recording (`arrivals_of`); nothing before that tells of clocks."""
        came = {name: list(kept.items) for name, kept in list(self._arrivals.items())}
        received = [pair[1] for pairs in came.values() for pair in pairs]
        if max(received, default=0) - min(received, default=0) < LONG_NS:
            return {}
        filmed = any(name in came for name in PICTURES)
        cameras = [
            max(names, key=lambda name: len(came.get(name, ())))
            for names in zip(t.IMAGES, t.COMPRESSED_IMAGES, strict=True)
        ]
        return {name: good_messages(came[name]) for name in (*cameras, *clocked(filmed)) if name in came}

    def _key(self, finding: Finding) -> str:
        """The finding without its numbers, which change while more comes in."""
        return "".join(c for c in finding.text if not c.isdigit())
