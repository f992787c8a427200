"""Sensitivities as tangents at each solution: one linear answer per direction, all with one factor.

At the equilibrium x of the leading body, with the contact's constraints as very stiff springs (`ProbeContact.stiffen`),
r(x, p) = 0 gives

    dx/dp = -K^-1 dr/dp.

dr/dp is a difference of residuals at x: of the items that the direction changes, each as the changed body has it, which
is enough also for history, since the changed body's items commit its own path x + delta. The contact stays linear, with
the probe's move in closed form, because a difference would see points that touch or let go over less than a nanometre.
The first correction is the tangent alone. More of them go on from there, for the change's own square and for what the
springs give, which multipliers take over.

Of a probe that rubs tangents at the moments alone leave out what slid and stuck on the path: they are taken at each of
its steps (`fem_node.path.rubbing`). Of one that begins to rub they are good, where the leader's pressures are those
that limit the friction: it is followed with the body's compliance (`fem_node.contact.drag`).

Where the body slips on its support each neighbour has slip of its own (`fem_node.items.friction`), and limits follow
the pressure in the factor itself, one that is not symmetric (`fem_node.solve.whole_tangent`).
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import Local, ProbeContact, make_contact
from livedeform.fem_node.contact.drag import Drag
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.friction import FrictionSupport, SlipAlong
from livedeform.fem_node.items.loads import Dead, Weight
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.items.supports import Springs, make_supports
from livedeform.fem_node.path.direction import Direction, MomentOf, same_physics
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.yielding_support import yielding_support
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.assembly import System

CORRECTIONS = 3  # in full; the second for the change's own square, and for the springs' give
AT_ONCE = 64  # forces on the surface that the body is asked for its answer to
SMALL = 1e-6  # m, the move by which points that turn with the surface are differentiated


def answers_linearly(leader: Physics, changed: Sequence[Physics]) -> bool:
    """Return whether corrected tangents are exact: nothing slides, sticks, sets or rings, there is one body only
    (multipliers between two are not followed), and only numbers of the supports change."""
    if _beyond_linear(leader) or leader.interfaces:
        return False
    return all(_same_kind(leader, physics) for physics in changed)


def _beyond_linear(physics: Physics) -> bool:
    """Return whether there is more to the body's memory than a linear history, as relaxation has."""
    memory = memory_of(physics)
    return bool(memory.rubs or memory.slips or memory.sets or memory.rings)


def _same_kind(leader: Physics, physics: Physics) -> bool:
    """Return whether a body is held at the same places and pressed by the same probe as the leader."""
    kept = [(s.region, s.type) for s in leader.supports] == [(s.region, s.type) for s in physics.supports]
    a, b = leader.probe, physics.probe
    if a is None or b is None:
        return kept and a is b
    return kept and not _beyond_linear(physics) and a.law == b.law and a.shape is b.shape


class _Springs:
    """The contact of the leader at its solution ``x``, as linear springs."""

    def __init__(self, contact: ProbeContact, x: Array) -> None:
        self.contact, self._x = contact, x
        self._part = contact.local(x, tangent=True)
        self._holding: Local | None = None

    def pull(self, delta: Array) -> Array:
        """Return the change of the residual (n_dof,) as the body moves by ``delta``."""
        return self._times(self._part, delta)

    def hold(self, delta: Array) -> Array:
        """Return the part of `pull` that keeps the surface on the probe: what multipliers take over."""
        return self._times(self._held(), delta)

    def moved(self, T: Array) -> Array:
        """Return the change of the residual (n_dof,) as the probe makes a small move to the pose ``T`` (4, 4)."""
        return self._by_probe(self._part, T)

    def moved_hold(self, T: Array) -> Array:
        """Return the part of `moved` that multipliers take over."""
        return self._by_probe(self._held(), T)

    def pushes(self) -> Array:
        """Return the contact's part (n_dof,) of the residual itself."""
        out = np.zeros_like(self._x)
        if self._part is not None:
            np.add.at(out, self.contact.dofs[self._part.facets], self._part.vectors)
        return out

    def _held(self) -> Local | None:
        if self._holding is None:
            part = self.contact.local(self._x, tangent=True, safe=True)  # without the curvature
            self._holding = None if part is None else part._replace(vectors=np.zeros_like(part.vectors))
        return self._holding

    def _by_probe(self, part: Local | None, T: Array) -> Array:
        if part is None or np.array_equal(T, self.contact.pose):
            return np.zeros_like(self._x)
        return self.contact.moved(part, T, self._x)

    def _times(self, part: Local | None, delta: Array) -> Array:
        out = np.zeros_like(delta)
        if part is not None:
            dofs = self.contact.dofs[part.facets]
            np.add.at(out, dofs, part.times(delta[dofs]))
        return out


