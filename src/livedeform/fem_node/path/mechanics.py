"""One body with one physics: its items, its equilibrium now, and its history."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import ProbeContact, make_contact
from livedeform.fem_node.contact.self_contact import FacingParts
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items import viscoelastic
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.dynamics import Inertial, moves
from livedeform.fem_node.items.loads import Dead, Weight, hung_masses
from livedeform.fem_node.items.protocol import Item, Moment, same_moment
from livedeform.fem_node.items.rubbing_load import RubbingLoad
from livedeform.fem_node.items.supports import make_supports
from livedeform.fem_node.items.swinging import Applied, lowest_rate, seconds_of_swing
from livedeform.fem_node.items.two_bodies import make_interface
from livedeform.fem_node.path.start import Extrapolation, Start, pose_distance
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.solver import Solution, Solver, SolverSettings

MOST_TURNED = 0.02  # of the contact force: as `fem_node.contact.verify` has it of surface that is pushed from behind


@dataclass(frozen=True)
class State:
    """The state of a body: displacements ``x``, the ``moment`` they belong to, and the items' histories."""

    x: Array
    moment: Moment
    items: list[Any]


# factorisations of a step in which much begins to slide; the gelatin cuboid's first touches took up to 173
USUAL_RUBBING = 25.0


@dataclass(frozen=True)
class Failed:
    """A ``moment`` that could not be solved from the committed displacements ``x`` of the moment ``start``."""

    x: Array
    start: Moment
    moment: Moment
    error: ConvergenceError

    def again(self, x: Array, start: Moment, moment: Moment) -> bool:
        """Return whether this is the same moment from the same state."""
        return same_moment(self.moment, moment) and self.from_the_same(x, start)

    def from_the_same(self, x: Array, start: Moment) -> bool:
        """Return whether it was tried from this state."""
        return same_moment(self.start, start) and np.array_equal(self.x, x)


