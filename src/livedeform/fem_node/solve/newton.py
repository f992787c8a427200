"""One search for an equilibrium: Newton's method with a line search on the energy and a factor that is kept.

An old factor is kept while it makes the corrections shrink, corrected by what the forces have shown since (BFGS;
Matthies & Strang 1979). A full step that raises the energy is taken on trial where the factor is fresh: a nearly
incompressible body's energy first rises with the volume error of second order, and Newton is right nevertheless. If
the next correction is not clearly smaller, the step is taken back and shortened (watchdog; Chamberlain et al. 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.linear_solver import LinearSolver

WATCHDOG = 0.5  # a step on trial must shorten the next correction to this
MOST_PAIRS = 20  # of steps and forces that a kept factor is corrected by
PATIENCE = 3  # iterations that may be slow before a corrected factor is made again
SHARPER = 0.02  # of the tolerance, with an old factor: what is left is a part of the step, not its square
ROUND_OFF = 1e-5  # m: a correction that is smaller, and still does not better the energy, drowns in round-off


@dataclass(frozen=True)
class Lost(Exception):
    """No equilibrium was found; ``dof`` where it is worst, if that is known."""

    why: str
    dof: int | None = None


class Tangents(Protocol):
    """The part of the solver that the search needs: its system of equations, with the factor that is kept."""

    system: System
    linear: LinearSolver
    size: float  # m, of the body: no step is larger
    learns: bool  # whether the tangent is symmetric and positive definite, so that BFGS may correct its factor
    learned: Learned  # since the factor was made: it is kept as long as that
    has_factor: bool

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float: ...

    def factorise(self, x: Array) -> None: ...

    def free(self, r: Array) -> Array: ...

    def step_size(self, dx: Array) -> float: ...

    def expect(self, x: Array, dx: Array | None) -> None: ...


class _Step(NamedTuple):
    """A step from ``x`` by ``dx``, of ``size`` m; the residual ``r``, the ``energy``, and its ``slope`` along the step
    there."""

    x: Array
    dx: Array
    size: float
    r: Array
    energy: float
    slope: float

    def shortened(self, length: float) -> _Step:
        """Return a part of it."""
        return self._replace(dx=length * self.dx, size=length * self.size)


class Learned:
    """Pairs of a step and the change of the forces along it, which say more of the tangent, on top of a factor: the
    limited BFGS update of its inverse (Nocedal 1980)."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Array, Array, float]] = []

    def clear(self) -> None:
        """Forget the pairs: a fresh factor knows better."""
        self.pairs.clear()

    def add(self, step: Array, change: Array) -> None:
        """Take in a step (n,) and the change of the residual (n,), where the energy is convex along it."""
        along = float(step @ change)
        if along > 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            self.pairs = [*self.pairs[1 - MOST_PAIRS :], (step, change, along)]

    def step(self, linear: LinearSolver, r: Array) -> Array:
        """Return the corrected -K^-1 r (n,)."""
        q, weights = r.copy(), []
        for step, change, along in reversed(self.pairs):
            weights.append(float(step @ q) / along)
            q -= weights[-1] * change
        d = linear.solve(q)
        for (step, change, along), weight in zip(self.pairs, reversed(weights), strict=True):
            d += (weight - float(change @ d) / along) * step
        return -d


