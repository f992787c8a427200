"""Choose the moments at which the model predicts: every pose, or every measured frame with the pose interpolated to
it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from scipy.spatial.transform import Rotation

from livedeform.common.errors import InputError
from livedeform.common.frames import slerp
from livedeform.common.stamps import StampClock, StampKind, StampOrder
from livedeform.common.types import Pose

Moment = tuple[
    Pose | None, int | None
]  # what PhantomModel.predict takes; stamp None: the pose's own, as it corrects it


class Requests(Protocol):
    """Poses and frames come in, live with the time when they were received; moments to predict come out, and in the
    end those that were held back. ``skipped`` counts what nothing comes of: it came after a later one, or its stamp is
    wrong."""

    @property
    def skipped(self) -> int: ...

    def on_pose(self, pose: Pose, received_ns: int | None = None) -> list[Moment]: ...

    def on_frame(self, stamp_ns: int, received_ns: int | None = None) -> list[Moment]: ...

    def end(self) -> list[Moment]: ...


class _InOrder:
    """Moments in the order of their stamps: time does not go back, and a body with a memory would age anew, or, by one
    wrong stamp, at once."""

    def __init__(self) -> None:
        self._order = StampOrder[Moment]()

    @property
    def skipped(self) -> int:
        return self._order.refused

    def end(self) -> list[Moment]:
        return self._order.end()


class AtPoses(_InOrder):
    """One prediction per pose."""

    def on_pose(self, pose: Pose, received_ns: int | None = None) -> list[Moment]:
        return self._order.admit(pose.stamp_ns, (pose, None), received_ns)

    def on_frame(self, stamp_ns: int, received_ns: int | None = None) -> list[Moment]:
        return []


class WithoutPoses(_InOrder):
    """One prediction per measured frame, without a probe; markers and surface points of one moment count once."""

    def __init__(self) -> None:
        super().__init__()
        self._last_ns: int | None = None

    def on_pose(self, pose: Pose, received_ns: int | None = None) -> list[Moment]:
        return []

    def on_frame(self, stamp_ns: int, received_ns: int | None = None) -> list[Moment]:
        if stamp_ns == self._last_ns:
            return []
        self._last_ns = stamp_ns
        return self._order.admit(stamp_ns, (None, stamp_ns), received_ns)


class AtFrames:
    """One prediction per measured frame, once the poses before and after it are there; none beyond the last pose.

    ``time_offset`` s > 0: the poses' stamps are late. Poses more than ``max_gap_ns`` apart are not interpolated.
    """

    skipped = 0  # there is no prediction of a pose's own

    def __init__(self, time_offset: float = 0.0, max_gap_ns: int = 500_000_000) -> None:
        self._late_ns, self._max_gap_ns = round(1e9 * time_offset), max_gap_ns
        self._poses: deque[Pose] = deque(maxlen=10_000)
        self._frames: deque[int] = deque(maxlen=10_000)
        self._pose_clock, self._frame_clock = StampClock(max_gap_ns), StampClock(max_gap_ns)

    def on_pose(self, pose: Pose, received_ns: int | None = None) -> list[Moment]:
        true_ns = pose.stamp_ns - self._late_ns
        step = self._pose_clock.take(true_ns)
        if step is StampKind.UNMASKS and self._poses and self._poses[-1].stamp_ns > true_ns:
            self._poses.pop()
        elif step is StampKind.SET:
            self._forget(self._poses, self._frames, self._frame_clock.n_set < self._pose_clock.n_set)
        if not self._poses or true_ns > self._poses[-1].stamp_ns:
            self._poses.append(Pose(true_ns, pose.position, pose.orientation_xyzw))
        return self._ready()

    def on_frame(self, stamp_ns: int, received_ns: int | None = None) -> list[Moment]:
        step = self._frame_clock.take(stamp_ns)
        if step is StampKind.UNMASKS and self._frames and self._frames[-1] > stamp_ns:
            self._frames.pop()
        elif step is StampKind.SET:
            self._forget(self._frames, self._poses, self._pose_clock.n_set < self._frame_clock.n_set)
        if not self._frames or stamp_ns > self._frames[-1]:
            self._frames.append(stamp_ns)
        return self._ready()

    def end(self) -> list[Moment]:
        return []

    def _known(self, stamp_ns: int) -> bool:
        """Tell whether the poses reach a moment."""
        return bool(self._poses) and stamp_ns <= self._poses[-1].stamp_ns and self._pose_clock.sure_of(stamp_ns)

    @staticmethod
    def _forget(own: deque[Any], other: deque[Any], too: bool) -> None:
        """Forget what waits by a clock that was set back, and, unless it was set before, by the ``other`` one."""
        own.clear()
        if too:
            other.clear()

    def _ready(self) -> list[Moment]:
        moments: list[Moment] = []
        while self._frames and self._known(self._frames[0]):
            stamp_ns = self._frames.popleft()
            while len(self._poses) > 1 and self._poses[1].stamp_ns <= stamp_ns:
                self._poses.popleft()
            first = self._poses[0]
            if first.stamp_ns == stamp_ns:
                moments.append((first, stamp_ns))
            elif first.stamp_ns < stamp_ns and self._poses[1].stamp_ns - first.stamp_ns <= self._max_gap_ns:
                moments.append((interpolate(first, self._poses[1], stamp_ns), stamp_ns))
        return moments


def interpolate(first: Pose, second: Pose, stamp_ns: int) -> Pose:
    """Return the pose between two: position on the straight line, orientation at constant angular velocity (slerp)."""
    a = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
    turn = slerp(Rotation.from_quat([first.orientation_xyzw, second.orientation_xyzw]), a)
    position = first.position + a * (second.position - first.position)
    return Pose(stamp_ns, position, turn.as_quat())


def make_requests(trigger: str, has_probe: bool, time_offset: float) -> Requests:
    """Make the requests of ``trigger`` poses, frames or no_poses; auto is poses where there is a probe. ``InputError``
    for another word."""
    if trigger == "auto":
        trigger = "poses" if has_probe else "no_poses"
    kinds: dict[str, Callable[[], Requests]] = {
        "poses": AtPoses,
        "frames": lambda: AtFrames(time_offset),
        "no_poses": WithoutPoses,
    }
    if trigger not in kinds:
        raise InputError(f"unknown trigger '{trigger}'", where="fem_node", remedy=f"known are auto, {', '.join(kinds)}")
    return kinds[trigger]()