class ItemResiduals:
    """Residuals (n_dof,) of some items of the leader at its solution ``x``, worked out once for all directions."""

    def __init__(self, system: System, x: Array) -> None:
        self.x, self._system = x, system
        self._known: dict[tuple[int, ...], Array] = {}

    def of_leader(self, items: Sequence[Item]) -> Array:
        """Return that of items of the leader at x."""
        key = tuple(id(item) for item in items)
        if key not in self._known:
            self._known[key] = self.at(self.x, items)
        return self._known[key]

    def at(self, x: Array, items: Sequence[Item]) -> Array:
        """Return that of any items at any ``x``."""
        self._system.clear(tangent=False)
        for item in items:
            item.evaluate(x, self._system, tangent=False)
        return self._system.r.copy()


class Followed:
    """Strain and stress at the leader's solution ``x``, worked out once for all that begin to remember them;
    ``there``: that of a moment that was asked for, not one on the way."""

    def __init__(self, leader: Mechanics, x: Array, *, there: bool) -> None:
        self.x, self.there, self._continuum = x, there, leader.continuum

    @cached_property
    def strain(self) -> Array:
        return self._continuum.strain(self.x)

    @cached_property
    def stress(self) -> Array:
        return self._continuum.relaxed_stress(self.x)


class Neighbour:
    """The body along one direction: the leader's items, but for those that the direction changes.

    ``delta`` (n_dof,) m is how far it is from the leader, ``force`` (3,) N how the probe's force differs; ``slope``
    (n_dof,) the free part of delta by the direction's width. ``remembers``: it has a history of its own.
    """

    def __init__(self, leader: Mechanics, direction: Direction, unloaded: Array | None) -> None:
        self.leader, self.direction = leader, direction
        reference, changed = direction.reference or leader.physics, direction.physics
        reshaped = unloaded is not leader.unloaded
        self._reshaped = _unknowns(leader.space, unloaded) - _unknowns(leader.space, leader.unloaded)
        self.replaced: list[tuple[list[Item], list[Item]]] = []  # the leader's items, and its own instead
        self.continuum = self._own_continuum(reference, unloaded)
        self._own_weight(reference, reshaped=reshaped)
        self._stiffens = self._penalty_change()
        if _pulls(changed) != _pulls(reference):
            dead: list[Item] = [item for item in leader.items if isinstance(item, Dead)]
            self.replaced.append((dead, [Dead(leader.space, load) for load in changed.loads]))
        body = self.continuum or leader.continuum
        self.gives = yielding_support(leader.space, reference, changed, body.modulus_behind)
        sprung = _only_springs_change(reference, changed)
        another = self.continuum is not None or changed.supports != reference.supports  # springs go by the modulus
        if (self.gives is None or sprung) and another:
            own = _springs_of(make_supports(leader.space, changed, body.modulus_behind, unloaded))
            self.replaced.append((_springs_of(leader.items), own))
        self._own_friction = self._friction_with(body, unloaded)
        leaders = [item for item in leader.items if isinstance(item, FrictionSupport)]
        self._slips = [SlipAlong(*pair) for pair in zip(leaders, self._own_friction, strict=False)]
        before, now = memory_of(reference), memory_of(changed)
        probe, other = changed.probe, reference.probe
        moves_in_time = probe is not None and other is not None and probe.time_offset != other.time_offset
        self.passing = moves_in_time or any(m.drifts or m.relaxes or m.sets for m in (before, now))
        self.drag = _begins_to_rub(leader, changed)
        self.passing |= self.drag is not None or bool(self._slips)
        self._fades = self.continuum is not None and bool(now.relaxes or now.sets)
        self.remembers = self.drag is not None or self._fades or bool(self._slips)
        self._begins = not reshaped and _begins_to_remember(leader.physics, changed)
        self.delta = self.slope = self._moved = self._taken_over = self._pushed = np.zeros(leader.space.n_dof)
        self._at_rest = self.delta  # before weight and loads act

    def _own_continuum(self, reference: Physics, unloaded: Array | None) -> Continuum | None:
        """Return a body of its own if the direction changes it, or if it relaxes along a path of its own."""
        changed, leader = self.direction.physics, self.leader
        alike = unloaded is leader.unloaded and same_physics(_bulk(changed), _bulk(reference))
        if alike and not memory_of(changed).relaxes:
            return None
        continuum = Continuum(leader.space, changed, unloaded)
        self.replaced.append(([leader.continuum], [continuum]))
        return continuum

    def _friction_with(self, body: Continuum, unloaded: Array | None) -> list[FrictionSupport]:
        """Return its own friction with the supports, where the leader has as much: each slips on a path of its own."""
        n = sum(isinstance(item, FrictionSupport) for item in self.leader.items)
        if not n:
            return []
        supports = make_supports(self.leader.space, self.direction.physics, body.modulus_behind, unloaded)
        own = [item for item in supports if isinstance(item, FrictionSupport)]
        return own if len(own) == n else []

    def _penalty_change(self) -> float:
        """Return by which share the penalty that holds the surface back differs: it goes by the modulus there."""
        contact, leader = self.leader.contact, self.leader.continuum
        if self.continuum is None or contact is None or contact.law.multiplies:
            return 0.0  # multipliers leave nothing to it
        return self.continuum.surface_modulus / leader.surface_modulus - 1.0

    def _own_weight(self, reference: Physics, *, reshaped: bool) -> None:
        changed, leader = self.direction.physics, self.leader
        heavier = changed.density != reference.density or not np.array_equal(changed.gravity, reference.gravity)
        if heavier or reshaped:
            body = self.continuum or leader.continuum
            self.replaced.append(([leader.weight], [Weight(leader.space, changed.density, body.mass_weights)]))

    def begin(self, followed: Followed, moment: Moment, springs: _Springs | None) -> None:
        """Prepare for a new moment, at which nothing is known yet."""
        x = followed.x
        for _, own in self.replaced:
            for item in own:
                item.prepare(moment)
        for friction in self._own_friction:
            friction.prepare(moment)
        if self.continuum is not None:
            if self.direction.physics.plastic_set is not None and self.leader.physics.plastic_set is not None:
                self.continuum.set_like(self.leader.continuum)
            elif self.direction.physics.plastic_set is not None:
                self.continuum.update(x, followed.strain if self._begins else None)
        self.delta = self._moved = self._taken_over = self._pushed = np.zeros_like(x)
        self._pose, self._rests = moment.pose, moment.rests
        if self.drag is not None:
            self.drag.prepare(moment)
        if springs is not None and moment.pose is not None:
            self._moved = springs.moved(moment.pose)
            if self._stiffens:
                self._moved = self._moved + self._stiffens * springs.pushes()

    def first_load(self, residuals: ItemResiduals, held: NDArray[np.int64]) -> Array:
        """Return how the out-of-balance force (n_dof,) at the leader's solution differs from the leader's own."""
        r = np.zeros_like(residuals.x)
        for leaders, own in self.replaced:
            r += residuals.at(residuals.x, own) - residuals.of_leader(leaders)
        if self.drag is not None and self.leader.contact is not None:
            self._moved = self._moved + self.drag.load(residuals.x, self.leader.contact, self._compliance)
        for slip in self._slips:
            r += slip.load(residuals.x)
        r += self._moved
        self.imposed: Array | float = 0.0
        if self.gives is None:
            return r
        everything = residuals.of_leader(self.leader.items)
        imposed = self.gives.imposed(everything, held)
        imposed[held] += self._reshaped[held] / self.direction.width  # it gives from where it is slack
        e = SMALL / max(float(np.abs(imposed).max()), 1e-12)
        moved = residuals.at(residuals.x + e * imposed, self.leader.items)
        self.imposed = self.direction.width * imposed
        along = self.direction.width * (moved - everything) / e
        return along + r

    def _compliance(self, dofs: NDArray[np.int64]) -> Array:
        """Return how the ``dofs`` (k,) move (k, k) m under 1 N at each of them, with the leader's factor."""
        C, free = np.zeros((len(dofs), len(dofs))), ~np.isin(dofs, self.leader.held())
        for some in np.array_split(np.flatnonzero(free), len(dofs) // AT_ONCE + 1):
            forces = np.zeros((len(self.delta), len(some)), order="F")
            forces[dofs[some], np.arange(len(some))] = 1.0
            C[:, some] = self.leader.solver.answering.solve(forces)[dofs]
        return C

    def load(self, residuals: ItemResiduals, springs: _Springs | None) -> Array:
        """Return what is out of balance (n_dof,), relative to the leader, after a correction."""
        contact = self.leader.contact
        leaders = [item for item in self.leader.items if item is not contact]
        changed = {id(item) for old, _ in self.replaced for item in old}
        own = [item for item in leaders if id(item) not in changed] + [i for _, new in self.replaced for i in new]
        r = residuals.at(residuals.x + self.delta, own) - residuals.of_leader(leaders)
        return r if springs is None else r + self._moved + springs.pull(self.delta) + self._taken_over

    def correct(self, correction: Array, springs: _Springs | None, *, last: bool) -> None:
        """Go by ``correction`` (n_dof,); multipliers take over what the springs had to hold."""
        self.delta = self.delta + correction
        self.slope = self.delta / self.direction.width
        self.delta = self.delta + self.imposed
        if springs is None:
            return
        self._pushed = self._moved + springs.pull(self.delta) + self._taken_over
        if not last and springs.contact.law.multiplies:
            moved = 0.0 if self._pose is None else springs.moved_hold(self._pose)
            self._taken_over = self._taken_over + moved + springs.hold(self.delta)

    def pass_held(self, moment: Moment) -> None:
        """Pass a moment at which the body is held where it rested."""
        self.delta = self._at_rest
        self.slope = self.delta / self.direction.width
        self._moved = self._taken_over = self._pushed = np.zeros_like(self.delta)
        if self.continuum is not None and self._fades:
            self.continuum.prepare(moment)
            self.continuum.commit(self.leader.at_rest + self.delta)
        for friction in self._own_friction:
            friction.prepare(moment)
        for slip in self._slips:
            slip.commit(self.leader.at_rest, self.delta, there=True)

    def commit(self, followed: Followed) -> None:
        """Take its own path into its history: of what begins to remember that is the leader's, to first order."""
        if self._rests:
            self._at_rest = self.delta
        if self.drag is not None:
            self.drag.commit(followed.x)
        for slip in self._slips:
            slip.commit(followed.x, self.delta, there=followed.there)
        if self.continuum is None or not self._fades:
            return
        if self._begins:
            sets, relaxes = self.direction.physics.plastic_set is not None, self.direction.physics.prony is not None
            strain, stress = followed.strain if sets else None, followed.stress if relaxes else None
            self.continuum.commit(followed.x, strain, stress)
        else:
            self.continuum.commit(followed.x + self.delta)

    def pushed(self, change: Array) -> None:
        """Note by how much (n_dof,) N the probe's part of the residual differs."""
        self._pushed = change

    @property
    def force(self) -> Array:
        """Return how the probe's force on the body differs, (3,) N."""
        n = 3 * self.leader.space.n_nodes
        return np.asarray(-self._pushed[:n].reshape(-1, 3).sum(axis=0))


class Tangents:
    """Linear answers to ``directions``; ``unloaded``: the unloaded shape of each; ``corrections``: how many, one for
    the tangent alone."""

    def __init__(
        self,
        leader: Mechanics,
        directions: Sequence[Direction],
        unloaded: Sequence[Array | None],
        corrections: int = CORRECTIONS,
    ) -> None:
        self.leader, self._corrections = leader, corrections
        self.neighbours = [Neighbour(leader, d, shape) for d, shape in zip(directions, unloaded, strict=True)]
        self.passing: Sequence[int] = [k for k, neighbour in enumerate(self.neighbours) if neighbour.passing]
        self._remembering = [k for k, neighbour in enumerate(self.neighbours) if neighbour.remembers]
        self._system = System(leader.solver.pattern)

    def step(self, x: Array, moment_of: MomentOf, *, there: bool, wanted: Collection[int]) -> None:
        """See `Sensitivities`: on the way only those that remember it are worked out."""
        if not there:  # where a body rests all are worked out: it may be held there
            wanted = range(len(self.neighbours)) if moment_of(self.leader.physics).rests else self._remembering
        asked = [self.neighbours[k] for k in wanted]
        if not asked:
            return
        leader = self.leader
        with leader.factorised_at(x, keep=False):
            contact = leader.contact if leader.contact is not None and leader.contact.T is not None else None
            springs = None if contact is None else _Springs(contact, x)
            followed = Followed(leader, x, there=there)
            for neighbour in asked:
                neighbour.begin(followed, moment_of(neighbour.direction.physics), springs)
            self._answer(asked, x, springs)
        for neighbour in asked:
            neighbour.commit(followed)

    def _answer(self, asked: Sequence[Neighbour], x: Array, springs: _Springs | None) -> None:
        """Work out how far the neighbours are from the leader at ``x``."""
        held, residuals = self.leader.held(), ItemResiduals(self._system, x)
        block = np.empty((len(x), len(asked)), order="F")
        for i in range(self._corrections):
            for k, neighbour in enumerate(asked):
                block[:, k] = neighbour.load(residuals, springs) if i else neighbour.first_load(residuals, held)
            block[held] = 0.0
            correction = -self.leader.solver.answering.solve_exactly(block)
            for k, neighbour in enumerate(asked):
                neighbour.correct(correction[:, k], springs, last=i + 1 == self._corrections)

    def pass_held(self, moment_of: MomentOf) -> None:
        """See `Sensitivities`."""
        for neighbour in self.neighbours:
            neighbour.pass_held(moment_of(neighbour.direction.physics))

    def slopes(self, wanted: Collection[int]) -> dict[Hashable, Array]:
        """See `Sensitivities`."""
        return {self.neighbours[k].direction.name: self.neighbours[k].slope for k in wanted}

    def derivatives(self, points: EmbeddedPoints, wanted: Collection[int]) -> tuple[Array, Array]:
        """See `Sensitivities`."""
        u = self.leader.u
        base = points.positions(u)
        d_points, d_forces = np.empty((*base.shape, len(wanted))), np.empty((3, len(wanted)))
        for k, neighbour in enumerate(self.neighbours[j] for j in wanted):
            du = neighbour.delta[: u.size].reshape(-1, 3) / neighbour.direction.width
            e = SMALL / max(float(np.abs(du).max()), 1e-12)  # points on stalks turn with the surface
            d_points[..., k] = (points.positions(u + e * du) - base) / e
            d_forces[:, k] = neighbour.force / neighbour.direction.width
        return d_points, d_forces


def _begins_to_rub(leader: Mechanics, changed: Physics) -> Drag | None:
    """Return the friction of a probe that rubs, without adhesion, where the leader's does not; None for any other."""
    if leader.contact is None or leader.memory.rubs or changed.probe is None:
        return None
    if not changed.probe.friction > 0.0 or changed.probe.adhesion > 0.0:
        return None
    return Drag(make_contact(leader.space, changed.probe, leader.continuum.surface_modulus))


def _begins_to_remember(leader: Physics, changed: Physics) -> bool:
    """Return whether a body differs from the leader, which remembers nothing, by what relaxes or sets alone."""
    before, now = memory_of(leader), memory_of(changed)
    if before.relaxes or before.sets or not (now.relaxes or now.sets):
        return False
    return same_physics(replace(_bulk(changed), prony=None, plastic_set=None), _bulk(leader))


def _only_springs_change(reference: Physics, changed: Physics) -> bool:
    """Return whether the supports that differ are springs in both."""
    pairs = [(a, b) for a, b in zip(reference.supports, changed.supports, strict=True) if a != b]
    return {support.type for pair in pairs for support in pair} == {"spring"}


def _unknowns(space: Space, u: Array | None) -> Array:
    """Return unknowns (n_dof,) with the displacements ``u`` (n, 3) m; None: none."""
    out = np.zeros(space.n_dof)
    if u is not None:
        out[: u.size] = u.ravel()
    return out


def _springs_of(items: Sequence[Item]) -> list[Item]:
    """Return the springs among items: a support's numbers are in them, and where they are slack."""
    return [item for item in items if isinstance(item, Springs)]


def _pulls(physics: Physics) -> list[tuple[float, ...]]:
    """Return of each load when it pulls, s, and how, N."""
    return [(load.delay, *map(float, load.force)) for load in physics.loads]


def _bulk(physics: Physics) -> Physics:
    """Return what the continuum alone depends on."""
    return replace(physics, probe=None, gravity=np.zeros(3), supports=(), loads=(), density=0.0, scan_fraction=0.0)
