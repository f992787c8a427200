"""Equilibrium: Newton's method with a line search, a kept factor, and load steps that adapt.

The solver sums items (`fem_node.items`) and knows nothing else of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fem_node.assembly import Pattern, System
from fem_node.items import Item, Moment
from fem_node.linear_solver import FactorisationError, LinearSolver, make_linear_solver
from livedeform_common.errors import ConvergenceError
from livedeform_common.types import Array

WATCHDOG = 0.5  # a step on trial must shorten the next correction to this
MOST_PAIRS = 20  # of steps and forces that a kept factor is corrected by
PATIENCE = 3  # iterations that may be slow before a corrected factor is made again
SHARPER = 0.05  # of the tolerance, with an old factor: what is left is a part of the step, not its square
LOOSER = 20.0  # how much less exactly equilibrium is solved while multipliers and plastic set still move


@dataclass(frozen=True)
class SolverSettings:
    """When a solution is accepted, and how long it is tried.

    ``tolerance`` m: the largest nodal correction of the last Newton step (the error left is far below it);
    ``keep_factor_rate``: corrections must shrink by this per iteration while an old factor is used.
    """

    tolerance: float = 1e-8
    max_iterations: int = 80
    max_updates: int = 60
    smallest_step: float = 1.0 / 128.0
    keep_factor_rate: float = 0.5


@dataclass
class Solution:
    """An equilibrium: ``x`` (n_dof,), Newton iterations, factorisations and load steps that it took."""

    x: Array
    n_iterations: int = 0
    n_factorisations: int = 0
    n_steps: int = 1


@dataclass(frozen=True)
class _Lost(Exception):
    """A Newton solution was not found; ``dof`` where it is worst."""

    why: str
    dof: int = 0


@dataclass(frozen=True)
class _Trial:
    """Where a full step was taken on trial: x, the step, its size, the slope along it, and the energy."""

    x: Array
    dx: Array
    size: float
    slope: float
    energy: float


class _Learned:
    """What pairs of a step and the change of the forces along it say of the tangent, on top of a factor: the limited
    BFGS update of its inverse (Nocedal 1980)."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Array, Array, float]] = []

    def clear(self) -> None:
        """A fresh factor knows better."""
        self.pairs.clear()

    def add(self, step: Array, change: Array) -> None:
        """A step (n,) and the change of the residual (n,), where the energy is convex along it."""
        along = float(step @ change)
        if along > 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            self.pairs = [*self.pairs[1 - MOST_PAIRS :], (step, change, along)]

    def step(self, linear: LinearSolver, r: Array) -> Array:
        """The corrected -K^-1 r (n,)."""
        q, weights = r.copy(), []
        for step, change, along in reversed(self.pairs):
            weights.append(float(step @ q) / along)
            q -= weights[-1] * change
        d = linear.solve(q)
        for (step, change, along), weight in zip(self.pairs, reversed(weights), strict=True):
            d += (weight - float(change @ d) / along) * step
        return -d


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
        self._has_factor = False
        self._learns = self.pattern.symmetric and not self.n_negative
        self._patience = PATIENCE if self._learns else 0
        self.size = float(np.ptp(self.positions, axis=0).max())

    # -- one moment ------------------------------------------------------------------------------------------------

    def solve(self, x: Array, moment: Moment, start: Moment) -> Solution:
        """The equilibrium at ``moment`` from the equilibrium ``x`` at ``start``; history is not committed yet.

        On failure everything is rolled back and `ConvergenceError` raised.
        """
        saved = self.save()
        solution = Solution(x.copy(), n_steps=0)
        done, step = 0.0, 1.0
        while done < 1.0:
            s = min(done + step, 1.0)
            before, state = solution.x, self.save()
            try:
                solution.x = self._equilibrium(before, moment.part_way(start, s), solution)
                done, step = s, 2.0 * step
                solution.n_steps += 1
            except (_Lost, ConvergenceError) as lost:
                self.restore(state)
                solution.x = before
                step = 0.5 * min(step, 1.0 - done)
                if step < self.settings.smallest_step:
                    self.restore(saved)
                    raise self._explain(lost, done) from lost
        return solution

    def save(self) -> list[Any]:
        """The items' states."""
        return [item.save() for item in self.items]

    def restore(self, states: list[Any]) -> None:
        """Rolls the items back."""
        for item, state in zip(self.items, states, strict=True):
            item.restore(state)

    def _explain(self, lost: _Lost | ConvergenceError, done: float) -> ConvergenceError:
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

    # -- Newton ----------------------------------------------------------------------------------------------------

    def _equilibrium(self, x: Array, moment: Moment, count: Solution) -> Array:
        for item in self.items:
            item.prepare(moment)
        tolerance = self.settings.tolerance
        for _ in range(self.settings.max_updates):
            x = self._newton(x, count, LOOSER * tolerance)
            if not any([item.update(x) for item in self.items]):  # every item is asked
                return self._newton(x, count, tolerance)
        raise _Lost("the outer iteration of contact, friction or plastic flow does not settle")

    def _newton(self, x: Array, count: Solution, tolerance: float) -> Array:
        """Newton's method; an old factor is kept while it makes the corrections shrink, corrected by what the forces
        have shown since (BFGS; Matthies & Strang 1979).

        A full step that raises the energy is taken on trial where the factor is fresh: a nearly incompressible body's
        energy first rises with the volume error of second order, and Newton is right nevertheless. If the next
        correction is not clearly smaller, the step is taken back and shortened (watchdog; Chamberlain et al. 1982).
        """
        s = self.settings
        x = self._impose(x.copy(), count)
        if any(item.tangent_changes(x) for item in self.items):
            self._has_factor = False
        energy = self.evaluate(x, self.system, tangent=not self._has_factor)
        learned = _Learned()
        here = False  # whether the factor belongs to x itself
        best = np.inf  # the smallest correction since the last factor
        slow = 0  # iterations since it last shrank as it should
        trial: _Trial | None = None
        for _ in range(s.max_iterations):
            count.n_iterations += 1
            if not self._has_factor:
                energy = self.evaluate(x, self.system, tangent=True)
                self._factorise(x)
                count.n_factorisations += 1
                learned.clear()
                here, best, slow = True, np.inf, 0
            r = self._free(self.system.r)
            dx = learned.step(self.linear, r)
            size = self._size(dx)
            if trial is not None and here:
                if size > WATCHDOG * trial.size:
                    self._expect(x, None)
                    x, energy = self._shortened(trial)
                    self._has_factor, here, trial = False, False, None
                    continue
                trial = None
            slope = float(r @ dx)
            new = self.evaluate(x + dx, self.system, tangent=False) if size <= self.size else np.inf
            new_r = self._free(self.system.r)
            if self._better(energy, new, slope, float(new_r @ dx), 1.0):
                if size < (1.0 if here else SHARPER) * tolerance:
                    return x + dx
            elif size < 1e3 * tolerance and here:
                return x  # round-off: nothing better can be found
            elif here:
                trial = _Trial(x, dx, size, slope, energy)
                if not np.all(np.isfinite(self.system.r)) or np.isinf(new):
                    x, energy = self._shortened(trial)
                    self._has_factor, here, trial = False, False, None
                    continue
            else:  # an old factor misleads, but part of the way may be good
                found = self._partly(_Trial(x, dx, size, slope, energy), 3)
                if found is None:
                    energy = self.evaluate(x, self.system, tangent=False)
                    self._has_factor = False
                    continue
                length, new = found
                dx, size, new_r = length * dx, length * size, self._free(self.system.r)
            x, energy = x + dx, new
            if self._learns:
                learned.add(dx, new_r - r)
            slow = 0 if size <= s.keep_factor_rate * best else slow + 1
            best = min(best, size)
            if trial is not None or slow > self._patience:
                self._expect(x - dx, dx)
                self._has_factor = False
            here = False
        raise _Lost(f"{s.max_iterations} Newton iterations were not enough", int(np.argmax(np.abs(dx))))

    def _shortened(self, trial: _Trial) -> tuple[Array, float]:
        """A part of the step that lowers the energy, and the energy there."""
        found = self._partly(trial, 10)
        if found is None:
            raise _Lost("no step lowers the energy", int(np.argmax(np.abs(trial.dx[: 3 * len(self.positions)]))))
        length, new = found
        return trial.x + length * trial.dx, new

    def _partly(self, trial: _Trial, halvings: int) -> tuple[float, float] | None:
        """The largest half, quarter, ... of the step that lowers the energy, and the energy there (the residual there
        is in ``system``)."""
        length = 0.5
        for _ in range(halvings):
            new = self.evaluate(trial.x + length * trial.dx, self.system, tangent=False)
            new_slope = float(self._free(self.system.r) @ trial.dx)
            if trial.size * length <= self.size and self._better(trial.energy, new, trial.slope, new_slope, length):
                return length, new
            length *= 0.5
        return None

    @staticmethod
    def _better(energy: float, new: float, slope: float, new_slope: float, length: float) -> bool:
        """Armijo on the energy; where there is none, or it drowns in round-off, the force along the step must
        shrink."""
        noise = 1e-11 * abs(energy)
        if np.isfinite(energy) and abs(slope) > noise:
            return bool(np.isfinite(new) and new <= energy + 1e-4 * length * slope)
        return bool(np.isfinite(new_slope) and abs(new_slope) <= (1.0 if length < 1.0 else 1.5) * abs(slope) + noise)

    def _expect(self, x: Array, dx: Array | None) -> None:
        for item in self.items:
            item.expect(x, dx)

    # -- parts -----------------------------------------------------------------------------------------------------

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        """Residual (and tangent) of all items; the energy, NaN if one of them has none."""
        system.clear(tangent=tangent)
        return sum(item.evaluate(x, system, tangent=tangent) for item in self.items)

    def _factorise(self, x: Array) -> None:
        """Factorises the tangent in ``system``; where it is not positive definite (buckling, or far from
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
        raise _Lost("the tangent stays indefinite: buckling, or a body that is not held")

    def _try_factor(self, shift: float) -> bool:
        values, diagonal = self.system.values, self.pattern.diagonal
        scale = float(np.abs(values[diagonal]).mean())
        values[self._touching] = 0.0
        values[diagonal[self._held]] = scale
        values[diagonal] += shift * np.abs(values[diagonal])
        try:
            self.linear.factorise(self.system)
        except FactorisationError:
            self._has_factor = False
            return False
        self._has_factor = True
        return True

    def factorise_at(self, x: Array) -> None:
        """The tangent of the prepared items at ``x``, factorised; `ConvergenceError` if it cannot be."""
        self._hold(x)
        self._expect(x, None)
        self.evaluate(x, self.system, tangent=True)
        try:
            self._factorise(x)
        except _Lost as lost:
            raise self._explain(lost, 0.0) from lost

    def drop_factor(self) -> None:
        """The next solution starts with a fresh tangent."""
        self._has_factor = False

    def _impose(self, x: Array, count: Solution) -> Array:
        """Brings the held dofs to their values, the others with them to first order."""
        jump = self._hold(x)
        if not np.any(jump):
            return x
        self.evaluate(x, self.system, tangent=True)
        load = self.system.r + self.system.times(jump)
        self._factorise(x)
        count.n_factorisations += 1
        return x + jump - self.linear.solve(self._free(load))

    def _hold(self, x: Array) -> Array:
        """Notes the held dofs and what they touch in the pattern; returns what they lack (n_dof,)."""
        parts = [item.constraints() for item in self.items]
        dofs = np.concatenate([d for d, _ in parts]) if parts else np.zeros(0, np.int64)
        values = np.concatenate([v for _, v in parts]) if parts else np.zeros(0)
        held, first = np.unique(dofs, return_index=True)
        if not np.array_equal(held, self._held):
            self._held, self._touching = held, self.pattern.touching(held)
            self._has_factor = False
        jump = np.zeros_like(x)
        jump[held] = values[first] - x[held]
        return jump

    def _free(self, r: Array) -> Array:
        out = r.copy()
        out[self._held] = 0.0
        return out

    def _size(self, dx: Array) -> float:
        return float(np.abs(dx[: 3 * len(self.positions)]).max())
