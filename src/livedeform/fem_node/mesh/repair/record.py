"""The record of what was done to a surface before it was meshed, and how far that moved it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from livedeform.common.types import Array


@dataclass(frozen=True)
class Repair:
    """``what`` was done; ``moved_max`` and ``moved_rms`` m: how far the surface moved (rms over what moved at all), and
    ``place`` (x, y, z) m: where it moved most, None for a repair that moves nothing."""

    what: str
    moved_max: float = 0.0
    moved_rms: float = 0.0
    place: tuple[float, float, float] | None = None

    def __str__(self) -> str:
        if self.place is None:
            return self.what
        place = ", ".join(f"{1e3 * c:.1f}" for c in self.place)
        moved = f"{1e3 * self.moved_max:.3f} mm ({1e3 * self.moved_rms:.3f} mm rms)"
        return f"{self.what}: the surface moved by up to {moved}, most at ({place}) mm"


def moving(what: str, points: Array, distances: Array) -> Repair:
    """The repair that moved ``points`` (n, 3) m of the surface by ``distances`` (n,) m."""
    most, moved = int(np.argmax(distances)), distances[distances > 0.0]
    rms = float(np.sqrt(np.mean(moved**2))) if len(moved) else 0.0
    x, y, z = (float(c) for c in points[most])
    return Repair(what, float(distances[most]), rms, (x, y, z))


def to_json(repairs: Sequence[Repair]) -> str:
    """The record as it lies beside a kept mesh."""
    return json.dumps([asdict(repair) for repair in repairs])


def from_json(text: str) -> tuple[Repair, ...]:
    """The record that `to_json` wrote; ``ValueError``, ``TypeError`` or ``KeyError`` if it is none."""
    rows = json.loads(text)
    return tuple(Repair(**{**row, "place": tuple(row["place"]) if row["place"] else None}) for row in rows)
