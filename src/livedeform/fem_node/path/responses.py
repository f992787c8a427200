"""Sensitivities of a body whose contact and supports forget the way that it came: one linear answer per change.

At the equilibrium x of the leading body, with the contact's constraints as very stiff springs (`ProbeContact.stiffen`),
r(x, p) = 0 gives

    dx/dp = -K^-1 dr/dp,

all changes as one block of right-hand sides with one factor, and once more from there. dr/dp is a difference of
residuals for the body, its weight and its supports; the contact stays linear, with the probe's move in closed form,
because a difference would see points that touch or let go over less than a nanometre; what its springs give,
multipliers take over. A relaxing body's columns carry the history of their own path.
What has no such answer is followed with its full equations instead (`fem_node.path.followers`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import Local, ProbeContact
from livedeform.fem_node.embedded_points import CarriedPoints
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.path.followers import Direction, MomentOf
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.assembly import System

CORRECTIONS = 3  # the second for the change's own square, and for the springs' give


def answers_linearly(leader: Physics, changed: Sequence[Physics]) -> bool:
    """Whether changes have linear answers: nothing slides, sticks, sets or rings, there is one body only (multipliers
    between two are not followed), and only numbers of the supports change."""
    if _beyond_linear(leader) or leader.interfaces:
        return False
    return all(_same_kind(leader, physics) for physics in changed)


def _beyond_linear(physics: Physics) -> bool:
    """Whether a memory goes with more than a linear history as relaxation has."""
    memory = memory_of(physics)
    return bool(memory.rubs or memory.slips or memory.sets or memory.rings)


def forgets(physics: Physics) -> bool:
    """Whether a body's equilibrium is the same whichever way it came."""
    return not memory_of(physics).of_the_way


def _same_kind(leader: Physics, physics: Physics) -> bool:
    """Whether a body is held at the same places and pressed by the same probe as the leader."""
    kept = [(s.region, s.type) for s in leader.supports] == [(s.region, s.type) for s in physics.supports]
    a, b = leader.probe, physics.probe
    if a is None or b is None:
        return kept and a is b
    same_law = (a.friction, a.adhesion, a.formulation) == (b.friction, b.adhesion, b.formulation)
    return kept and not _beyond_linear(physics) and same_law and a.shape is b.shape


class _Springs:
    """The contact of the leader at its solution ``x``, as linear springs."""

    def __init__(self, contact: ProbeContact, x: Array) -> None:
        self.contact, self._x = contact, x
        self._part = contact.local(x, tangent=True)
        holding = contact.local(x, tangent=True, safe=True)  # without the curvature
        self._holding = None if holding is None else holding._replace(vectors=np.zeros_like(holding.vectors))

    def pull(self, delta: Array) -> Array:
        """The change of the residual (n_dof,) as the body moves by ``delta``."""
        return self._times(self._part, delta)

    def hold(self, delta: Array) -> Array:
        """The part of `pull` that keeps the surface on the probe: what multipliers take over."""
        return self._times(self._holding, delta)

    def moved(self, T: Array) -> tuple[Array, Array]:
        """The same two (n_dof,) for a small move of the probe to the pose ``T`` (4, 4), the body still."""
        zero = np.zeros_like(self._x)
        if self._part is None or self._holding is None or np.array_equal(T, self.contact.pose):
            return zero, zero
        return self.contact.moved(self._part, T, self._x), self.contact.moved(self._holding, T, self._x)

    def _times(self, part: Local | None, delta: Array) -> Array:
        out = np.zeros_like(delta)
        if part is not None:
            dofs = self.contact.dofs[part.facets]
            np.add.at(out, dofs, part.times(delta[dofs]))
        return out


