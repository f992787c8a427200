"""Contact with a condensed body: a small problem in the forces at the surface dofs that the probe may touch.

With the compliance S (m, m) of these dofs, and w_free where they would be without contact forces f (m,),

    w = w_free + S f,    f + grad psi(w_free + S f) = 0:

the minimum of 1/2 f^T S f + psi_contact(w_free + S f). Only nodes that are pushed carry a force, so that its Newton
steps are systems of their size (Bro-Nielsen & Cotin 1996 for the condensation; Duriez et al. 2006 for contact through
the compliance).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import Local, ProbeContact

TOLERANCE = 5e-6  # m: how far the small Newton iteration of a live answer may still move anything
CONTRACTS = 0.5  # of the step before: from then on the steps that follow are told from these two
MAX_STEPS = 25
MAX_HALVINGS = 8


@dataclass(frozen=True)
class Surface:
    """The ``dofs`` (m,) that the probe may touch, and their ``compliance`` S (m, m) m/N."""

    dofs: NDArray[np.int64]
    compliance: Array

    def stretch(self, force: Array) -> Array:
        """Return S f (m,); few of the forces are not zero."""
        out = np.zeros(len(force))
        add_rows(self.compliance, force, np.flatnonzero(force), out)
        return out


@njit(cache=True, fastmath={"contract", "reassoc"})
def add_rows(matrix: Array, factors: Array, rows: NDArray[np.int64], out: Array) -> None:
    """Adds the ``rows`` of the ``matrix`` (m, k), each with its factor (m,), to ``out`` (k,)."""
    for n in rows:
        for j in range(len(out)):
            out[j] += factors[n] * matrix[n, j]


@dataclass(frozen=True)
class NotCovered(Exception):
    """The probe touches ``facets`` (k,) that the body was not condensed onto."""

    facets: NDArray[np.int64]


class NotSettled(Exception):
    """The small contact problem found no solution."""


class _At(NamedTuple):
    """The small problem at some forces f (m,): ``stretch`` S f (m,), the energy, f + grad psi (m,), and the contact's
    part."""

    force: Array
    stretch: Array
    energy: float
    r: Array
    part: Local | None


class _Step(NamedTuple):
    """Newton's step of the forces (m,), the ``stretch`` (m,) that it adds, and the slope of the energy along it."""

    force: Array
    stretch: Array
    slope: float


class _Touching:
    """The condensed body and the contact that is solved on it."""

    def __init__(self, body: Surface, contact: ProbeContact, x: Array) -> None:
        self.body, self.contact, self.x = body, contact, x.copy()
        self.places_of = np.full(len(x), -1, np.int64)
        self.places_of[body.dofs] = np.arange(len(body.dofs))
        self.w_free = x[body.dofs]

    def at(self, force: Array, stretch: Array, *, safe: bool = False, tangent: bool = True) -> _At:
        """Return what the contact says at these forces, which stretch the body so."""
        self.x[self.body.dofs] = self.w_free + stretch
        part = self.contact.local(self.x, tangent=tangent, safe=safe)
        energy = 0.5 * float(force @ stretch)
        if part is None:
            return _At(force, stretch, energy, force, None)
        push = force.copy()
        outside = np.zeros(len(part.facets), np.bool_)
        _add_vectors(part.vectors, self._places(part), push, outside)
        if outside.any():
            raise NotCovered(part.facets[outside])
        return _At(force, stretch, energy + part.energy, push, part)

    def step(self, now: _At) -> _Step:
        """Return Newton's step, without the contact's curvature where that leads uphill."""
        for attempt in (now, None):
            part = attempt.part if attempt is not None else self.at(now.force, now.stretch, safe=True).part
            df = self.solve(part, now.r)
            stretch = self.body.stretch(df)
            slope = float(now.r @ stretch)
            if np.all(np.isfinite(df)) and slope <= 0.0:
                return _Step(df, stretch, slope)
        raise NotSettled

    def along(self, now: _At, step: _Step, length: float) -> _At:
        """Return the problem a part of the ``step`` further; of less than all of it without the tangent."""
        force, stretch = now.force + length * step.force, now.stretch + length * step.stretch
        return self.at(force, stretch, tangent=length == 1.0)

    def carried(self, now: _At, shift: Array) -> _At:
        """Return the problem after a step whose tangent is that where the probe carries the surface along by ``shift``
        (m,), so that it still touches what it touched before; ``now`` where that is no better."""
        try:
            there = self.at(now.force, now.stretch + shift)
            if there.part is None:
                return now
            places = self._places(there.part)
            back = there.part.times(np.append(shift, 0.0)[places])
            pull = np.bincount(places[places >= 0], back[places >= 0], minlength=len(shift))
            df = self.solve(there.part, there.r - pull)
            then = self.at(now.force + df, now.stretch + self.body.stretch(df))
        except NotCovered:
            return now
        return then if then.energy < now.energy else now

    def _places(self, part: Local) -> NDArray[np.int64]:
        """Return where the dofs of the facets are among those of the body (k, 3 b); -1: none of them."""
        return np.asarray(self.places_of[self.contact.dofs[part.facets]])

    def solve(self, part: Local | None, r: Array) -> Array:
        """Return df of (I + C S) df = -r with the contact's stiffness C, which few dofs have."""
        df = -r
        if part is None or part.blocks is None:
            return df
        places, stiff = self._places(part), np.zeros(len(r), np.bool_)
        _find_stiff(part.blocks, places, stiff)
        active = np.flatnonzero(stiff)
        if len(active) == 0:
            return df
        number = np.full(len(r) + 1, -1, np.int64)
        number[active] = np.arange(len(active))
        C = np.zeros((len(active), len(active)))
        _add_blocks(part.blocks, number[places], C)
        rows = self.body.compliance[active]
        stretch = rows @ np.where(stiff, 0.0, -r)
        matrix = C @ rows[:, active]
        matrix[np.diag_indices_from(matrix)] += 1.0
        df[active] = np.linalg.solve(matrix, -r[active] - C @ stretch)
        return df


