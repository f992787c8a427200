"""Dry friction where a load hangs: of a hook that the body turns in, or of a string along an edge.

It acts as a force along the load that opposes the motion u of the loaded place with up to F, and gives by some d before
it slides (Dahl 1968),

    f = F z,    dz/du = (1 - z sgn du) / d,

so that in a step without a turn f = F (s + (z_n - s) exp(-|u - u_n| / d)), s = sgn(u - u_n), with the potential
F (|u - u_n| + (s z_n - 1) d (1 - exp(-|u - u_n| / d))), whose tangent is never negative. On a stiffness k a swing much
larger than d loses 4 F / k in each period, however large it is; one much smaller meets a spring of F / d, and loses
next to nothing. F stands for what rubs inside the joint, by the lever that it has there: it is no coefficient of
friction, and another hook has another one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.loads import shares
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.physics.record import DeadLoad
from livedeform.fem_node.solve.assembly import Pattern, System


class _Slid(NamedTuple):
    """The place of the load along itself, m, and which share of the friction acts there, -1 to 1."""

    u: float = 0.0
    z: float = 0.0


class RubbingLoad(PlainItem):
    """The friction of one load, from when it acts; a body that has relaxed for ever has none."""

    def __init__(self, space: Space, load: DeadLoad) -> None:
        force = np.asarray(load.force, float)
        along = np.outer(shares(space, load), force / np.linalg.norm(force)).ravel()
        self._dofs: NDArray[np.int64] = np.flatnonzero(along)
        self._along: Array = along[self._dofs]
        self._limit, self._give, self._delay = load.friction, load.give, load.delay
        self._state, self._acts = _Slid(), 0.0

    def couplings(self) -> list[NDArray[np.int64]]:
        """Return the dofs of the loaded place, which move together."""
        return [self._dofs[None]]

    def attach(self, pattern: Pattern) -> None:
        self._positions = pattern.positions(self._dofs[None])

    def prepare(self, moment: Moment) -> None:
        self._acts = moment.begun(self._delay) * self._limit if 0.0 < moment.dt < np.inf else 0.0

    def _at(self, x: Array) -> tuple[float, float, float]:
        """Return how far (m) the place has gone along the load, the share that acts there, and its slope (1/m)."""
        gone = float(self._along @ x[self._dofs]) - self._state.u
        s, left = np.sign(gone), np.exp(-abs(gone) / self._give)
        return gone, float(s + (self._state.z - s) * left), float((1.0 - s * self._state.z) * left / self._give)

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        if not self._acts:
            return 0.0
        gone, z, slope = self._at(x)
        system.r[self._dofs] += self._acts * z * self._along
        if tangent:
            system.add_blocks(self._positions, self._acts * slope * np.outer(self._along, self._along)[None])
        left = 1.0 - np.exp(-abs(gone) / self._give)
        return self._acts * float(abs(gone) + (np.sign(gone) * self._state.z - 1.0) * self._give * left)

    def commit(self, x: Array) -> None:
        z = self._at(x)[1] if self._acts else 0.0
        self._state = _Slid(float(self._along @ x[self._dofs]), z)

    def save(self) -> _Slid:
        return self._state

    def restore(self, state: _Slid) -> None:
        self._state = state
