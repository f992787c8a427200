"""Equilibrium: Newton's method with a line search, a kept factor, and load steps that adapt.

The solver sums items (`fem_node.items.protocol`) and knows nothing else of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import GAP_TOLERANCE
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.solve.assembly import Pattern, System
from livedeform.fem_node.solve.linear_solver import FactorisationError, LinearSolver, make_linear_solver
from livedeform.fem_node.solve.newton import Learned, Lost, Newton

LATELY = 0.2  # weight of a moment's iterations in their mean
MOST_STEPS = 200  # of one walk
LOOSER = 20.0  # how much less exactly equilibrium is solved while multipliers and plastic set still move


@dataclass(frozen=True)
class SolverSettings:
    """Settings that say when a solution is accepted, and how long it is tried.

    ``tolerance`` m: the largest nodal correction of the last Newton step (the error left is far below it);
    ``gap_tolerance`` m: how far a point under the probe may be from complementarity; ``keep_factor_rate``: corrections
    must shrink by this per iteration while an old factor is used; ``patience``: iterations on steps that fail, in usual
    solutions' iterations and at least ``least_patience``, after which a moment is given up.
    """

    tolerance: float = 1e-8
    gap_tolerance: float = GAP_TOLERANCE
    max_iterations: int = 80
    max_updates: int = 60
    smallest_step: float = 1.0 / 128.0
    keep_factor_rate: float = 0.5
    patience: float = 10.0
    least_patience: int = 400


@dataclass
class Solution:
    """An equilibrium: ``x`` (n_dof,), Newton iterations, factorisations and load steps that it took; ``n_useful`` of
    the iterations led to a load step that was accepted."""

    x: Array
    n_iterations: int = 0
    n_factorisations: int = 0
    n_steps: int = 1
    n_useful: int = 0

    @property
    def n_wasted(self) -> int:
        """Iterations that led nowhere yet."""
        return self.n_iterations - self.n_useful


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
        self.pattern = Pattern(self.n_dof, groups, symmetric=all(item.symmetric for item in self.items))
        for item in self.items:
            item.attach(self.pattern)
        self.system = System(self.pattern)
        self.linear: LinearSolver = make_linear_solver(self.pattern, n_negative=self.n_negative, threads=self.threads)
        self._held: NDArray[np.int64] = np.zeros(0, np.int64)
        self._touching: NDArray[np.int64] = np.zeros(0, np.int64)
        self.has_factor = False
        self.learned = Learned()
        self.learns = self.pattern.symmetric and not self.n_negative
        self.size = float(np.ptp(self.positions, axis=0).max())
        self._usual = 0.0  # iterations of a moment, the mean of the last few

    # -- one moment ------------------------------------------------------------------------------------------------

    def solve(self, x: Array, moment: Moment, start: Moment) -> Solution:
        """Solve for the equilibrium at ``moment`` from the equilibrium ``x`` at ``start``; history is not committed
        yet.

        On failure everything is rolled back and `ConvergenceError` raised.
        """
        ways = [way for item in self.items for way in item.ways(x, start, moment)] or [[moment]]
        saved, solution = self.save(), Solution(x, n_steps=0)
        lost: ConvergenceError | None = None
        for way in ways:
            self.restore(saved)
            solution.x, here = x.copy(), start
            try:
                for there in way:
                    if here is not start:
                        self._pass(solution.x)
                    self._walk(solution, here, there)
                    here = there
                self._usual += (solution.n_useful - self._usual) * LATELY
                return solution
            except ConvergenceError as error:
                lost = lost or error
        self.restore(saved)
        assert lost is not None  # there is at least one way
        raise lost

    def _walk(self, solution: Solution, start: Moment, moment: Moment) -> None:
        """Walk from the solution at ``start`` to the one at ``moment``, in steps that are as long as all items admit; a
        step that fails is halved. `ConvergenceError` if that gets too short, with history as it was at the last
        step."""
        done, most = 0.0, 1.0
        while done < 1.0:
            furthest = min(item.furthest(solution.x, start, moment, done) for item in self.items)
            s = min(done + most, furthest)
            before, state, wasted = solution.x, self.save(), solution.n_wasted
            try:
                solution.x = self._equilibrium(before, moment.part_way(start, s), solution)
                solution.n_steps += 1
                solution.n_useful = solution.n_iterations - wasted
                done, most = s, 2.0 * (s - done)
                if done < 1.0:
                    self._pass(solution.x)
            except (Lost, ConvergenceError) as lost:
                self.restore(state)
                solution.x = before
                most = 0.5 * (s - done)
                if most < self.settings.smallest_step * (furthest - done) or solution.n_steps >= MOST_STEPS:
                    raise self._explain(lost, done) from lost
                if solution.n_wasted >= self._patience:
                    raise self._explain(lost, done) from lost

    def _pass(self, x: Array) -> None:
        for item in self.items:
            item.passed(x)

    def solve_at_once(self, x: Array, moment: Moment) -> Solution:
        """Solve for the equilibrium at ``moment`` from a start ``x`` that is near it, in one step; otherwise as
        `solve`."""
        saved, solution = self.save(), Solution(x)
        try:
            if any(item.furthest(x, moment, moment, 0.0) < 1.0 for item in self.items):
                raise Lost("the start is too far from the solution")
            solution.x = self._equilibrium(x, moment, solution)
        except (Lost, ConvergenceError) as lost:
            self.restore(saved)
            raise self._explain(lost, 0.0) from lost
        return solution

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
        point = self.positions[min(lost.dof // 3, len(self.positions) - 1)]
        place = ", ".join(f"{1e3 * c:.1f}" for c in point)
        return ConvergenceError(
            f"no equilibrium was found ({lost.why})",
            where=f"after {100.0 * done:.0f} % of the load step, worst at ({place}) mm",
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

    def _equilibrium(self, x: Array, moment: Moment, count: Solution) -> Array:
        for item in self.items:
            item.prepare(moment)
        tolerance = self.settings.tolerance
        for _ in range(self.settings.max_updates):
            x = self._newton(x, count, LOOSER * tolerance)
            if not any([item.update(x) for item in self.items]):  # every item is asked
                self.learned.clear()
                x = self._newton(x, count, tolerance)
                self._verify(x)
                return x
        raise Lost("the outer iteration of contact, friction or plastic flow does not settle")

    @property
    def _patience(self) -> int:
        return max(self.settings.least_patience, int(self.settings.patience * self._usual))

    def _newton(self, x: Array, count: Solution, tolerance: float) -> Array:
        if count.n_wasted >= self._patience:
            raise Lost(f"given up after {count.n_wasted} iterations that led nowhere")
        x = self._impose(x.copy(), count)
        if any(item.tangent_changes(x) for item in self.items):
            self.has_factor = False
        energy = self.evaluate(x, self.system, tangent=not self.has_factor)
        search = Newton(self, x, energy, tolerance, self.settings.keep_factor_rate)
        try:
            return search.run(self.settings.max_iterations)
        finally:
            count.n_iterations += search.n_iterations
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
        self._hold(x)
        self.expect(x, None)
        self.evaluate(x, self.system, tangent=True)
        try:
            self.factorise(x)
        except Lost as lost:
            raise self._explain(lost, 0.0) from lost

    def drop_factor(self) -> None:
        """Let the next solution start with a fresh tangent."""
        self.has_factor = False

    def _impose(self, x: Array, count: Solution) -> Array:
        """Bring the held dofs to their values, the others with them to first order."""
        jump = self._hold(x)
        if not np.any(jump):
            return x
        self.evaluate(x, self.system, tangent=True)
        load = self.system.r + self.system.times(jump)
        self.factorise(x)
        count.n_factorisations += 1
        return x + jump - self.linear.solve(self.free(load))

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
