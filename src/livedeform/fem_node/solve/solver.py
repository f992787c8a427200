"""Equilibrium: Newton's method with a line search, a kept factor, and load steps that adapt.

The solver sums items (`fem_node.items.protocol`) and knows nothing else of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import GAP_TOLERANCE, Local
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.solve.agreement import End, SeveralEquilibria, agree, several
from livedeform.fem_node.solve.assembly import Feedback, System, pattern_of
from livedeform.fem_node.solve.condensed_search import CondensedSearch, NotFound
from livedeform.fem_node.solve.linear_solver import Factor, FactorisationError, LinearSolver, make_linear_solver
from livedeform.fem_node.solve.newton import Learned, Lost, Newton
from livedeform.fem_node.solve.whole_tangent import WholeTangent

LATELY = 0.2  # weight of a moment's iterations in their mean
MOST_STEPS = 200  # of one walk
STRIDES = (1.0, 0.5, 0.25)  # of the pieces that a way is walked in, until two walks agree
FEW_PIECES = 2  # a way that is taken in no more is no jump
NEARLY = 1e-9  # of a way
NOT_ENOUGH = "as many iterations as it was given were not enough"
LOOSER = 20.0  # how much less exactly equilibrium is solved while multipliers and plastic set still move


@dataclass(frozen=True)
class SolverSettings:
    """Settings that say when a solution is accepted, and how long it is tried.

    ``tolerance`` m: the largest nodal correction of the last Newton step (the error left is far below it);
    ``gap_tolerance`` m: how far a point under the probe may be from complementarity; ``keep_factor_rate``: corrections
    must shrink by this per iteration while an old factor is used; ``patience``: iterations on steps that fail, in usual
    steps' iterations and at least ``least_patience``, after which a moment is given up; with a probe also
    factorisations, in usual steps' or ``least_usual``; ``strides``: in which pieces a jump is walked, of those that are
    admissible, until two walks end alike (one stride: that walk is believed); ``near_starts``: whether a start for one
    step must be admissible as well, or what a jump led to is looked at once it is solved (`Mechanics.solve`);
    ``approaches``: whether a body without memory is approached anew after a slide; ``single``: whether
    factors are made in single precision; ``once``: whether ``patience`` is for all starts of a moment together (one
    that used it up is hardly found from another start), and half of it where the last moment was given up;
    ``in_motion``: whether moments are steps of time, which change the tangent little: what is learned of a factor
    serves the next ones too, and none is solved roughly first; ``condensed``: whether contact is solved whole in each
    step of Newton's method, with the ordinary way where that does not converge (`CondensedSearch`).
    """

    tolerance: float = 1e-8
    strides: tuple[float, ...] = STRIDES
    near_starts: bool = True
    approaches: bool = True
    single: bool = False
    once: bool = False
    in_motion: bool = False
    condensed: bool = True
    gap_tolerance: float = GAP_TOLERANCE
    max_iterations: int = 80
    max_updates: int = 60
    smallest_step: float = 1.0 / 128.0
    keep_factor_rate: float = 0.5
    patience: float = 10.0
    least_patience: int = 400
    least_usual: float = 5.0


class Work(NamedTuple):
    """Newton iterations and factorisations."""

    iterations: float
    factorisations: float


@dataclass
class Solution:
    """An equilibrium: ``x`` (n_dof,), Newton iterations, factorisations and load steps that it took; ``n_useful`` of
    the iterations, and as many factorisations, led to a load step that was accepted."""

    x: Array
    n_iterations: int = 0
    n_factorisations: int = 0
    n_steps: int = 1
    n_useful: int = 0
    n_useful_factorisations: int = 0

    @property
    def wasted(self) -> Work:
        """Return what led nowhere yet."""
        return Work(self.n_iterations - self.n_useful, self.n_factorisations - self.n_useful_factorisations)


@dataclass
class Solver:
    """Solves for the equilibrium of ``items``; ``positions`` (n, 3) m tell the user where something went wrong."""

    items: Sequence[Item]
    n_dof: int
    positions: Array
    settings: SolverSettings = field(default_factory=SolverSettings)
    n_negative: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        groups = [group for item in self.items for group in item.couplings()]
        self.pattern = pattern_of(self.n_dof, groups, symmetric=all(item.symmetric for item in self.items))
        for item in self.items:
            item.attach(self.pattern)
        self.system = System(self.pattern)
        self.linear: LinearSolver = make_linear_solver(
            self.pattern, n_negative=self.n_negative, threads=self.threads, single=self.settings.single
        )
        self._held: NDArray[np.int64] = np.zeros(0, np.int64)
        self._touching: NDArray[np.int64] = np.zeros(0, np.int64)
        self._condensed = None
        if self.settings.condensed:
            in_motion = self.settings.in_motion
            self._condensed = CondensedSearch.of(self.items, self.pattern, self.threads, in_motion=in_motion)
        self.has_factor = False
        self.answering: Factor = self.linear  # for sensitivities, after `linearise_at`
        self._whole: WholeTangent | None = None
        self.learned = Learned()
        self.learns = self.pattern.symmetric and not self.n_negative
        self.size = float(np.ptp(self.positions, axis=0).max())
        self.left = np.inf  # iterations, after which nothing more is found
        self._usual = Work(0.0, 0.0)  # of a step that is accepted, the mean of the last few
        self._failed = Work(0.0, 0.0)  # on starts of this moment that led nowhere
        self._gave_up = False  # the last moment

    # -- one moment ------------------------------------------------------------------------------------------------

    def begin_anew(self) -> None:
        """Forget factors and what earlier moments took: a run is then the same to the last bit, whatever the solver
        has solved before. What is known of the matrix's pattern stays."""
        self.has_factor = False
        self.learned.clear()
        self.linear.begin_anew()
        if self._condensed is not None:
            self._condensed.begin_anew()
        self._usual = self._failed = Work(0.0, 0.0)
        self._gave_up = False

    def begin(self) -> None:
        """Begin with the first start of a moment."""
        self._failed = Work(0.0, 0.0)

    def end(self, *, found: bool) -> None:
        """End with the last start of a moment, from which it was ``found`` or not."""
        self._gave_up = not found

    def solve(self, x: Array, moment: Moment, start: Moment) -> Solution:
        """Solve for the equilibrium at ``moment`` from the equilibrium ``x`` at ``start``; history is not committed
        yet.

        A way that is taken in pieces is walked again in shorter ones, until two walks end alike; where none do there is
        more than one equilibrium. On failure everything is rolled back and `ConvergenceError` raised.
        """
        ways = [way for item in self.items for way in item.ways(x, start, moment)] or [[moment]]
        saved, solution = self.save(), Solution(x, n_steps=0)
        lost: ConvergenceError | None = None
        for way in ways:
            try:
                self._settle(solution, x, [start, *way], saved)
            except SeveralEquilibria:
                self.restore(saved)
                raise
            except ConvergenceError as error:
                lost = lost or error
                continue
            self._learn_usual(solution)
            return solution
        self.restore(saved)
        self._fail(solution)
        assert lost is not None  # there is at least one way
        raise lost

    def _settle(self, solution: Solution, x: Array, way: Sequence[Moment], saved: list[Any]) -> None:
        """Go a ``way`` from its first moment, and if it is a jump again in shorter pieces, until two walks agree; one
        that is lost does not count."""
        ends: list[End] = []
        lost: ConvergenceError | None = None
        shorter = min(item.stride() for item in self.items)
        for stride in self.settings.strides:
            self.restore(saved)
            solution.x = x.copy()
            try:
                pieces = shorter * self._along(solution, way, shorter * stride)
            except ConvergenceError as error:
                lost = lost or error
                continue
            if pieces <= FEW_PIECES or len(self.settings.strides) == 1:
                return
            ends.append(self._end(solution.x))
            if agree(ends):
                return
        raise lost if len(ends) < 2 and lost is not None else several(ends)

    def _end(self, x: Array) -> End:
        """Return what is compared of the solution ``x`` that ends a walk."""
        report = np.concatenate([item.reported(x) for item in self.items])
        within = sum(item.reported_within(x) for item in self.items)
        return End(x[: 3 * len(self.positions)].reshape(-1, 3), report, within)

    def _along(self, solution: Solution, way: Sequence[Moment], stride: float) -> int:
        """Go a ``way`` from its first moment; return the most pieces that one of its parts took."""
        pieces = 0
        for k, (here, there) in enumerate(itertools.pairwise(way)):
            if k:
                self._pass(solution.x)
            pieces = max(pieces, self._walk(solution, here, there, stride, last=k == len(way) - 2))
        return pieces

    def _walk(self, solution: Solution, start: Moment, moment: Moment, stride: float, *, last: bool) -> int:
        """Walk from the solution at ``start`` to the one at ``moment``, in steps that are ``stride`` times as long as
        all items admit; a step that fails is halved. Returns how many steps that were cut it took. `ConvergenceError`
        if they get too short, with history as it was at the last step."""
        done, most, pieces, piece = 0.0, 1.0, 0, 0.0
        while done < 1.0:
            furthest = min(item.furthest(solution.x, start, moment, done) for item in self.items)
            if pieces or furthest < 1.0:
                pieces += 1
                length = stride * (furthest - done)  # all that is left: in equal pieces, or there is no end
                furthest = done + (length if furthest < 1.0 else max(length, piece))
                furthest = furthest if furthest < 1.0 - NEARLY else 1.0
            s = min(done + most, furthest)
            before, state, wasted = solution.x, self.save(), solution.wasted
            for item in self.items:
                item.hurry(on_the_way=not last or s < 1.0)
            try:
                solution.x = self._equilibrium(before, moment.part_way(start, s), solution, rough=not last or s < 1.0)
                solution.n_steps += 1
                solution.n_useful = solution.n_iterations - int(wasted.iterations)
                solution.n_useful_factorisations = solution.n_factorisations - int(wasted.factorisations)
                done, most, piece = s, 2.0 * (s - done), s - done
                if done < 1.0:
                    self._pass(solution.x)
            except (Lost, ConvergenceError) as lost:
                self.restore(state)
                solution.x = before
                most = 0.5 * (s - done)
                if most < self.settings.smallest_step * (furthest - done) or solution.n_steps >= MOST_STEPS:
                    raise self._explain(lost, done) from lost
                if self._impatient(solution, moment):
                    raise self._explain(lost, done) from lost
        return pieces

    def _pass(self, x: Array) -> None:
        for item in self.items:
            item.passed(x)

    def solve_at_once(self, x: Array, moment: Moment) -> Solution:
        """Solve for the equilibrium at ``moment`` from a start ``x`` that is near it, in one step; otherwise as
        `solve`."""
        saved, solution = self.save(), Solution(x)
        try:
            if self.settings.near_starts and not all(item.near(x, moment) for item in self.items):
                raise Lost("the start is too far from the solution")
            solution.x = self._equilibrium(x, moment, solution)
        except (Lost, ConvergenceError) as lost:
            self.restore(saved)
            self._fail(solution)
            raise self._explain(lost, 0.0) from lost
        return solution

    def _fail(self, solution: Solution) -> None:
        """Note what a start took that led nowhere."""
        if self.settings.once:
            self._failed = Work(*(a + b for a, b in zip(self._failed, solution.wasted, strict=True)))

    def save(self) -> list[Any]:
        """Return the items' states."""
        return [item.save() for item in self.items]

    def restore(self, states: list[Any]) -> None:
        """Roll the items back."""
        for item, state in zip(self.items, states, strict=True):
            item.restore(state)

    def _explain(self, lost: Lost | ConvergenceError, done: float) -> ConvergenceError:
        if isinstance(lost, ConvergenceError):  # an item's own
            return ConvergenceError(lost.what, where=f"after {100.0 * done:.0f} % of the load step", remedy=lost.remedy)
        worst = ""
        if lost.dof is not None:
            point = self.positions[min(lost.dof // 3, len(self.positions) - 1)]
            worst = f", worst at ({', '.join(f'{1e3 * c:.1f}' for c in point)}) mm"
        return ConvergenceError(
            f"no equilibrium was found ({lost.why})",
            where=f"after {100.0 * done:.0f} % of the load step{worst}",
            remedy="move the probe in smaller steps, check support and modulus (a soft body may buckle or collapse "
            "under its weight), or refine the mesh there",
        )

    def _verify(self, x: Array) -> None:
        """`ConvergenceError` if an item says that the solution ``x`` does not mean what it should."""
        for item in self.items:
            if found := item.flaw(x):
                raise ConvergenceError(
                    f"a wrong equilibrium was found: {found}",
                    where="solver",
                    remedy="move the probe in smaller steps, check its pose, or refine the mesh under it",
                )

    # -- Newton ----------------------------------------------------------------------------------------------------

    def _equilibrium(self, x: Array, moment: Moment, count: Solution, *, rough: bool = False) -> Array:
        """The equilibrium at ``moment``, from ``x``; as exact as its way needs it if ``rough``."""
        self._check_left()
        for item in self.items:
            item.prepare(moment)
        if (found := self._by_condensing(x, moment, count)) is not None:
            return found
        tolerance, in_motion = self.settings.tolerance, self.settings.in_motion
        for _ in range(self.settings.max_updates):
            x = self._newton(x, moment, count, tolerance if in_motion else LOOSER * tolerance)
            if not any([item.update(x) for item in self.items]):  # every item is asked
                if not in_motion:
                    self.learned.clear()
                if not (rough or in_motion):
                    x = self._newton(x, moment, count, tolerance)
                self._verify(x)
                return x
        raise Lost("the outer iteration of contact, friction or plastic flow does not settle")

    def _by_condensing(self, x: Array, moment: Moment, count: Solution) -> Array | None:
        """Return the equilibrium at the prepared ``moment`` from ``x``, contact solved whole in each step; None where
        that may not be, or does not lead there."""
        search = self._condensed
        if search is None or moment.pose is None or np.any(self._hold(x)):
            return None
        saved = self.save()
        try:
            x = search.find(x, self._held, self.settings.tolerance, self.size)
            self._verify(x)
        except (NotFound, ConvergenceError):
            search.forget()
            self.restore(saved)
            return None
        finally:
            count.n_iterations += search.n_steps
            count.n_factorisations += search.n_factorisations
            self.left -= search.n_steps
        self.has_factor = False
        return x

    def _learn_usual(self, solution: Solution) -> None:
        steps = max(solution.n_steps, 1)
        new = Work(solution.n_useful / steps, solution.n_useful_factorisations / steps)
        self._usual = Work(*(old + (now - old) * LATELY for old, now in zip(self._usual, new, strict=True)))

    def _impatient(self, count: Solution, moment: Moment) -> bool:
        """Return whether ``moment`` is to be given up. One with a probe is one of many, and the next is not far."""
        settings = self.settings
        iterations, factorisations = (a + b for a, b in zip(self._failed, count.wasted, strict=True))
        share = 0.5 if settings.once and self._gave_up else 1.0
        if iterations >= share * max(settings.least_patience, settings.patience * self._usual.iterations):
            return True
        usual = max(settings.least_usual, self._usual.factorisations)
        return moment.pose is not None and factorisations >= share * settings.patience * usual

    def _check_left(self) -> None:
        if self.left <= 0.0:
            raise Lost(NOT_ENOUGH)

    def _newton(self, x: Array, moment: Moment, count: Solution, tolerance: float) -> Array:
        if self._impatient(count, moment):
            spent = self._failed.iterations + count.wasted.iterations
            raise Lost(f"given up after {spent:.0f} iterations that led nowhere")
        self._check_left()
        x, imposed = self._impose(x.copy(), count)
        if not imposed and any(item.tangent_changes(x) for item in self.items):
            self.has_factor = False
        energy = self.evaluate(x, self.system, tangent=not self.has_factor)
        search = Newton(self, x, energy, tolerance, self.settings.keep_factor_rate)
        try:
            return search.run(self.settings.max_iterations)
        finally:
            count.n_iterations += search.n_iterations
            self.left -= search.n_iterations
            count.n_factorisations += search.n_factorisations

    # -- parts -----------------------------------------------------------------------------------------------------

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        """Sum the residual (and tangent) of all items; return the energy, NaN if one of them has none."""
        system.clear(tangent=tangent)
        return sum(item.evaluate(x, system, tangent=tangent) for item in self.items)

    def expect(self, x: Array, dx: Array | None) -> None:
        """Tell the items where the search goes."""
        for item in self.items:
            item.expect(x, dx)

    def factorise(self, x: Array) -> None:
        """Factorise the tangent in ``system``; where it is not positive definite (buckling, or far from
        equilibrium), a safe one at ``x``, and at last one with a larger diagonal: they still lead downhill."""
        if self._try_factor(0.0):
            return
        r, system = self.system.r.copy(), self.system
        system.safe = True
        self.evaluate(x, system, tangent=True)
        system.safe = False
        system.r[:] = r
        for shift in (0.0, 0.02, 0.2):
            if self._try_factor(shift):
                return
        raise Lost("the tangent stays indefinite: buckling, or a body that is not held")

    def _try_factor(self, shift: float) -> bool:
        values, diagonal = self.system.values, self.pattern.diagonal
        scale = float(np.abs(values[diagonal]).mean())
        values[self._touching] = 0.0
        values[diagonal[self._held]] = scale
        values[diagonal] += shift * np.abs(values[diagonal])
        try:
            self.linear.factorise(self.system)
        except FactorisationError:
            self.has_factor = False
            return False
        self.has_factor = True
        return True

    def factorise_at(self, x: Array) -> None:
        """Factorise the tangent of the prepared items at ``x``; `ConvergenceError` if it cannot be."""
        self.answering = self.linear
        self._hold(x)
        self.expect(x, None)
        self.evaluate(x, self.system, tangent=True)
        try:
            self.factorise(x)
        except Lost as lost:
            raise self._explain(lost, 0.0) from lost

    def linearise_at(self, x: Array) -> None:
        """Have ``answering`` solve for small changes beside the solution ``x`` of the prepared moment: with the
        tangent's factor, or one with what that leaves out. `ConvergenceError` if it cannot be."""
        more = self.feedback(x)
        if not more:
            self.factorise_at(x)
            return
        self._hold(x)
        self.expect(x, None)
        self.evaluate(x, self.system, tangent=True)
        self.answering = self.whole(self.system, more)

    def feedback(self, x: Array) -> list[Feedback]:
        """Return what the items' tangents at the solution ``x`` leave out."""
        return [more for item in self.items if (more := item.feedback(x)) is not None]

    def whole(self, system: System, more: Sequence[Feedback]) -> WholeTangent:
        """Return the factorised tangent in ``system``, held dofs out, with what there is ``more``."""
        self._whole = self._whole or WholeTangent(self.pattern, n_negative=self.n_negative, threads=self.threads)
        try:
            self._whole.factorise(system, more, self._held)
        except FactorisationError as error:
            raise self._explain(Lost("the tangent is singular"), 0.0) from error
        return self._whole

    def response(self, part: Local, load: Array, x: Array) -> Array:
        """Return how the unknowns (n_dof,) yield to a small ``load`` (n_dof,) N on the facets of a contact's ``part``
        at the solution ``x``, roughly: a factor of nearly there will do. `ConvergenceError` without any."""
        found = None if self._condensed is None else self._condensed.response(part, load, x)
        if found is not None:
            return found
        self.factorise_at(x)
        found = self.linear.solve(self.free(load))
        self.drop_factor()
        return found

    def drop_factor(self) -> None:
        """Let the next solution start with a fresh tangent."""
        self.has_factor = False

    def _impose(self, x: Array, count: Solution) -> tuple[Array, bool]:
        """Bring the held dofs to their values, the others with them to first order; return whether there is a fresh
        factor now that leads on from there. Far starts, as those of another mesh, upset volumes: their tangent is a
        safe one, which leads on."""
        jump = self._hold(x)
        if not np.any(jump):
            return x, False
        far = self.system.safe = not self.settings.near_starts
        self.evaluate(x, self.system, tangent=True)
        self.system.safe = False
        load = self.system.r + self.system.times(jump)
        self.factorise(x)
        count.n_factorisations += 1
        return x + jump - self.linear.solve(self.free(load)), far

    def _hold(self, x: Array) -> Array:
        """Note the held dofs and what they touch in the pattern; return what they lack (n_dof,)."""
        parts = [item.constraints() for item in self.items]
        dofs = np.concatenate([d for d, _ in parts]) if parts else np.zeros(0, np.int64)
        values = np.concatenate([v for _, v in parts]) if parts else np.zeros(0)
        held, first = np.unique(dofs, return_index=True)
        if not np.array_equal(held, self._held):
            self._held, self._touching = held, self.pattern.touching(held)
            self.has_factor = False
        jump = np.zeros_like(x)
        jump[held] = values[first] - x[held]
        return jump

    def free(self, r: Array) -> Array:
        out = r.copy()
        out[self._held] = 0.0
        return out

    def step_size(self, dx: Array) -> float:
        return float(np.abs(dx[: 3 * len(self.positions)]).max())
