"""Sensitivities under a probe that rubs: tangents at each step of its path, which know what slid and stuck before.

With K the body's tangent, r_p how a direction changes the out-of-balance force, w the surface under the probe, D its
tangent (`fem_node.contact.slope`: not symmetric) and h what the anchors, the probe's own move and its numbers add,

    K d + r_p + D w + h = 0.

K alone need not be stable (under a probe without friction a tall soft body sways), so even springs S under the probe
are part of the factor. What they do wrong is a small dense problem in the forces g at the surface, with its compliance
C under these springs (the direct differentiation of a path, Tortorelli & Michaleris 1994, condensed):

    d = d_free - (K + S)^-1 g,    [1 + (D - S) C] g = (D - S) w_free + h.

Where the support slips too, K + D and what that adds are one factor that is not symmetric, without springs.

Whole runs with the change and without are the same but for what lies between them: points that begin to stick, to slide
or to touch. Where that is most of the answer, as of a sideways move, two runs to either side differ by as much.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common import frames
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.slope import Anchors, Slope
from livedeform.fem_node.items.friction import FrictionSupport
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.path.direction import Direction, MomentOf
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.tangents import Followed, ItemResiduals, Tangents
from livedeform.fem_node.solve.assembly import Feedback
from livedeform.fem_node.solve.linear_solver import FactorisationError, make_condensing

# of the contact's penalty, tried until the body is stable: about as stiff as the body, so that C tells of both
SPRINGS = (0.01, 0.1, 1.0)
WITHIN_REACH = 0.003  # m from the probe: surface whose compliance comes with the factor
NEAR = 1e-9  # m, within which the body is where it was


@dataclass(frozen=True)
class _StepEnd:
    """The end of a step, from which the next one goes on: the solution ``x`` (n_dof,), its changes ``d`` (n_dof, p),
    the probe's ``shifts`` (p, 4, 4), and the ``anchors``."""

    x: Array
    d: Array
    shifts: Array
    anchors: Anchors


@dataclass(frozen=True)
class _EvenSprings:
    """The ``stiffness`` Pa/m of the springs in the factor, and the ``compliance`` (m, m) m/N of the ``dofs`` (m,)."""

    stiffness: float
    dofs: NDArray[np.int64]
    compliance: Array


