"""The body as its surface feels it: linearised about a state, with everything but the touched nodes condensed out.

With K the body's tangent (without contact), E the columns of the unit matrix at m surface dofs, and x_free where the
body would go without the probe, the body answers nodal contact forces f by

    x = x_free + U f,    U = K^-1 E,    w - w_free = S f,    S = E^T U,

so that contact alone is a small problem: minimise 1/2 (w - w_free)^T S^-1 (w - w_free) + psi_contact(w) over w (m,)
(Bro-Nielsen & Cotin 1996 for the condensation; Duriez et al. 2006 for contact through the compliance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from fem_node.contact import Local, ProbeContact
from fem_node.solver import Solver
from livedeform_common.types import Array

BLOCK = 64  # right-hand sides at a time
TOLERANCE = 5e-6  # m: the last step of the small Newton iteration
MAX_STEPS = 25
MAX_HALVINGS = 8


@dataclass(frozen=True)
class Condensed:
    """``dofs`` (m,) that the probe may touch, ``rows`` (k,) dofs that are asked for, ``columns`` U (k, m) there,
    ``stiffness`` S^-1 (m, m), ``free`` x_free (k,) and ``x`` (k,) of the state that it was linearised about."""

    dofs: NDArray[np.int64]
    rows: NDArray[np.int64]
    columns: NDArray[np.float32]
    stiffness: Array
    free: Array
    x: Array

    def spread(self, force: Array) -> Array:
        """x_free + U f (k,) at the rows."""
        return self.free + self.columns @ force.astype(np.float32)


def condense(solver: Solver, x: Array, nodes: NDArray[np.int64], rows: NDArray[np.int64]) -> Condensed:
    """Linearises ``solver``'s items (the body without contact, prepared) about ``x``; condenses them onto ``nodes``."""
    solver.factorise_at(x)
    solver.evaluate(x, solver.system, tangent=False)
    r = solver.system.r.copy()
    r[np.concatenate([item.constraints()[0] for item in solver.items]).astype(np.int64)] = 0.0
    free = x - solver.linear.solve(r)
    dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
    columns = np.empty((len(rows), len(dofs)), np.float32)
    compliance = np.empty((len(dofs), len(dofs)))
    for start in range(0, len(dofs), BLOCK):
        some = dofs[start : start + BLOCK]
        unit = np.zeros((len(x), len(some)), order="F")
        unit[some, np.arange(len(some))] = 1.0
        solved = solver.linear.solve(unit)
        columns[:, start : start + len(some)] = solved[rows]
        compliance[:, start : start + len(some)] = solved[dofs]
    stiffness = np.linalg.inv(0.5 * (compliance + compliance.T))
    return Condensed(dofs, rows, columns, 0.5 * (stiffness + stiffness.T), free[rows], x[rows])


class NotCovered(Exception):
    """The probe touches nodes that the body was not condensed onto."""


class NotSettled(Exception):
    """The small contact problem found no solution."""


def touch(body: Condensed, contact: ProbeContact, start: Array) -> tuple[Array, Array]:
    """Solves contact on the condensed body: x (n_dof,), right at the body's rows only, and the nodal forces f (m,).

    Newton's method with a line search on the energy from w = ``start`` (n_dof,) at the dofs; multipliers as the item
    has them. Rows must hold the whole surface.
    """
    x = np.zeros(len(start))
    x[body.rows] = body.free
    places_of = np.full(len(x), -1, np.int64)
    places_of[body.dofs] = np.arange(len(body.dofs))
    w_free, w = x[body.dofs], start[body.dofs].copy()

    def at(w: Array, *, tangent: bool, safe: bool = False) -> tuple[float, Array, Local | None]:
        x[body.dofs] = w
        part = contact.local(x, tangent=tangent, safe=safe)
        pull = body.stiffness @ (w - w_free)
        energy = 0.5 * float((w - w_free) @ pull)
        if part is None:
            return energy, pull, None
        places = places_of[contact.dofs[part.facets]]
        inside = places >= 0
        if np.any(part.vectors[~inside] != 0.0):
            raise NotCovered
        push = np.bincount(places[inside], part.vectors[inside], minlength=len(w))
        return energy + part.energy, pull + push, part

    def safer(w: Array) -> Local | None:
        return at(w, tangent=True, safe=True)[2]

    energy, r, part = at(w, tangent=True)
    for _ in range(MAX_STEPS):
        step = -_solve(body, contact, part, places_of, r, partial(safer, w))
        size, length = float(np.abs(step).max()), 1.0
        for _ in range(MAX_HALVINGS):
            trial = at(w + length * step, tangent=True)
            if trial[0] <= energy + 1e-4 * length * float(r @ step) + 1e-13:
                break
            length *= 0.5
        w = w + length * step
        energy, r, part = trial
        if size < TOLERANCE:
            force = body.stiffness @ (w - w_free)
            x[body.rows] = body.spread(force)
            return x, force
    raise NotSettled


def _solve(
    body: Condensed,
    contact: ProbeContact,
    part: Local | None,
    places_of: NDArray[np.int64],
    r: Array,
    safer: Callable[[], Local | None],
) -> Array:
    """K^-1 r of the condensed body with contact; without the contact's curvature where that makes K indefinite."""
    for attempt in (lambda: part, safer):
        K, here = body.stiffness, attempt()
        if here is not None and here.blocks is not None:
            K = K + _dense(here.blocks, places_of[contact.dofs[here.facets]], len(r))
        try:
            return cho_solve(cho_factor(K, check_finite=False), r, check_finite=False)
        except LinAlgError:
            continue
    raise NotSettled


def _dense(blocks: Array, places: NDArray[np.int64], m: int) -> Array:
    """The ``blocks`` (k, 3 b, 3 b) summed into (m, m); what lies outside carries nothing."""
    a = np.repeat(places[:, :, None], places.shape[1], axis=2)
    b = a.transpose(0, 2, 1)
    inside = (a >= 0) & (b >= 0)
    index = a[inside] * m + b[inside]
    return np.bincount(index, blocks[inside], minlength=m * m).astype(np.float64).reshape(m, m)
