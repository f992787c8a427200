"""Trajectories of the robot with the probe: presses, holds, strokes and retreats, as smooth moves between key poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.types import Array

CLEARANCE = 0.004  # m above the surface between presses
# m from where a move begins: of a friction of 0.017 under 0.2 N, on a soft body, drag has turned after 0.3 mm
TURNS = 0.05e-3 * 2.0 ** np.arange(6)

ALOFT = 21  # poses on a move between two presses


def turned(tilt: Sequence[float] | Array) -> Array:
    """Return the probe's rotation (3, 3) in ``phantom``: it looks down save for the ``tilt`` (2,) rad."""
    turn: Array = Rotation.from_rotvec([tilt[0], tilt[1], 0.0]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return turn


@dataclass(frozen=True)
class Press:
    """One press: above ``at`` (x, y) m, ``depth`` m below the highest point there (or, where a wide or tilted probe
    touches earlier, below where it first touches), ``hold`` s, then an optional ``stroke`` (dx, dy) m sideways at
    depth, then back up. ``speed`` and ``retreat_speed`` m/s; ``tilt`` (about x, about y) rad."""

    at: tuple[float, float]
    depth: float
    hold: float = 1.0
    stroke: tuple[float, float] = (0.0, 0.0)
    speed: float = 0.012
    retreat_speed: float = 0.03
    tilt: tuple[float, float] = (0.0, 0.0)
    pause: float = 1.0  # s after the retreat

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Press:
        options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**options)


@dataclass(frozen=True)
class ProbePath:
    """Key poses: ``times`` (k,) s, ``positions`` (k, 3) m, ``tilts`` (k, 2) rad; min-jerk moves in between.

    ``contact``: height m of the origin from which on it may touch, where that is above the body; else None.
    """

    times: Array
    positions: Array
    tilts: Array
    contact: float | None = None

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    def __call__(self, t: float) -> Array:
        """T_phantom_probe (4, 4) at time t s; the probe looks down (its z is the phantom's -z) save for the tilt."""
        k = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2))
        span = self.times[k + 1] - self.times[k]
        s = float(np.clip((t - self.times[k]) / span if span > 0 else 1.0, 0.0, 1.0))
        s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        return self._between(k, s)

    def _between(self, k: int, s: float) -> Array:
        """Return T_phantom_probe (4, 4) at the fraction ``s`` of the way from key pose ``k`` to the next."""
        T = np.eye(4)
        T[:3, :3] = turned((1 - s) * self.tilts[k] + s * self.tilts[k + 1])
        T[:3, 3] = (1 - s) * self.positions[k] + s * self.positions[k + 1]
        return T

    def aloft(self) -> list[Array]:
        """Return poses (4, 4) on all moves and stays at the height between presses."""
        high = self.positions[:, 2] == self.positions[:, 2].max()
        poses = []
        for k in np.flatnonzero(high[:-1] & high[1:]).tolist():
            still = np.array_equal(self.positions[k], self.positions[k + 1]) and np.array_equal(*self.tilts[k : k + 2])
            poses += [self._between(k, s) for s in ([0.0] if still else np.linspace(0.0, 1.0, ALOFT))]
        return poses

    def key_times(self, longest: float, low: float, every: float | None, *, rubs: bool = False) -> Array:
        """Times at which to solve: the ends of all moves, every ``longest`` m of path below the height ``low`` m, and,
        if the body has a memory or a clock, ``every`` s (finer after each change of speed). Where the probe ``rubs``,
        more finely at the beginning of each move below that height: within a part of a millimetre the drag turns."""
        out = [self.times]
        for k in range(len(self.times) - 1):
            a, b = self.times[k], self.times[k + 1]
            fine = np.linspace(a, b, 400)
            place = np.array([self(t)[:3, 3] for t in fine])
            step = np.linalg.norm(np.diff(place, axis=0), axis=1) * (place[1:, 2] < low)
            path = np.concatenate([[0.0], np.cumsum(step)])
            n = int(np.ceil(path[-1] / longest))
            if n > 1:
                out.append(np.interp(np.arange(1, n) / n * path[-1], path, fine))
            if rubs and place[0, 2] < low:
                out.append(np.interp(TURNS[min(path[-1], longest) > TURNS], path, fine))
            if every is not None:
                n = max(1, int(np.ceil((b - a) / every)))
                out.append(a + (b - a) * (np.arange(1, n) / n) ** 1.6)
        times = np.unique(np.round(np.concatenate(out), 6))
        kept: Array = times[np.concatenate([[True], np.diff(times) > 1e-4])]
        return kept


def presses(plan: Sequence[Press], heights: Sequence[float], start: float = 1.0, top: float | None = None) -> ProbePath:
    """The moves of a list of presses; ``heights`` (n,) m: the surface's highest point under the probe at each; ``top``
    m: the height between them, if it is not the usual."""
    top = max(heights) + CLEARANCE if top is None else top
    t = 0.0
    keys: list[tuple[float, Array, tuple[float, float]]] = []

    def go(seconds: float, x: float, y: float, z: float, tilt: tuple[float, float]) -> None:
        nonlocal t
        t += seconds
        keys.append((t, np.array([x, y, z]), tilt))

    first = plan[0]
    go(0.0, *first.at, top, first.tilt)
    go(start, *first.at, top, first.tilt)
    for k, press in enumerate(plan):
        if k:
            before = plan[k - 1]
            away = float(np.hypot(press.at[0] - before.at[0], press.at[1] - before.at[1]))
            go(max(0.4, away / 0.05), *press.at, top, press.tilt)
        floor = heights[k] - press.depth
        go((top - floor) / press.speed * 1.5, *press.at, floor, press.tilt)
        go(press.hold, *press.at, floor, press.tilt)
        end = (press.at[0] + press.stroke[0], press.at[1] + press.stroke[1])
        length = float(np.hypot(*press.stroke))
        if length > 0.0:
            go(length / press.speed * 1.5, *end, floor, press.tilt)
            go(0.5 * press.hold, *end, floor, press.tilt)
        go((top - floor) / press.retreat_speed * 1.5, *end, top, press.tilt)
        go(press.pause, *end, top, press.tilt)
    return ProbePath(np.array([k[0] for k in keys]), np.stack([k[1] for k in keys]), np.array([k[2] for k in keys]))