class RubbingTangents(Tangents):
    """Tangents of a ``leader`` whose probe rubs or sticks, carried from step to step."""

    def __init__(self, leader: Mechanics, directions: Sequence[Direction], unloaded: Sequence[Array | None]) -> None:
        super().__init__(leader, directions, unloaded, corrections=1)
        self.passing = range(len(directions))
        contact, probe = leader.contact, leader.physics.probe
        if contact is None or probe is None:
            raise ValueError("there is no probe that rubs")
        self._contact = contact
        self._on_friction = any(isinstance(item, FrictionSupport) for item in leader.items)
        own = [d.physics.probe or probe for d in directions]
        self._numbers = np.array([[o.friction - probe.friction, o.adhesion - probe.adhesion] for o in own]).T
        self._numbers[~np.isfinite(self._numbers)] = 0.0
        p, n = len(directions), leader.space.n_dof
        self._last = self._there = _StepEnd(np.zeros(n), np.zeros((n, p)), np.zeros((p, 4, 4)), Anchors(contact, p))
        self._linear = make_condensing(
            leader.solver.pattern, n_negative=leader.space.n_pressure, threads=leader.threads
        )

    def step(self, x: Array, moment_of: MomentOf, *, there: bool, wanted: Collection[int]) -> None:
        """See `Sensitivities`: all are worked out at each step at which the probe touches the body."""
        contact, last = self._contact, self._before()
        moments = [moment_of(neighbour.direction.physics) for neighbour in self.neighbours]
        shifts = np.array([_shift(contact.T, moment.pose) for moment in moments])
        slope = None if contact.T is None else Slope.at(contact, x)
        if slope is None and not there and np.abs(x - last.x).max() < NEAR:
            self._last = replace(last, shifts=shifts)
            return
        followed = Followed(self.leader, x, there=there)
        d, pushed = self._answers(followed, moments, shifts, slope, last)
        for k, neighbour in enumerate(self.neighbours):
            neighbour.correct(d[:, k], None, last=True)
            neighbour.pushed(pushed[:, k])
            neighbour.commit(followed)
            d[:, k] = neighbour.delta
        if slope is not None:
            last.anchors.commit(slope, slope.moves(d, shifts))
        self._last = _StepEnd(x.copy(), d, shifts, last.anchors)
        if there:
            self._there = replace(self._last, anchors=last.anchors.copy())

    def slopes(self, wanted: Collection[int]) -> dict[Hashable, Array]:
        """See `Sensitivities`: none, since a body with a memory starts from its own past."""
        return {}

    def _before(self) -> _StepEnd:
        """Return the step that the leader has committed last: the last one, or that of the moment before where what
        came after has led nowhere."""
        x = self._contact.state.x
        if not np.array_equal(x, self._last.x[: len(x)]) and np.array_equal(x, self._there.x[: len(x)]):
            self._last = replace(self._there, anchors=self._there.anchors.copy())
        return self._last

    def _answers(
        self, followed: Followed, moments: Sequence[Moment], shifts: Array, slope: Slope | None, last: _StepEnd
    ) -> tuple[Array, Array]:
        """Return the changes (n_dof, p) m of the unknowns and (n_dof, p) N of the probe's part of the residual."""
        x, held = followed.x, self.leader.held()
        springs = None if self._on_friction else self._factorise(x, slope, held)
        residuals = ItemResiduals(self._system, x)
        block = np.empty((len(x), len(moments)), order="F")
        for k, (neighbour, moment) in enumerate(zip(self.neighbours, moments, strict=True)):
            neighbour.begin(followed, moment, None)
            block[:, k] = neighbour.first_load(residuals, held)
        block[held] = 0.0
        if springs is None:
            pulls = None if slope is None else self._pulls(slope, shifts, last)
            return self._whole_answers(x, block, slope, pulls)
        d, pushed = -self._linear.solve(block), np.zeros_like(block)
        if slope is None:
            return d, pushed
        dofs, g, pushed_there = _under_probe(slope, springs, d, self._pulls(slope, shifts, last))
        pushed[dofs] = pushed_there
        block[:] = 0.0
        block[dofs] = g
        block[held] = 0.0
        return d - self._linear.solve(block), pushed

    def _pulls(self, slope: Slope, shifts: Array, last: _StepEnd) -> Array:
        """Return what the probe's facets pull with (m, 3 b, p) N while the nodes keep still."""
        anchors = last.anchors.at(slope, last.d, last.shifts, shifts)
        return slope.pulls(anchors, shifts, self._numbers)

    def _whole_answers(self, x: Array, loads: Array, slope: Slope | None, pulls: Array | None) -> tuple[Array, Array]:
        """Return what `_answers` does where the support slips too: with all that is not symmetric in one factor, in
        double precision, which the stiff springs of such a support need."""
        held, contact, more = self.leader.held(), self._contact, self.leader.solver.feedback(x)
        self._tangent(x, None, 0.0, held, safe=False)
        pushed = np.zeros_like(loads)
        if slope is not None and pulls is not None:
            blocks = np.zeros((*contact.dofs.shape, contact.dofs.shape[1]))
            blocks[slope.facets] = slope.blocks()
            more = [*more, Feedback(contact.dofs, blocks)]
            np.add.at(pushed, slope.dofs, pulls)
            loads = loads + pushed
            loads[held] = 0.0
        d = -self.leader.solver.whole(self._system, more).solve(loads)
        if slope is not None:
            np.add.at(pushed, slope.dofs, slope.blocks() @ d[slope.dofs])
        return d, pushed

    def _factorise(self, x: Array, slope: Slope | None, held: NDArray[np.int64]) -> _EvenSprings:
        """Factorise the body's tangent at ``x`` with springs under the probe; `ConvergenceError` if it cannot be."""
        dofs = self._covered(x, slope)
        self._linear.cover(dofs)
        for safe, share in [*((False, s) for s in SPRINGS), (True, SPRINGS[-1])]:
            stiffness = share * self._contact.law.penalty
            self._tangent(x, slope, stiffness, held, safe=safe)
            try:
                compliance = self._linear.factorise(self._system)
            except FactorisationError:
                continue
            fixed = np.isin(dofs, held)
            compliance[fixed] = compliance[:, fixed] = 0.0
            return _EvenSprings(stiffness, dofs, compliance)
        raise ConvergenceError("the body has no stable tangent there", where="sensitivities")

    def _covered(self, x: Array, slope: Slope | None) -> NDArray[np.int64]:
        """Return the dofs (m,) whose compliance the next factor comes with: those of the last one, if they will do."""
        contact = self._contact
        needed = np.zeros(0, np.int64) if slope is None else slope.facets
        if np.isin(contact.dofs[needed], self._linear.dofs).all() and len(self._linear.dofs):
            return self._linear.dofs
        near = np.zeros(1, np.int64)  # some facet: PARDISO has no complement of nothing
        if contact.T is not None and self._linear.ahead:
            facets, gap = contact.gaps(x)
            near = facets[gap < WITHIN_REACH]
        return np.unique(contact.dofs[np.union1d(near, needed)])

    def _tangent(self, x: Array, slope: Slope | None, stiffness: float, held: NDArray[np.int64], *, safe: bool) -> None:
        """Sum the tangent (a ``safe`` one) at ``x`` of all items but the contact, with springs instead of that."""
        system, contact, pattern = self._system, self._contact, self.leader.solver.pattern
        system.safe = safe
        self.leader.solver.expect(x, None)  # the exact tangent, not what the search's last step promised
        system.clear(tangent=True)
        for item in self.leader.items:
            if item is not contact:
                item.evaluate(x, system, tangent=True)
        system.safe = False
        if slope is not None and contact.positions is not None:
            system.add_blocks(contact.positions[slope.facets], slope.springs(stiffness))
        scale = float(np.abs(system.values[pattern.diagonal]).mean())
        system.values[pattern.touching(held)] = 0.0
        system.values[pattern.diagonal[held]] = scale