class Mechanics:
    """The items of ``physics`` on ``space``. ``unloaded`` (n, 3) m: displacement from the scanned to the unloaded
    shape.

    The solver with its matrix pattern is made when first needed: bodies that are only asked for residuals have none.
    """

    def __init__(
        self,
        space: Space,
        physics: Physics,
        unloaded: Array | None = None,
        *,
        settings: SolverSettings | None = None,
        threads: int | None = None,
    ) -> None:
        self.space, self.physics, self.unloaded = space, physics, unloaded
        self.memory = memory_of(physics)
        self.settings, self.threads = settings or SolverSettings(), threads
        self.continuum = Continuum(space, physics, unloaded)
        self.weight = Weight(space, physics.density, self.continuum.mass_weights)
        self.items: list[Item] = [self.continuum, self.weight]
        self.inertial: Inertial | None = None
        if physics.inertia is not None:
            hung = hung_masses(space, physics)
            self.inertial = Inertial(space, physics.density, self.continuum.mass_weights, physics.inertia, hung)
            self.items.append(self.inertial)
        self.items += [Dead(space, load) for load in physics.loads]
        self.items += [RubbingLoad(space, load) for load in physics.loads if load.friction > 0.0]
        self.items += make_supports(space, physics, self.continuum.modulus_behind, unloaded)
        self.items += [make_interface(space, i, physics.material.youngs_modulus) for i in physics.interfaces]
        self.contact: ProbeContact | None = None
        if physics.probe is not None:
            self.contact = make_contact(space, physics.probe, self.continuum.surface_modulus)
            self.contact.gap_tolerance = self.settings.gap_tolerance
            self.contact.approaches = self.settings.approaches and not self.memory.path_dependent
            self.contact.hold(self.held())
            self.items.append(self.contact)
        self._solver: Solver | None = None
        self._failed: Failed | None = None
        self._extrapolation = Extrapolation()
        self.x = self.at_rest = np.zeros(space.n_dof)  # at rest: before weight and loads act
        # the scanned shape is in equilibrium under the weight that acted while it was scanned
        self.moment = Moment(0.0, np.inf, physics.scan_fraction * physics.scan_gravity, load=0.0)
        self._initial = self.save()

    @property
    def solver(self) -> Solver:
        """The solver, made when first asked for."""
        if self._solver is None:
            self._solver = Solver(
                self.items,
                self.space.n_dof,
                self.space.nodes,
                self._solver_settings(),
                n_negative=self.space.n_pressure,
                threads=self.threads,
            )
        return self._solver

    def _solver_settings(self) -> SolverSettings:
        """Return the settings, with more patience where a probe rubs: poses before a touch tell little of it."""
        if not self.memory.rubs:
            return self.settings
        return replace(self.settings, least_usual=max(self.settings.least_usual, USUAL_RUBBING))

    @property
    def u(self) -> Array:
        """Displacements (n, 3) m from the scanned shape."""
        return self.x[: 3 * self.space.n_nodes].reshape(-1, 3)

    def advance(self, moment: Moment, starts: Iterable[Start] | None = None) -> Solution:
        """Solve for the equilibrium at ``moment`` and commit it; on failure nothing has changed and `ConvergenceError`
        is raised."""
        solution = self.solve(moment, starts)
        self.commit(solution.x, moment)
        return solution

    def solve(self, moment: Moment, starts: Iterable[Start] | None = None) -> Solution:
        """Solve for the equilibrium at ``moment``, not yet committed.

        From each of ``starts`` (None: from where the last two solutions lead) until one leads there, and at last from
        the committed state by load steps. On failure nothing has changed and `ConvergenceError` is raised; the same
        moment from the same state is not tried again, nor one with the probe nearly where it was.
        """
        if self._failed is not None and self._is_hopeless(self._failed, moment):
            raise self._failed.error
        self.solver.begin()
        before = self.solver.save() if self._facing is not None else []
        try:
            solution = self._from_any(moment, starts)
            self._refuse_touching_itself(solution.x, moment, before)
        except ConvergenceError:
            self.solver.end(found=False)
            raise
        self.solver.end(found=True)
        return solution

    @cached_property
    def _facing(self) -> FacingParts | None:
        """Return the parts of the body that may come to touch one another; an interface keeps two bodies apart."""
        return None if self.physics.interfaces else FacingParts.of(self.space)

    def _refuse_touching_itself(self, x: Array, moment: Moment, before: list[Any]) -> None:
        """`ConvergenceError`, with the items as they were ``before``, for a solution that passes through itself."""
        u = x[: 3 * self.space.n_nodes].reshape(-1, 3)
        place = None if self._facing is None else self._facing.touching(self.space.nodes + u)
        if place is None:
            return
        self.solver.restore(before)
        at = ", ".join(f"{1e3 * c:.1f}" for c in place)
        error = ConvergenceError(
            f"a wrong equilibrium was found: the body touches itself at ({at}) mm, and passes through",
            where="solver",
            remedy="press less deep, or fill the gap in the surface: contact of the body with itself is not modelled",
        )
        self._failed = Failed(self.x.copy(), self.moment, moment, error)
        raise error

    def _from_any(self, moment: Moment, starts: Iterable[Start] | None) -> Solution:
        """Solve from the first of ``starts`` that leads to ``moment``, and at last from the committed state."""
        for start in self.extrapolated(moment) if starts is None else starts:
            contact = self.contact
            before = None if contact is None else (contact.save(), contact.exactness)
            if contact is not None and start.enter is not None:
                start.enter(contact)
            try:
                if start.in_one_step:
                    return self._at_once(start, moment)
                return self.solver.solve(start.x, moment, self.moment)
            except ConvergenceError:  # the solver has rolled the items back to this start
                if contact is not None and before is not None:
                    contact.restore(before[0])
                    contact.exactness = before[1]
        try:
            return self.solver.solve(self.x, moment, self.moment)
        except ConvergenceError as error:
            self._failed = Failed(self.x.copy(), self.moment, moment, error)
            raise

    def _at_once(self, start: Start, moment: Moment) -> Solution:
        """Solve for the equilibrium at ``moment`` in one step; after a jump, what pushes surface elsewhere than where
        the probe came in is no solution, however well balanced."""
        contact = self.contact
        if contact is None or moment.pose is None or not start.jump:
            return self.solver.solve_at_once(start.x, moment)
        saved = self.solver.save()
        solution = self.solver.solve_at_once(start.x, moment)
        share = contact.turned(self.x, self.moment.pose, solution.x)
        if share > MOST_TURNED:
            self.solver.restore(saved)
            raise ConvergenceError(
                f"{100.0 * share:.0f} % of the contact force push surface elsewhere than where the probe came in",
                where="solver",
                remedy="move the probe in smaller steps",
            )
        return solution

    def _is_hopeless(self, failed: Failed, moment: Moment) -> bool:
        """Return whether ``moment`` cannot be expected to be found where another one ``failed``: from the same state,
        with the probe within one step of where it was then, and no step away from where the body is now; or, of a
        body without memory that is tried ``once``, with the probe where it was then, as exactly as contact is."""
        if failed.again(self.x, self.moment, moment):
            return True
        contact = self.contact
        if contact is not None and self.settings.once and not self.memory.reasons:
            same_loads = failed.moment.load == moment.load and np.array_equal(failed.moment.gravity, moment.gravity)
            if same_loads and pose_distance(failed.moment.pose, moment.pose) < contact.gap_tolerance:
                return True
        if contact is None or not contact.approaches or not failed.from_the_same(self.x, self.moment):
            return False
        alike = contact.approach.alike(failed.moment.pose, moment.pose)
        return alike and not contact.is_step(self.x, self.moment, moment)

    def pass_held(self, moment: Moment) -> None:
        """Pass a moment at which somebody holds the body where it rested: nothing is solved, and stress fades."""
        self.prepare(moment)
        self.commit(self.at_rest, moment)

    def commit(self, x: Array, moment: Moment) -> None:
        """Accept ``x`` as the equilibrium at ``moment``: history moves on."""
        for item in self.items:
            item.commit(x)
        if moment.rests:
            self.at_rest = x
        self.x, self.moment = x, moment
        if self.contact is not None and not self.memory.rubs:
            self._extrapolation.note(moment, x, self.contact.state.multiplier)

    def extrapolated(self, moment: Moment) -> Iterator[Start]:
        """Offer where the last two solutions lead by ``moment``."""
        return self._extrapolation.starts(moment)

    def dragged(self, moment: Moment) -> list[Start]:
        """Return where the body would be if all that the probe touches went with it to the ``moment``, to first order:
        where to start from if it sticks. Nothing where it touches nothing, or the tangent cannot be factorised."""
        contact, solver = self.contact, self.solver
        if contact is None or moment.pose is None or not contact.state.touches.any():
            return []
        part = contact.local(self.x, tangent=True)
        if part is None:
            return []
        try:
            step = solver.response(part, contact.moved(part, moment.pose, self.x), self.x)
        except ConvergenceError:
            return []
        return [Start(self.x - step)]

    def pace(self) -> float:
        """Return how long (s) the next dynamic step may be."""
        return np.inf if self.inertial is None else self.inertial.step

    def pace_at_rest(self) -> float:
        """Return how long (s) the next step without inertia may be."""
        return viscoelastic.longest_step(self.physics.prony, self.moment.dt)

    def swings_for(self) -> float:
        """Return how long (s) a swing lasts beside the committed state: of the slowest mode, relaxed as the body may
        be. All is as before; inf where the tangent does not tell."""
        if self.inertial is None:
            return 0.0
        saved = self.save()
        self.prepare(replace(self.moment, dt=np.inf, still=True, held=False))
        try:
            with self.factorised_at(self.x, keep=False):
                return seconds_of_swing(self.physics, self._lowest_rate(self.inertial))
        except ConvergenceError:
            return np.inf
        finally:
            self.restore(saved)

    def _lowest_rate(self, inertial: Inertial) -> float:
        """Return the rate (rad/s) of the slowest mode, once the tangent is factorised."""
        n = 3 * self.space.n_nodes
        free = np.ones(self.space.n_dof, bool)
        free[self.held()] = False

        def times_compliance(forces: Array) -> Array:
            load = np.zeros((len(free), forces.shape[1]), order="F")
            load[:n] = forces
            load[~free] = 0.0
            return self.solver.answering.solve_exactly(load)[:n]

        times_mass: Applied = partial(np.apply_along_axis, inertial.times_mass, 0)
        return lowest_rate(times_mass, times_compliance, self.space.nodes, free[:n])

    def ahead(self, moment: Moment) -> list[Start]:
        """Return where the motion leads by ``moment``, to start a solution from; nothing without motion."""
        if self.inertial is None or not moves(self.physics.inertia, moment):
            return []
        x = self.x.copy()
        x[: 3 * self.space.n_nodes] = self.inertial.ahead(moment.dt)
        return [Start(x, in_one_step=False)]

    def held(self) -> NDArray[np.int64]:
        """Return the dofs that are held at the prepared moment, sorted."""
        return np.unique(np.concatenate([item.constraints()[0] for item in self.items]).astype(np.int64))

    def wrench(self) -> tuple[Array, Array]:
        """Return force N and torque N m (about the phantom's origin) of the probe on the body."""
        return (np.zeros(3), np.zeros(3)) if self.contact is None else self.contact.wrench(self.x)

    def borne(self, x: Array, system: System) -> Array:
        """Return the probe's force (3,) N as the body bears it at the equilibrium ``x`` of the prepared moment, before
        its commit. It is the one of `wrench` without the round-off of stiff springs at the contact; not where the probe
        touches held nodes."""
        part = None if self.contact is None else self.contact.local(x, tangent=False)
        if part is None or self.contact is None:
            return np.zeros(3)
        system.clear(tangent=False)
        for item in self.items:
            if item is not self.contact:
                item.evaluate(x, system, tangent=False)
        pushed = np.zeros(self.space.n_nodes, bool)
        pushed[self.contact.dofs[part.facets][:, ::3] // 3] = True
        return np.asarray(system.r[: 3 * self.space.n_nodes].reshape(-1, 3)[pushed].sum(axis=0))

    def prepare(self, moment: Moment) -> None:
        """Set the moment of all items."""
        for item in self.items:
            item.prepare(moment)

    def residual(self, x: Array, system: System) -> Array:
        """Return the out-of-balance force (n_dof,) at ``x`` and the prepared moment (the array is ``system.r``
        itself)."""
        system.clear(tangent=False)
        for item in self.items:
            item.evaluate(x, system, tangent=False)
        return system.r

    def save(self) -> State:
        """Return everything that moves."""
        return State(self.x, self.moment, [item.save() for item in self.items])

    def restore(self, state: State) -> None:
        """Go back to a saved state."""
        self.x, self.moment = state.x, state.moment
        self._extrapolation.back_to(state.x)
        for item, saved in zip(self.items, state.items, strict=True):
            item.restore(saved)

    @contextmanager
    def factorised_at(self, x: Array, *, keep: bool) -> Iterator[None]:
        """Have the tangent factorised at the solution ``x`` with stiffened items, for sensitivities; in the end all is
        as before, but the solver's factor only if one may ``keep`` it."""
        saved = self.save()
        try:
            for item in self.items:
                item.stiffen(x)
            self.solver.linearise_at(x)
            yield
        finally:
            self.restore(saved)
            if not keep:
                self.solver.drop_factor()

    def reset(self) -> None:
        """Go back to the stress-free shape, without history: nor that of the solver, whose kept factor would lead to
        the same equilibria only within their tolerances."""
        self.restore(self._initial)
        self._extrapolation, self._failed = Extrapolation(), None
        if self._solver is not None:
            self._solver.begin_anew()
