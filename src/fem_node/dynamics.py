"""Inertia by Newmark's average acceleration, with Rayleigh damping C = alpha M + beta K (Newmark 1959; Hughes 2000,
ch. 9).

    v = 2 (x - x_n)/dt - v_n,    a = 4 (x - x_n)/dt^2 - 4 v_n/dt - a_n,    M a + alpha M v + beta dg/dt + g(x) = f

A motion that starts from rest starts with a load that has just changed, so its first step has a_n = a: a = 2 (x -
x_n)/dt^2. The stiffness part needs no matrix: K v is the rate of the inner force g, which follows the same rule as v
(`Continuum`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fem_node import quadrature
from fem_node.assembly import Pattern, System
from fem_node.element import Space, shape_values
from fem_node.items import Moment, PlainItem
from fem_node.physics import Inertia
from livedeform_common.types import Array

LONGEST_STEP = 0.005  # s; a soft phantom's first mode is near 9 Hz
MEMORY = 0.6  # s of motion before a moment that is followed; what was earlier has died out


def moves(inertia: Inertia | None, moment: Moment) -> bool:
    """Whether the step to ``moment`` is a dynamic one."""
    return inertia is not None and not moment.still and 0.0 < moment.dt < np.inf


class Inertial(PlainItem):
    """M a + alpha M v. ``weights`` (e, q) m3 of the unloaded body."""

    def __init__(self, space: Space, density: float, weights: Array, inertia: Inertia) -> None:
        self._space, self._inertia = space, inertia
        barycentric, w = quadrature.tetrahedron(4)
        N = shape_values(barycentric, quadratic=space.quadratic)
        reference = np.einsum("q,qa,qb->ab", w, N, N)
        self._mass = density * weights.sum(axis=1)[:, None, None] * reference  # (e, a, a)
        n = 3 * space.n_nodes
        self._n = n
        self._state: tuple[Array, Array, Array | None] = (np.zeros(n), np.zeros(n), None)  # x, v, a (None: at rest)
        self._dt, self._moves = np.inf, False

    def attach(self, pattern: Pattern) -> None:
        a = self._space.cells.shape[1]
        dofs = (3 * self._space.cells[:, :, None] + np.arange(3)).reshape(-1, 3 * a)
        self._positions = pattern.positions(dofs)
        self._blocks = np.einsum("eab,ij->eaibj", self._mass, np.eye(3)).reshape(-1, 3 * a, 3 * a)

    def prepare(self, moment: Moment) -> None:
        self._dt, self._moves = moment.dt, moves(self._inertia, moment)

    def _times_mass(self, v: Array) -> Array:
        """M v (n,)."""
        cells = self._space.cells
        forces = np.matmul(self._mass, v.reshape(-1, 3)[cells])
        out = np.empty((self._space.n_nodes, 3))
        for i in range(3):
            out[:, i] = np.bincount(cells.ravel(), forces[:, :, i].ravel(), minlength=self._space.n_nodes)
        return out.ravel()

    def _rates(self, x: Array) -> tuple[Array, Array]:
        x_n, v_n, a_n = self._state
        dx, dt = x[: self._n] - x_n, self._dt
        v = 2.0 * dx / dt - v_n
        return v, (v - v_n) / dt if a_n is None else 2.0 * (v - v_n) / dt - a_n

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        if not self._moves:
            return 0.0
        alpha, dt = self._inertia.rayleigh_alpha, self._dt
        v, a = self._rates(x)
        force = self._times_mass(a + alpha * v)
        system.r[: self._n] += force
        slope = (2.0 if self._state[2] is None else 4.0) / dt**2 + 2.0 * alpha / dt
        if tangent:
            system.add_blocks(self._positions, slope * self._blocks)
        # quadratic in x: 1/2 force . M^-1 force / slope, written without M^-1
        return 0.5 / slope * float((a + alpha * v) @ force)

    def commit(self, x: Array) -> None:
        v, a = self._rates(x) if self._moves else (np.zeros(self._n), None)
        self._state = (x[: self._n].copy(), v, a)

    def save(self) -> Any:
        return self._state

    def restore(self, state: Any) -> None:
        self._state = state
