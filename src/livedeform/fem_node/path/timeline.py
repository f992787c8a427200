"""The moments that a body passes on its path to a stamp: the state at rest, the release, the stamp itself."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.items.dynamics import MEMORY
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics, Probe

LONGEST_PATH_STEP = 5e-4  # m that a probe that rubs or sticks moves at a time
MOST_PATH_STEPS = 20  # per prediction: a probe that comes from far need not crawl
CLOSE_NS = 50_000  # a step of time shorter than that is not made for when a load begins to pull
LEVER = 0.02  # m, about the size of a probe's face
LONGER = 1.3  # than the one before, a step of a body that relaxes at rest: its stress fades ever more slowly
MOST_FADING_STEPS = 8  # per gap: the first is a twentieth of it, and what fades sooner is over at its end

PoseAt = Callable[[float], Array | None]  # stamp ns -> T_phantom_probe (4, 4)


class Passing(Protocol):
    """A body that passes the instants, and says of the next step how it is to be, each time as it is when asked."""

    def pace(self) -> float:
        """Return how long (s) a step with inertia may be."""
        ...

    def pace_at_rest(self) -> float:
        """Return how long (s) a step without inertia may be; inf: as long as one likes."""
        ...

    def swings_for(self) -> float:
        """Return how long (s) a swing lasts."""
        ...


@dataclass(frozen=True)
class Instant:
    """A moment to be passed, for any physics: ``dt`` s since the one before (inf: relaxed), ``active``: weight and
    loads act, ``with_probe``: the probe is there, ``still``: without inertia, ``held``: the body is held where it
    rested (and with ``dt`` inf for as long as the physics says)."""

    stamp_ns: int
    dt: float
    active: bool
    with_probe: bool = True
    still: bool = True
    held: bool = False


@dataclass(frozen=True)
class Timeline:
    """``start_ns``: of the recording, from which the release counts; ``clock_ns``: where the drifts' time is 0;
    ``dynamic``: steps are short enough for inertia (but only over the last while before a stamp, as long as a swing
    lasts); ``hung``: the body hung under its loads before it was held, and has not forgotten it; ``delays`` s after the
    release at which loads begin to pull, of every physics that passes the same instants: a step of time ends there, as
    what it does in the middle of one is not known as exactly."""

    start_ns: int
    clock_ns: int
    release: float
    dynamic: bool = False
    hung: bool = False
    delays: tuple[float, ...] = ()

    def is_hanging(self, instant: Instant) -> bool:
        """Tell whether the body hangs there as it did before it was lifted and held."""
        return self.hung and instant.active and bool(np.isinf(instant.dt))

    @property
    def release_ns(self) -> int:
        """The stamp at which the body is let go."""
        return self.start_ns + round(1e9 * self.release)

    @property
    def acts_from_ns(self) -> float:
        """The stamp from which weight and loads act. A release of 0 means throughout (-inf): also at the moment, before
        the recording's start, of a pose whose stamp is late."""
        return -np.inf if self.release <= 0.0 else self.release_ns

    def acts(self, stamp_ns: int) -> bool:
        """Tell whether weight and loads act at a stamp."""
        return stamp_ns >= self.acts_from_ns

    @property
    def _onsets(self) -> list[int]:
        """The stamps, rising, at which loads begin to pull after the rest does."""
        if self.release <= 0.0:
            return []
        return sorted({self.release_ns + round(1e9 * delay) for delay in self.delays if delay > 0.0})

    def instants(self, now_ns: int | None, stamp_ns: int, body: Passing) -> Iterator[Instant]:
        """Yield what the ``body`` passes from ``now_ns`` (None: from nothing) to ``stamp_ns``: each must be passed
        before the next is asked for. A stamp that goes back takes no time."""
        release_ns = self.release_ns
        if self.hung and (now_ns is None or not self.acts(now_ns)):
            now_ns = yield from self._held(now_ns, stamp_ns)
            if not self.acts(stamp_ns):
                return
        if now_ns is None:
            now_ns = min(self.start_ns, stamp_ns)
            yield Instant(now_ns, np.inf, self.acts(now_ns), with_probe=False)
            if self.dynamic:  # the probe may be there from the start: put in place without a blow
                yield Instant(now_ns, 0.0, self.acts(now_ns))
        if self.acts(stamp_ns) and not self.acts(now_ns):
            yield from _fading(now_ns, release_ns, body, active=False)  # it finds the body at rest
            if not self.dynamic:
                yield Instant(release_ns, 0.0, active=True)
            now_ns = release_ns
        yield from self._steps(now_ns, stamp_ns, body, active=self.acts(stamp_ns))

    def _held(self, now_ns: int | None, stamp_ns: int) -> Generator[Instant, None, int]:
        """Yield how the body rests, hangs, is lifted and held as it rested, to the release or the ``stamp_ns`` before;
        return when that is."""
        if now_ns is None:
            now_ns = min(self.start_ns, stamp_ns)
            yield Instant(now_ns, np.inf, active=False, with_probe=False)
            yield Instant(now_ns, np.inf, active=True, with_probe=False)
            yield Instant(now_ns, 0.0, active=False, with_probe=False, held=True)
            yield Instant(now_ns, np.inf, active=False, with_probe=False, held=True)
        then_ns = min(stamp_ns, self.release_ns)
        yield Instant(then_ns, 1e-9 * max(then_ns - now_ns, 0), active=False, held=True)
        if self.acts(stamp_ns) and not self.dynamic:
            yield Instant(then_ns, 0.0, active=True)
        return then_ns

    def _steps(self, now_ns: int, stamp_ns: int, body: Passing, *, active: bool) -> Iterator[Instant]:
        if not self.dynamic:
            yield from self._at_rest(now_ns, stamp_ns, body, active=active)
            return
        gap = 1e-9 * (stamp_ns - now_ns)
        if gap > MEMORY and gap > (lasts := max(MEMORY, body.swings_for())):
            follow_ns = stamp_ns - round(1e9 * lasts)
            yield from self._at_rest(now_ns, follow_ns, body, active=active)
            now_ns = follow_ns
        while now_ns < stamp_ns:
            ahead = [o for o in self._onsets if now_ns + CLOSE_NS < o < stamp_ns - CLOSE_NS]
            left = min(ahead, default=stamp_ns) - now_ns
            step = round(left / np.ceil(1e-9 * left / body.pace()))
            now_ns += step
            yield Instant(now_ns, 1e-9 * step, active, still=False)

    def _at_rest(self, now_ns: int, stamp_ns: int, body: Passing, *, active: bool) -> Iterator[Instant]:
        """Yield steps of a body without inertia to ``stamp_ns``, cut where loads begin to pull: they do so at once, as
        at the release, while a step knows only what changes evenly from its beginning to its end."""
        for onset in self._onsets:
            if not now_ns <= onset <= stamp_ns:
                continue
            if now_ns < onset - 1:  # a nanosecond on either side: the delays themselves are not round
                yield from _fading(now_ns, onset - 1, body, active=active)
            now_ns = min(onset + 1, stamp_ns)
            yield Instant(now_ns, 0.0, active)
        yield from _fading(now_ns, stamp_ns, body, active=active)

    def in_path_steps(
        self,
        instants: Iterable[Instant],
        physics: Physics,
        pose_at: PoseAt | None,
        longest: float | None = LONGEST_PATH_STEP,
    ) -> Iterator[Instant]:
        """Cut the probe's path into steps, the ``longest`` in m (None: not at all), where it matters how the surface
        came to rub on the probe or to stick to it."""
        probe = physics.probe
        if longest is None or pose_at is None or probe is None or not memory_of(physics).rubs:
            yield from instants
            return
        for instant in instants:
            passed_ns = 0 if np.isinf(instant.dt) else round(1e9 * instant.dt)
            if not (instant.with_probe and passed_ns):
                yield instant
                continue
            late = 1e9 * probe.time_offset
            start, end = (pose_at(instant.stamp_ns + late - back) for back in (passed_ns, 0))
            stamps = np.linspace(instant.stamp_ns - passed_ns, instant.stamp_ns, _steps_of(start, end, longest) + 1)
            yield from (
                replace(instant, stamp_ns=int(b), dt=1e-9 * int(b - a))
                for a, b in pairwise(stamps.round().astype(np.int64))
            )

    def moment(self, physics: Physics, instant: Instant, pose_at: PoseAt | None) -> Moment:
        """Return the instant as one physics has it; its probe is displaced and delayed as the physics says. Until the
        release the body is held as it was scanned."""
        T = probe_pose(physics.probe, pose_at, instant.stamp_ns) if instant.with_probe else None
        gravity = physics.gravity if instant.active else physics.scan_fraction * physics.scan_gravity
        seconds = 1e-9 * (instant.stamp_ns - self.clock_ns)
        hangs = instant.active and np.isinf(instant.dt)
        acting = 1e-9 * (instant.stamp_ns - self.release_ns) if self.release > 0.0 and not hangs else np.inf
        dt = physics.held_for if instant.held and np.isinf(instant.dt) else instant.dt
        return Moment(seconds, dt, gravity, float(instant.active), T, instant.still, acting, instant.held)


