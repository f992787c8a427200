"""A part of the base is free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import ConvexHull

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.needs import is_bonded
from livedeform.fem_node.physics.record import Physics, RegionTest


def _starts(around: Surroundings) -> list[Start]:
    """Return directions all around."""
    return [{"direction": float(angle)} for angle in np.arange(-3, 3) * np.pi / 3]


INFO = EffectInfo(
    name="base_debonding",
    acts_on="support",
    summary="a part of the base is free",
    equation="the fixed support holds only where (X - X_edge) . e < 0: the strip towards e = (cos direction, "
    "sin direction, 0) that has this fraction of the base's area is free (of a clamp on a wall, e lies in the wall)",
    source="definition",
    parameters=(
        Parameter("direction", "rad", start=0.0, lower=-6.3, upper=6.3, sigma=3.0),
        Parameter(
            "fraction", "1", start=0.15, lower=0.0, upper=0.9, sigma=0.3, neutral=0.0, step=0.05, kick=0.12, grows=1.5
        ),
    ),
    shown_by="an off-centre press, markers near the foot",
    confused_with=("base_slip", "gravity_tilt"),
    possible=is_bonded,
    starts=_starts,
    tangent=False,
    order=-1,  # a bond comes free before what is left of it slips: springs are no bond any more
)


@dataclass(frozen=True)
class StillBonded:
    """The part of ``region`` that is still held."""

    region: RegionTest
    direction: float
    fraction: float

    def __call__(self, points: Array) -> NDArray[np.bool_]:
        inside = np.asarray(self.region(points), bool)
        if self.fraction <= 0.0 or inside.sum() < 4:
            return inside
        return inside & (self._inside_of_edge(points, points[inside]) > 0.0)

    def ramp(self, base: Array, width: float) -> float:
        """Return over how many m the bond fades on a ``base`` (m, 3): ``width``, but no farther beyond the edge than
        the base goes, so that the less of it is free the less it fades."""
        beyond = -float(self._inside_of_edge(base, base).min()) if self.fraction > 0.0 else 0.0
        return min(width, 2.0 * max(beyond, 0.0))

    def share(self, points: Array, base: Array, width: float) -> Array:
        """Return how far (n,) from 0, free, to 1, held, the bond is at ``points`` (n, 3) of a ``base`` (m, 3): a ramp
        ``width`` m wide over the edge."""
        return np.clip(self._inside_of_edge(points, base) / width + 0.5, 0.0, 1.0)

    def _inside_of_edge(self, points: Array, base: Array) -> Array:
        """Return distance (n,) m of points from the edge, towards where the bond holds."""
        e = np.array([np.cos(self.direction), np.sin(self.direction)])
        plane = np.sort(np.argsort(-np.ptp(base, axis=0), kind="stable")[:2])  # x and y of a level base
        return np.asarray(_edge(base[:, plane], e, self.fraction) - points[:, plane] @ e)


def _edge(base: Array, e: Array, fraction: float) -> float:
    """Return the place along ``e`` beyond which ``fraction`` of the area of the base's convex hull lies."""
    hull = base[ConvexHull(base).vertices]
    along, across = hull @ e, hull @ np.array([-e[1], e[0]])
    total = _area(along, across)

    def beyond(c: float) -> float:
        return _area(*_clip(along, across, c)) / total - fraction

    return float(brentq(beyond, along.min(), along.max()))


def _clip(x: Array, y: Array, c: float) -> tuple[Array, Array]:
    """Return the polygon's part with x >= c (Sutherland & Hodgman 1974)."""
    out: list[tuple[float, float]] = []
    for i in range(len(x)):
        j = (i + 1) % len(x)
        if x[i] >= c:
            out.append((x[i], y[i]))
        if (x[i] >= c) != (x[j] >= c):
            s = (c - x[i]) / (x[j] - x[i])
            out.append((c, y[i] + s * (y[j] - y[i])))
    return np.array([p[0] for p in out]), np.array([p[1] for p in out])


def _area(x: Array, y: Array) -> float:
    if len(x) < 3:
        return 0.0
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics whose fixed supports have lost a strip."""
    direction, fraction = float(values["direction"]), float(values["fraction"])
    if fraction <= 0.0:
        return physics
    supports = tuple(
        replace(s, region=StillBonded(s.region, direction, fraction)) if s.type == "fixed" else s
        for s in physics.supports
    )
    return replace(physics, supports=supports)
