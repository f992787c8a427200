"""Equilibrium under the probe, with contact solved exactly on the linearised body in every iteration.

Contact, not the material, is what costs Newton's method its iterations: points touch and let go, and each time the
whole body is factorised anew. Here the body's tangent K, without contact, is kept over iterations and moments,
condensed onto the nodes near the probe (`fem_node.condensed`). One iteration is

    x_free = x - K^-1 r_body(x),    f = contact on the condensed body about x_free,    x <- x_free + K^-1 E f,

two back-substitutions and a small contact problem. The fixed point has r_body(x) = E f: it is the equilibrium of the
full model, whatever K. When corrections shrink too slowly K is made again; where that does not help, the caller falls
back on Newton's method with load steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fem_node.condensed import Condensed, NotCovered, NotSettled, condense, touch
from fem_node.contact import ProbeContact
from fem_node.element import Space
from fem_node.items import Item, Moment
from fem_node.solver import Solution, Solver
from livedeform_common import frames
from livedeform_common.errors import ConvergenceError
from livedeform_common.types import Array

REACH = 0.005
SLOW = 0.5  # a correction that is not this much smaller than the last speaks for a fresh tangent
PATIENCE = 2  # so many of them in a row ask for it
MAX_ITERATIONS = 60
SHARPER = 0.03  # than Newton's last step, after which the error is far smaller: here it is not
MAX_REFRESHES = 4  # per moment


class Pressing:
    """Solves moments at which a frictionless probe is near the surface; ``items`` are all of the body's, with
    ``contact`` among them; ``body`` sums the others."""

    def __init__(self, space: Space, items: Sequence[Item], contact: ProbeContact, body: Solver) -> None:
        self.space, self.items, self.contact, self.body = space, items, contact, body
        self._surface = np.unique(space.facets)
        self._rows = (3 * self._surface[:, None] + np.arange(3)).ravel()
        self._kept: Condensed | None = None
        self._held: NDArray[np.int64] = np.zeros(0, np.int64)

    def solve(self, x: Array, moment: Moment) -> Solution | None:
        """The equilibrium at ``moment`` from ``x`` (n_dof,); None where this way does not lead there (the items are
        then as the attempt left them)."""
        for item in self.items:
            item.prepare(moment)
        dofs, values = (np.concatenate(parts) for parts in zip(*(i.constraints() for i in self.items), strict=True))
        self._held = np.unique(dofs).astype(np.int64)
        if (
            moment.pose is None
            or self.contact.law.remembers
            or not self.contact.is_near(x)
            or np.any(x[dofs.astype(np.int64)] != values)
        ):
            return None
        try:
            return self._iterate(x)
        except (NotSettled, ConvergenceError):
            self._kept = None
            return None

    def _iterate(self, x: Array) -> Solution | None:
        solution, tolerance = Solution(x), SHARPER * self.body.settings.tolerance
        last, slow, refreshes, moved = np.inf, 0, 0, False
        for _ in range(MAX_ITERATIONS):
            solution.n_iterations += 1
            if self._kept is None:
                if refreshes == MAX_REFRESHES:
                    return None
                self._kept = condense(self.body, x, self._near(x), self._rows)
                refreshes, last = refreshes + 1, np.inf
                solution.n_factorisations += 1
            try:
                new = self._step(x, self._kept)
            except NotCovered:
                self._kept = None
                continue
            size = float(np.abs(new - x).max())
            if not np.isfinite(size) or size > self.body.size:
                return None
            disturbed = moved  # by multipliers: its correction says nothing of K
            x, moved = new, self.contact.update(new)
            if size < tolerance and not moved:
                if not any([item.update(x) for item in self.items if item is not self.contact]):
                    solution.x = x
                    return solution
            elif not disturbed:
                slow = slow + 1 if size > SLOW * last and size > 10.0 * tolerance else 0
                if slow == PATIENCE:
                    self._kept, slow = None, 0
            last = size
        return None

    def _step(self, x: Array, kept: Condensed) -> Array:
        """One iteration from ``x``."""
        linear = self.body.linear
        self.body.evaluate(x, self.body.system, tangent=False)
        r = self.body.system.r.copy()
        r[self._held] = 0.0
        free = x - linear.solve(r)
        body = replace(kept, free=free[self._rows])
        _, force = touch(body, self.contact, x, SHARPER * self.body.settings.tolerance)
        load = np.zeros_like(x)
        load[body.dofs] = force
        return free + linear.solve(load)

    def _near(self, x: Array) -> NDArray[np.int64]:
        """Free surface nodes within reach of the probe's box at ``x``."""
        u = x[: 3 * self.space.n_nodes].reshape(-1, 3)[self._surface]
        y = frames.apply(frames.inverse(self.contact.pose), self.space.nodes[self._surface] + u)
        low, high = self.contact.shape.bounds
        away = np.linalg.norm(np.maximum(np.maximum(low - y, y - high), 0.0), axis=1)
        near = self._surface[away < REACH]
        return near[~np.isin(3 * near, self._held)]