def probe_pose(probe: Probe | None, pose_at: PoseAt | None, stamp_ns: int) -> Array | None:
    """Return where (4, 4) the probe is at a stamp: its recorded pose, late and displaced as the probe says; None
    without a probe or a pose."""
    if probe is None or pose_at is None:
        return None
    T = pose_at(stamp_ns + 1e9 * probe.time_offset)
    if T is None:
        return None
    T = T.copy()
    T[:3, 3] += T[:3, :3] @ probe.offset
    return T


def _fading(now_ns: int, stamp_ns: int, body: Passing, *, active: bool) -> Iterator[Instant]:
    """Yield steps without inertia from ``now_ns`` to ``stamp_ns``, each longer than the one before, of which the first
    is about as long as the body allows: its stress does not change evenly over a long one."""
    gap = 1e-9 * max(stamp_ns - now_ns, 0)
    first, n = body.pace_at_rest(), 1
    while n < MOST_FADING_STEPS and first * (LONGER**n - 1.0) / (LONGER - 1.0) < gap:
        n += 1
    shares = (LONGER ** np.arange(1, n) - 1.0) / (LONGER**n - 1.0)
    ends = [*(now_ns + round(1e9 * gap * share) for share in shares), stamp_ns]
    for before, end in pairwise([now_ns, *ends]):
        yield Instant(end, 1e-9 * max(end - before, 0), active)


def _steps_of(start: Array | None, end: Array | None, longest: float) -> int:
    """Return how many steps, the ``longest`` in m, the probe makes from one pose (4, 4) to another."""
    if start is None or end is None:
        return 1
    face = LEVER * np.eye(3)  # points of the probe that also tell a turn
    path = np.linalg.norm(end[:3, :3] @ face - start[:3, :3] @ face + (end - start)[:3, 3:], axis=0).max()
    return int(np.clip(np.ceil(path / longest), 1, MOST_PATH_STEPS))