class _Answer:
    """One change: its body without the probe, and where it is from the leader, ``delta`` (n_dof,) m; ``d_force`` (3,)
    N, of the probe."""

    def __init__(self, leader: Mechanics, direction: Direction, unloaded: Array | None) -> None:
        self.direction = direction
        self.mechanics = Mechanics(leader.space, replace(direction.physics, probe=None), unloaded)
        self.delta = self._moved = self._moved_held = self._held = self._last = np.zeros(leader.space.n_dof)

    def begin(self, moment: Moment, probe: _Springs | None) -> None:
        """At a new moment: nothing is known yet."""
        self.mechanics.prepare(moment)
        zero = np.zeros_like(self.delta)
        self.delta = self._moved = self._moved_held = self._held = self._last = zero
        if probe is not None and moment.pose is not None:
            self._moved, self._moved_held = probe.moved(moment.pose)

    def pushed(self, probe: _Springs | None) -> Array:
        """What the probe adds to the residual (n_dof,) beyond what it does to the leader."""
        return self._held if probe is None else self._moved + probe.pull(self.delta) + self._held

    def correct(self, correction: Array, probe: _Springs | None) -> None:
        """Goes by ``correction`` (n_dof,); multipliers take over what the springs had to hold."""
        self.delta = self.delta + correction
        if probe is not None:
            self._last = self._moved + probe.pull(self.delta) + self._held
            self._held = self._held + self._moved_held + probe.hold(self.delta)

    @property
    def d_force(self) -> Array:
        """How the probe's force on the body changes, (3,) N."""
        n = 3 * self.mechanics.space.n_nodes
        return np.asarray(-self._last[:n].reshape(-1, 3).sum(axis=0))


class Responses:
    """The linear answers to ``directions``; ``unloaded``: the unloaded shape of each."""

    def __init__(self, leader: Mechanics, directions: Sequence[Direction], unloaded: Sequence[Array | None]) -> None:
        self.leader = leader
        self.answers = [_Answer(leader, d, shape) for d, shape in zip(directions, unloaded, strict=True)]
        self._system = System(leader.solver.pattern)

    def step(self, x: Array, moment_of: MomentOf) -> None:
        """Called between the leader's solution ``x`` and its commit: answers at this moment, and passes it."""
        leader, solver = self.leader, self.leader.solver
        contact = leader.contact if leader.contact is not None and leader.contact.T is not None else None
        saved = leader.save()
        for item in leader.items:
            item.stiffen(x)
        solver.factorise_at(x)
        probe = None if contact is None else _Springs(contact, x)
        at_rest = self._residual([item for item in leader.items if item is not leader.contact], x)
        moments = [moment_of(answer.direction.physics) for answer in self.answers]
        block = np.empty((len(x), len(self.answers)), order="F")
        for answer, moment in zip(self.answers, moments, strict=True):
            answer.begin(moment, probe)
        for _ in range(CORRECTIONS):
            for k, answer in enumerate(self.answers):
                block[:, k] = at_rest - self._residual(answer.mechanics.items, x + answer.delta) - answer.pushed(probe)
            block[leader.held()] = 0.0
            correction = solver.linear.solve(block)
            for k, answer in enumerate(self.answers):
                answer.correct(correction[:, k], probe)
        for answer, moment in zip(self.answers, moments, strict=True):
            answer.mechanics.commit(x + answer.delta, moment)
        leader.restore(saved)
        solver.drop_factor()

    def _residual(self, items: Sequence[Item], x: Array) -> Array:
        self._system.clear(tangent=False)
        for item in items:
            item.evaluate(x, self._system, tangent=False)
        return self._system.r.copy()

    def d_states(self) -> Array:
        """Derivatives (n_dof, p) of the committed moment's solution."""
        return np.column_stack([a.delta / a.direction.width for a in self.answers])

    def columns(self, points: CarriedPoints) -> tuple[Array, Array]:
        """Derivatives of ``points`` (n, 3, p) m and of the probe's force (3, p) N at the committed moment."""
        u, n = self.leader.u, 3 * self.leader.space.n_nodes
        base = points.positions(u)
        d_points, d_forces = np.empty((*base.shape, len(self.answers))), np.empty((3, len(self.answers)))
        for k, answer in enumerate(self.answers):
            du = answer.delta[:n].reshape(-1, 3)
            scale = 1e-6 / max(float(np.abs(du).max()), 1e-12)  # points on stalks turn with the surface
            d_points[..., k] = (points.positions(u + scale * du) - base) / (scale * answer.direction.width)
            d_forces[:, k] = answer.d_force / answer.direction.width
        return d_points, d_forces
