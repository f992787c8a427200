"""Inertia by Newmark's rule with a little numerical damping of what the steps do not resolve (Hilber, Hughes & Taylor
1977), and Rayleigh damping C = alpha M + beta K (Hughes 2000, ch. 9).

    x = x_n + dt v_n + dt^2 ((1/2 - b) a_n + b a),  v = v_n + dt ((1 - c) a_n + c a),  b = (1 + s)^2 / 4,  c = 1/2 + s
    F/(1 - s) + R + s/(1 - s) R_n = 0,   F = M (a + alpha v),   R = g(x) + beta dg/dt - f,  s = ``DAMPING``

R_n is known from the step before, so the other forces need not know of this. With s = 0 it is the average
acceleration, in which stiff modes that the steps do not resolve (a nearly incompressible body has many) ring for ever,
and keep the steps short. A motion that starts from rest starts with a load that has just changed, so its first step has
a_n = a. The stiffness part of the damping needs no matrix: K v is the rate of the inner force g (`Continuum`).

Steps suit the motion: one step is wrong by e = dt^2/12 |a - a_n| (Zienkiewicz & Xie 1991), and the next is as long as
keeps that at ``STEP_ERROR`` of the swing A = v^2 / a, v and a the highest of the last swing, all as root mean squares
over the mass: a node that touches or lets go is kicked, which moves little. A step by the angle w dt makes a period
longer by (w dt)^2/12 and adds the damping ratio s (w dt)^3/2, and of a swing e/A = (w dt)^3/12: so the period is 0.2 %
too long at most, and the damping ratio 1e-4 too high, while the swing is large. What is smaller than the markers' noise
is followed in longer steps, and a body at rest in the longest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from livedeform.common.types import Array
from livedeform.fem_node.element import quadrature
from livedeform.fem_node.element.element import Space, shape_values
from livedeform.fem_node.items.loads import HungMass
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.physics.record import Inertia
from livedeform.fem_node.solve.assembly import Pattern, System

FIRST_STEP = 0.002  # s, after a blow; a soft phantom's first mode is near 9 Hz
SHORTEST_STEP, LONGEST_STEP = 0.001, 0.04  # s
STEP_ERROR = 1.5e-4  # of a swing that a step may be wrong by: 50 steps make a period
LEAST_ERROR, MOST_ERROR = 1e-7, 1e-5  # m that it may be wrong by at least and at most
SAME_STEP = 0.85, 1.25  # of a step, within which the next one is as long: the factor of the tangent serves on
FADING = 0.97  # per step, of what is remembered of the last swing: a quarter of a period is ten steps
DAMPING = 0.05  # 0 to 1/3; what is not resolved at all shrinks to 0.90 per step
SLIP = 0.55  # the rates of the inner force: 1/2 is the mean of both ends, 1 the later one
MEMORY = 4.0  # s of motion before a moment that are followed at least: more where a swing lasts longer (`swinging`)


def moves(inertia: Inertia | None, moment: Moment) -> bool:
    """Return whether the step to ``moment`` is a dynamic one."""
    return inertia is not None and not moment.still and 0.0 < moment.dt < np.inf


@dataclass(frozen=True)
class _State:
    """Displacements x and velocities v (n,), accelerations a (n,) or None at rest, R (n,) of all other forces, the
    ``step`` s that suits the motion, of the last swing the highest speed m/s and acceleration m/s2 in the mean, and the
    ``jerk`` (n,) m/s3 of the last step."""

    x: Array
    v: Array
    a: Array | None = None
    R: Array | None = None
    step: float = FIRST_STEP
    speed: float = 0.0
    acceleration: float = 0.0
    jerk: Array | None = None

    def moved_to(self, x: Array, v: Array, a: Array, R: Array, dt: float, size: Callable[[Array], float]) -> _State:
        """Return the state after a step of ``dt`` s, with the step that suits the motion now; ``size`` measures a field
        (n,) of the body."""
        speed, acceleration = max(FADING * self.speed, size(v)), max(FADING * self.acceleration, size(a))
        step = self.step
        if self.a is not None:
            wrong = dt**2 / 12.0 * size(a - self.a)
            allowed = np.clip(STEP_ERROR * speed**2 / max(acceleration, 1e-12), LEAST_ERROR, MOST_ERROR)
            change = float(np.clip((allowed / max(wrong, 1e-12)) ** (1.0 / 3.0), 0.5, 1.3))
            if SAME_STEP[0] < change < SAME_STEP[1]:
                change = 1.0
            step = float(np.clip(dt * change, SHORTEST_STEP, LONGEST_STEP))
        jerk = None if self.a is None else (a - self.a) / dt
        return _State(x, v, a, R, step, speed, acceleration, jerk)


class Inertial(PlainItem):
    """M a + alpha M v. ``weights`` (e, q) m3 of the unloaded body; ``hung``: what will hang at its surface."""

    def __init__(
        self, space: Space, density: float, weights: Array, inertia: Inertia, hung: Sequence[HungMass] = ()
    ) -> None:
        self._space, self._inertia, self._hung = space, inertia, hung
        barycentric, w = quadrature.tetrahedron(4)
        N = shape_values(barycentric, quadratic=space.quadratic)
        reference = np.einsum("q,qa,qb->ab", w, N, N)
        self._mass = density * weights.sum(axis=1)[:, None, None] * reference  # (e, a, a)
        self._body = self._sum_of(space.cells, self._mass)  # M of one direction (nodes, nodes)
        self._hung_matrices = [self._sum_of(h.facets, h.blocks) for h in hung]
        self._carried = [True] * len(hung)
        self._matrix = self._assembled()
        self._total = float(self._matrix.sum())
        n = 3 * space.n_nodes
        self._n = n
        self._state = _State(np.zeros(n), np.zeros(n))
        self._dt, self._moves = np.inf, False

    def attach(self, pattern: Pattern) -> None:
        a = self._space.cells.shape[1]
        dofs = (3 * self._space.cells[:, :, None] + np.arange(3)).reshape(-1, 3 * a)
        self._positions = pattern.positions(dofs)
        self._blocks = np.einsum("eab,ij->eaibj", self._mass, np.eye(3)).reshape(-1, 3 * a, 3 * a)
        self._hung_blocks = []
        for hung in self._hung:
            b = hung.facets.shape[1]
            dofs = (3 * hung.facets[:, :, None] + np.arange(3)).reshape(-1, 3 * b)
            blocks = np.einsum("kab,ij->kaibj", hung.blocks, np.eye(3)).reshape(-1, 3 * b, 3 * b)
            self._hung_blocks.append((pattern.positions(dofs), blocks))

    def prepare(self, moment: Moment) -> None:
        self._dt, self._moves = moment.dt, moves(self._inertia, moment)
        carried = [moment.begun(hung.delay) > 0.0 for hung in self._hung]
        if carried != self._carried:
            self._carried = carried
            self._matrix = self._assembled()

    def _assembled(self) -> csr_array:
        """Return M of one direction (nodes, nodes), with what hangs there now."""
        matrix = self._body
        for hung in compress(self._hung_matrices, self._carried):
            matrix = csr_array(matrix + hung)
        return matrix

    def _sum_of(self, nodes: NDArray[np.int64], blocks: Array) -> csr_array:
        """Return the sum of ``blocks`` (k, a, a) at their ``nodes`` (k, a)."""
        n, a = self._space.n_nodes, nodes.shape[1]
        rows, columns = np.repeat(nodes, a, axis=1).ravel(), np.tile(nodes, (1, a)).ravel()
        return csr_array((blocks.ravel(), (rows, columns)), shape=(n, n))

    def times_mass(self, v: Array) -> Array:
        """Return M v (n,)."""
        out: Array = self._matrix @ v.reshape(-1, 3)
        return out.ravel()

    def _rates(self, x: Array) -> tuple[Array, Array]:
        past, dt = self._state, self._dt
        dx = x[: self._n] - past.x - dt * past.v
        if past.a is None:
            a = 2.0 * dx / dt**2
            return past.v + dt * a, a
        b, c = 0.25 * (1.0 + DAMPING) ** 2, 0.5 + DAMPING
        a = (dx / dt**2 - (0.5 - b) * past.a) / b
        return past.v + dt * ((1.0 - c) * past.a + c * a), a

    def _slope(self) -> tuple[float, float]:
        """Return d (a + alpha v) / dx, and the share 1/(1 - s) of F."""
        alpha, dt = self._inertia.rayleigh_alpha, self._dt
        if self._state.a is None:
            return 2.0 / dt**2 + 2.0 * alpha / dt, 1.0
        b, c = 0.25 * (1.0 + DAMPING) ** 2, 0.5 + DAMPING
        return (1.0 / dt**2 + alpha * c / dt) / b, 1.0 / (1.0 - DAMPING)

    def _past(self) -> Array | float:
        """Return s/(1 - s) R_n (n,)."""
        R = self._state.R
        return 0.0 if self._state.a is None or R is None else DAMPING / (1.0 - DAMPING) * R

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        if not self._moves:
            return 0.0
        v, a = self._rates(x)
        rate = a + self._inertia.rayleigh_alpha * v
        force, (slope, share), past = self.times_mass(rate), self._slope(), self._past()
        system.r[: self._n] += share * force + past
        if tangent:
            system.add_blocks(self._positions, share * slope * self._blocks)
            for positions, blocks in compress(self._hung_blocks, self._carried):
                system.add_blocks(positions, share * slope * blocks)
        # quadratic in x: 1/2 F . M^-1 F / slope, written without M^-1
        return 0.5 * share / slope * float(rate @ force) + float(np.sum(past * x[: self._n]))

    def commit(self, x: Array) -> None:
        if not self._moves:
            self._state = _State(x[: self._n].copy(), np.zeros(self._n))
            return
        v, a = self._rates(x)
        share = self._slope()[1]
        R = -share * self.times_mass(a + self._inertia.rayleigh_alpha * v) - self._past()
        self._state = self._state.moved_to(x[: self._n].copy(), v, a, np.asarray(R), self._dt, self._size)

    def _size(self, field: Array) -> float:
        """Return the length of a ``field``'s (n,) vectors, the root mean square over the mass."""
        return float(np.sqrt(max(float(field @ self.times_mass(field)), 0.0) / self._total))

    @property
    def step(self) -> float:
        """Return how long (s) the next step may be."""
        return self._state.step

    def ahead(self, dt: float) -> Array:
        """Return displacements (n,) that the motion leads to in ``dt`` s."""
        s = self._state
        if s.a is None:
            return s.x + dt * s.v
        change = 0.0 if s.jerk is None else 0.25 * (1.0 + DAMPING) ** 2 * dt * s.jerk
        return np.asarray(s.x + dt * s.v + dt**2 * (0.5 * s.a + change))

    def save(self) -> Any:
        return self._state

    def restore(self, state: Any) -> None:
        self._state = state