def touch(
    body: Surface,
    contact: ProbeContact,
    force: Array,
    x: Array,
    shift: Array | None = None,
    *,
    tolerance: float = TOLERANCE,
    most: int = MAX_STEPS,
) -> tuple[Array, Array]:
    """Solve contact on the condensed body from nodal ``force`` (m,) at its dofs, where without contact forces it would
    be at ``x`` (n_dof,): x, right at these dofs only, and the forces (m,). Multipliers as the item has them.

    ``shift`` (m,) m: how far the probe would carry the dofs since the forces were found; ``tolerance`` m: how far the
    small iteration, of ``most`` steps, may still move anything. Raises `NotCovered` and `NotSettled`.
    """
    problem = _Touching(body, contact, x)
    now = problem.at(force, body.stretch(force))
    if shift is not None and force.any() and np.abs(shift).max() > tolerance:
        now = problem.carried(now, shift)
    before = 0.0
    for _ in range(most):
        step = problem.step(now)
        length = 1.0
        for _ in range(MAX_HALVINGS):
            trial = problem.along(now, step, length)
            if trial.energy <= now.energy + 1e-4 * length * step.slope + 1e-13:
                break
            length *= 0.5
        now = trial if length == 1.0 else problem.at(trial.force, trial.stretch)
        moved = float(np.abs(step.stretch).max(initial=0.0))
        if _is_settled(moved, before, tolerance):
            return problem.x, now.force
        before = moved if length == 1.0 else 0.0
    raise NotSettled


def carried_forces(body: Surface, contact: ProbeContact, part: Local, load: Array, x: Array) -> Array:
    """Return the forces (m,) on the condensed body under a small ``load`` (m,) N at its dofs, of which the springs of
    the contact's ``part`` at ``x`` (n_dof,) bear a share."""
    return _Touching(body, contact, x).solve(part, -load)


def _is_settled(moved: float, before: float, tolerance: float) -> bool:
    """Return whether nothing will move by more than the ``tolerance`` (m) after a step by ``moved`` m: where steps
    become shorter than `CONTRACTS` of the one ``before`` (m), those that follow add up to a geometric series at
    most."""
    ratio = moved / before if before else np.inf
    return moved < tolerance or (ratio < CONTRACTS and moved * ratio / (1.0 - ratio) < tolerance)


@njit(cache=True)
def _add_vectors(vectors, places, out, outside):
    """Adds ``vectors`` (k, 3 b) at their ``places`` in ``out`` (m,), and notes which facets push ``outside`` (k,) of
    it."""
    for k in range(len(vectors)):
        for i in range(vectors.shape[1]):
            if places[k, i] >= 0:
                out[places[k, i]] += vectors[k, i]
            elif vectors[k, i] != 0.0:
                outside[k] = True


@njit(cache=True)
def _find_stiff(blocks, places, stiff):
    """Notes the ``places`` (k, 3 b) of all facets whose ``blocks`` (k, 3 b, 3 b) are not zero, in ``stiff`` (m,)."""
    for k in range(len(blocks)):
        if np.any(blocks[k] != 0.0):
            for place in places[k]:
                if place >= 0:
                    stiff[place] = True


@njit(cache=True)
def _add_blocks(blocks, places, out):
    """Adds the ``blocks`` (k, 3 b, 3 b) at their ``places`` in ``out`` (m, m); what lies outside carries nothing."""
    for k in range(len(blocks)):
        for i in range(blocks.shape[1]):
            if places[k, i] >= 0:
                for j in range(blocks.shape[1]):
                    if places[k, j] >= 0:
                        out[places[k, i], places[k, j]] += blocks[k, i, j]
