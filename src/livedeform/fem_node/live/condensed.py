"""The body as its surface feels it: linearised about a state, with everything but the touched nodes condensed out.

With K the body's tangent (without contact), E the columns of the unit matrix at m surface dofs, and x_free where the
body would go without the probe, the body answers nodal contact forces f by

    x = x_free + U f,    U = K^-1 E,    w = w_free + S f,    S = E^T U,

so that contact alone is a small problem in the forces (`fem_node.contact.small_problem`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.contact.small_problem import Surface, add_rows
from livedeform.fem_node.solve.solver import Solver

BLOCK = 64  # right-hand sides at a time


@dataclass(frozen=True)
class Condensed(Surface):
    """``rows`` (k,) dofs that are asked for, ``answers`` U^T (m, k) there, ``free`` x_free (k,) and ``x`` (k,) of the
    state that it was linearised about."""

    rows: NDArray[np.int64]
    answers: NDArray[np.float32]
    free: Array
    x: Array

    def spread(self, force: Array) -> Array:
        """Return x_free + U f (k,) at the rows."""
        out = self.free.copy()
        add_rows(self.answers, force, np.flatnonzero(force), out)
        return out


def condense(solver: Solver, x: Array, nodes: NDArray[np.int64], rows: NDArray[np.int64]) -> Condensed:
    """Linearise ``solver``'s items (the body without contact, prepared) about ``x``; condense them onto ``nodes``."""
    solver.factorise_at(x)
    solver.evaluate(x, solver.system, tangent=False)
    r = solver.system.r.copy()
    r[np.concatenate([item.constraints()[0] for item in solver.items]).astype(np.int64)] = 0.0
    free = x - solver.linear.solve(r)
    dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
    answers = np.empty((len(dofs), len(rows)), np.float32)
    compliance = np.empty((len(dofs), len(dofs)))
    for start in range(0, len(dofs), BLOCK):
        some = dofs[start : start + BLOCK]
        unit = np.zeros((len(x), len(some)), order="F")
        unit[some, np.arange(len(some))] = 1.0
        solved = solver.linear.solve(unit)
        answers[start : start + len(some)] = solved[rows].T
        compliance[:, start : start + len(some)] = solved[dofs]
    symmetric = 0.5 * (compliance + compliance.T)
    return Condensed(dofs, symmetric, rows=rows, answers=answers, free=free[rows], x=x[rows])