def _under_probe(slope: Slope, springs: _EvenSprings, d: Array, pulls: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the dofs (m,) of the surface under the probe, the forces g (m, p) N there, and how the probe's part of the
    residual changes (m, p) N, with the ``pulls`` (k, 3 b, p) N of its facets, where ``d`` (n_dof, p) is free."""
    dofs, places = np.unique(slope.dofs, return_inverse=True)
    places = places.reshape(slope.dofs.shape)
    at = np.searchsorted(springs.dofs, dofs)
    C = springs.compliance[np.ix_(at, at)]
    S, D = (_dense(blocks, places, len(dofs)) for blocks in (slope.springs(springs.stiffness), slope.blocks()))
    h = np.zeros((len(dofs), d.shape[1]))
    np.add.at(h, places, pulls)
    g = np.asarray(np.linalg.solve(np.eye(len(dofs)) + (D - S) @ C, (D - S) @ d[dofs] + h), float)
    return dofs, g, g + S @ (d[dofs] - C @ g)


def _dense(blocks: Array, places: NDArray[np.int64], m: int) -> Array:
    """Return ``blocks`` (k, 3 b, 3 b) at ``places`` (k, 3 b), summed into (m, m)."""
    index = places[:, :, None] * m + places[:, None, :]
    return np.bincount(index.ravel(), blocks.ravel(), minlength=m * m).astype(np.float64).reshape(m, m)


def _shift(T: Array | None, own: Array | None) -> Array:
    """Return what moves a place (4, 4), less itself, as the probe goes from the pose ``T`` to its ``own``."""
    return np.zeros((4, 4)) if T is None or own is None else own @ frames.inverse(T) - np.eye(4)