class Newton:
    """A search from ``x`` (n_dof,), where the residual (and, without a factor, the tangent) is in the solver's system
    already and the energy is ``energy``; `run` ends it."""

    def __init__(self, solver: Tangents, x: Array, energy: float, tolerance: float, keep_factor_rate: float) -> None:
        self.solver, self.x, self.energy = solver, x, energy
        self.tolerance, self.keep_factor_rate = tolerance, keep_factor_rate
        self.n_iterations = self.n_factorisations = 0
        self._patience = PATIENCE if solver.learns else 0
        self._here = False  # whether the factor belongs to x itself
        self._best = np.inf  # the smallest correction since the last factor
        self._slow = 0  # iterations since it last shrank as it should
        self._trial: _Step | None = None
        self._last = np.zeros_like(x)

    def run(self, max_iterations: int) -> Array:
        """Return the equilibrium (n_dof,); `Lost` if there is none to be found."""
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far may have no finite energy: it is taken back
            for _ in range(max_iterations):
                self.n_iterations += 1
                found = self._iterate()
                if found is not None:
                    return found
        raise Lost(f"{max_iterations} Newton iterations were not enough", int(np.argmax(np.abs(self._last))))

    def _iterate(self) -> Array | None:
        """Take one correction; return the equilibrium once it is there."""
        if not self.solver.has_factor and not self._has_fresh_factor():
            return None
        step = self._full_step()
        if self._trial is not None and self._here:
            if step.size > WATCHDOG * self._trial.size:
                self.solver.expect(self.x, None)
                self._go_back(self._trial)
                return None
            self._trial = None
        new = self._energy_after(step)
        new_r = self.solver.free(self.solver.system.r)
        if _better(step, new, float(new_r @ step.dx), 1.0):
            if step.size < (1.0 if self._here else SHARPER) * self.tolerance:
                return self.x + step.dx
        elif step.size < ROUND_OFF and self._here:
            return self.x
        elif self._here:
            if not np.all(np.isfinite(self.solver.system.r)) or np.isinf(new):
                self._go_back(step)
                return None
            self._trial = step
        else:  # an old factor misleads, but part of the way may be good
            found = self._partly(step, 3)
            if found is None:
                self.energy = self.solver.evaluate(self.x, self.solver.system, tangent=False)
                self.solver.has_factor = False
                return None
            length, new = found
            step, new_r = step.shortened(length), self.solver.free(self.solver.system.r)
        self._accept(step, new, new_r)
        return None

    def _factorise(self) -> None:
        """Make a fresh factor at x."""
        self.energy = self.solver.evaluate(self.x, self.solver.system, tangent=True)
        self.solver.factorise(self.x)
        self.n_factorisations += 1
        self.solver.learned.clear()
        self._here, self._best, self._slow = True, np.inf, 0

    def _has_fresh_factor(self) -> bool:
        """Make a fresh factor; return False, back where a step on trial began, if that leads to where there is none: it
        may have crushed elements."""
        try:
            self._factorise()
        except Lost:
            if self._trial is None:
                raise
            self.solver.expect(self.x, None)
            self._go_back(self._trial)
            return False
        return True

    def _full_step(self) -> _Step:
        """Return Newton's step, with what has been learned since the factor was made."""
        r = self.solver.free(self.solver.system.r)
        dx = self._last = self.solver.learned.step(self.solver.linear, r)
        return _Step(self.x, dx, self.solver.step_size(dx), r, self.energy, float(r @ dx))

    def _energy_after(self, step: _Step) -> float:
        """Return the energy where the step leads (the residual there is in the system); inf for one that is larger than
        the body."""
        if not step.size <= self.solver.size:
            return np.inf
        return self.solver.evaluate(self.x + step.dx, self.solver.system, tangent=False)

    def _accept(self, step: _Step, energy: float, r: Array) -> None:
        """Take the step; the factor is kept while it is worth it."""
        self.x, self.energy = self.x + step.dx, energy
        if self.solver.learns:
            self.solver.learned.add(step.dx, r - step.r)
        self._slow = 0 if step.size <= self.keep_factor_rate * self._best else self._slow + 1
        self._best = min(self._best, step.size)
        if self._trial is not None or self._slow > self._patience:
            self.solver.expect(self.x - step.dx, step.dx)
            self.solver.has_factor = False
        self._here = False

    def _go_back(self, step: _Step) -> None:
        """Go to where ``step`` began, and by that part of it that lowers the energy."""
        found = self._partly(step, 10)
        if found is None:
            raise Lost("no step lowers the energy", int(np.argmax(np.abs(step.dx))))
        length, self.energy = found
        self.x = step.x + length * step.dx
        self.solver.has_factor, self._here, self._trial = False, False, None

    def _partly(self, step: _Step, halvings: int) -> tuple[float, float] | None:
        """Return the largest half, quarter, ... of the step that lowers the energy, and the energy there (the residual
        there is in the system)."""
        length = 0.5
        for _ in range(halvings):
            new = self.solver.evaluate(step.x + length * step.dx, self.solver.system, tangent=False)
            new_slope = float(self.solver.free(self.solver.system.r) @ step.dx)
            if step.size * length <= self.solver.size and _better(step, new, new_slope, length):
                return length, new
            length *= 0.5
        return None


def _better(step: _Step, new: float, new_slope: float, length: float) -> bool:
    """Test Armijo's rule on the energy; where there is none, or it drowns in round-off, the force along the step must
    shrink."""
    noise = 1e-11 * abs(step.energy)
    if np.isfinite(step.energy) and abs(step.slope) > noise:
        return bool(np.isfinite(new) and new <= step.energy + 1e-4 * length * step.slope)
    return bool(np.isfinite(new_slope) and abs(new_slope) <= (1.0 if length < 1.0 else 1.5) * abs(step.slope) + noise)
