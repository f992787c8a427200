"""The change of the tractions under a probe that rubs, to first order, as the surface moves, as what was before
changes and as the contact's numbers do.

At a contact point y (in the probe's frame) with the pressure p, the traction on the body is tau = p n + t. A small
change moves the point by dy, its anchor a (from where it sticks) by da, the coefficient of friction by dmu and the
strength of adhesion by ds:

    -d tau = D dy - A da - b (dmu, ds).

What bears keeps to the probe, what sticks keeps to its anchor (very stiff springs kappa stand for both); what has slid
by s along the direction e of t = mu p e follows the pressure, and turns with its path:

    sticks:  D = kappa (n n^T + P) - p H,                             A = kappa P,          b = (0, 0),
    slides:  D = kappa (n n^T + mu e n^T) + beta (P - e e^T) - p H,   A = beta (P - e e^T), b = (p e, 0),
    gives:   D = 0 (at the strength of adhesion),                     A = 0,                b = (0, -n),

P the tangent plane, H the curvature of the probe's distance, beta = mu p / s. D is not symmetric where points slide.
Points that are about to stick, to slide or to let go are kinks: the side on which the solution is counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common import frames
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import STIFFENING, ProbeContact
from livedeform.fem_node.contact.probe_shapes import outer

SLIDES = 1.0 - 1e-9  # of the limit: as `ProbeContact.commit` has it


@dataclass(frozen=True)
class Slope:
    """The slope of a contact at a solution: ``facets`` (m,) that bear something, their contact points' ``rows`` (n,),
    ``weights`` (n,) m2, ``D`` and ``A`` (n, 3, 3) Pa/m and ``b`` (n, 3, 2), which of them ``slide`` (n,), all in the
    probe's frame, and where they are in the phantom's (n, 3) m."""

    contact: ProbeContact
    facets: NDArray[np.int64]
    rows: NDArray[np.int64]
    weights: Array
    D: Array
    A: Array
    b: Array
    slides: NDArray[np.bool_]
    places: Array

    @classmethod
    def at(cls, contact: ProbeContact, x: Array) -> Slope | None:
        """Return the slope at the solution ``x`` (n_dof,), before it is committed; None where nothing is touched."""
        rows, p, n, H, t = contact.bearing(x)
        if not len(rows):
            return None
        state, law = contact.state, contact.law
        size, limit = np.linalg.norm(t, axis=1), state.limit[rows]
        slides = (limit > 0.0) & np.isfinite(limit) & (size >= SLIDES * limit)
        gives = state.attached[rows] & (p <= -law.strength)
        kappa = law.penalty * (STIFFENING if law.multiplies else 1.0)
        e = t / np.maximum(size, 1e-300)[:, None]
        P = _projectors(n)
        slip = np.einsum("nij,nj->ni", P, contact.seen_at(rows, x) - state.anchor[rows])
        beta = np.minimum(size / np.maximum(np.linalg.norm(slip, axis=1), 1e-300), kappa)
        A = np.where(slides, beta, np.where(limit > 0.0, kappa, 0.0))[:, None, None] * P
        A -= np.where(slides, beta, 0.0)[:, None, None] * outer(e, e)
        pushing = n + np.where(slides, law.friction, 0.0)[:, None] * e if np.isfinite(law.friction) else n
        D = np.where((p != 0.0) & ~gives, kappa, 0.0)[:, None, None] * outer(pushing, n) + A
        D -= np.where(p < law.curvature_limit, p, 0.0)[:, None, None] * H
        b = np.stack([np.where(slides, p, 0.0)[:, None] * e, np.where(gives, -1.0, 0.0)[:, None] * n], axis=2)
        q = contact.weights.shape[1]
        places = contact.places_at(rows, x)
        return cls(contact, rows[::q] // q, rows, contact.weights.ravel()[rows], D, A, b, slides, places)

    @property
    def dofs(self) -> NDArray[np.int64]:
        """The dofs (m, 3 b) of the facets."""
        return self.contact.dofs[self.facets]

    def springs(self, stiffness: float) -> Array:
        """Return blocks (m, 3 b, 3 b) N/m of springs of a ``stiffness`` Pa/m at the facets, as stiff along them."""
        return self._blocks(np.broadcast_to(stiffness * np.eye(3), self.D.shape))

    def blocks(self) -> Array:
        """Return the blocks (m, 3 b, 3 b) N/m by which the residual follows the facets' nodes."""
        R = self.contact.pose[:3, :3]
        return self._blocks(R @ self.D @ R.T)

    def moves(self, d: Array, shifts: Array) -> Array:
        """Return how the points move as the probe sees them, (n, 3, p) m, as the unknowns change by ``d`` (n_dof, p)
        and the probe moves by ``shifts`` (p, 4, 4)."""
        return moves_of(self.contact, self.rows, self.places, d, shifts, self.contact.pose)

    def pulls(self, anchors: Array, shifts: Array, numbers: Array) -> Array:
        """Return what the residual changes by (m, 3 b, p) N while the nodes keep still, as the ``anchors`` move by
        (n, 3, p) m, the probe by ``shifts`` (p, 4, 4) and friction and strength by ``numbers`` (2, p)."""
        R = self.contact.pose[:3, :3]
        probe = np.einsum("ji,pjk,nk->nip", R, shifts[:, :3, :3], self.places)
        probe += (shifts[:, :3, 3] @ R).T[None]
        h = -np.einsum("nij,njp->nip", self.D, probe) - np.einsum("nij,njp->nip", self.A, anchors)
        h -= self.b @ numbers
        return self._on_nodes(np.einsum("ij,njp->nip", R, h))

    def _blocks(self, D: Array) -> Array:
        """Sum ``D`` (n, 3, 3) Pa/m of the points, in the phantom's frame, to blocks (m, 3 b, 3 b) of the facets."""
        N = self.contact.values
        q, b = N.shape
        m = len(self.facets)
        NN = (N[:, :, None] * N[:, None, :]).reshape(q, b * b)
        weighted = (self.weights[:, None, None] * D).reshape(m, q, 9)
        blocks: Array = (NN.T @ weighted).reshape(m, b, b, 3, 3).transpose(0, 1, 3, 2, 4)
        return blocks.reshape(m, 3 * b, 3 * b)

    def _on_nodes(self, h: Array) -> Array:
        """Sum ``h`` (n, 3, p) Pa of the points to the facets' nodes (m, 3 b, p) N."""
        N, m = self.contact.values, len(self.facets)
        weighted = (self.weights[:, None, None] * h).reshape(m, len(N), -1)
        out: Array = N.T @ weighted
        return out.reshape(m, -1, h.shape[-1])


def moves_of(contact: ProbeContact, rows: NDArray[np.int64], places: Array, d: Array, shifts: Array, T: Array) -> Array:
    """Return how the points number ``rows`` (n,), at ``places`` (n, 3) m, move as a probe at ``T`` (4, 4) sees them,
    (n, 3, p) m, as the unknowns change by ``d`` (n_dof, p) and the probe moves by ``shifts`` (p, 4, 4)."""
    facets, q = np.divmod(rows, contact.weights.shape[1])
    nodes = d[contact.dofs[facets]].reshape(len(rows), -1, 3, d.shape[1])
    moved = np.einsum("na,naip->nip", contact.values[q], nodes)
    moved -= np.einsum("pij,nj->nip", shifts[:, :3, :3], places) + shifts[:, :3, 3].T[None]
    return np.asarray(np.einsum("ji,njp->nip", T[:3, :3], moved))


def _projectors(n: Array) -> Array:
    """Return the projectors (k, 3, 3) onto the planes across unit vectors ``n`` (k, 3)."""
    return np.asarray(np.eye(3) - outer(n, n))


class Anchors:
    """The changes of a contact's anchors along p directions, from step to step of the probe's path: those of what
    sticks keep what they had, those of what slides go with the surface, and what the probe meets is anchored where it
    is met on the way (`ProbeContact.prepare`)."""

    def __init__(self, contact: ProbeContact, p: int) -> None:
        self.contact = contact
        self._d = np.zeros((len(contact.state.multiplier), 3, p))

    def copy(self) -> Anchors:
        """Return a copy that goes its own way."""
        new = Anchors(self.contact, 0)
        new._d = self._d.copy()
        return new

    def at(self, slope: Slope, d: Array, before: Array, shifts: Array) -> Array:
        """Return the changes (n, 3, p) m of the anchors of a ``slope``'s points, where the unknowns changed by ``d``
        (n_dof, p) and the probe by ``before`` (p, 4, 4) at the last step, and the probe by ``shifts`` now."""
        state, rows = self.contact.state, slope.rows
        new = ~state.touches[rows]
        if new.any():
            self._d[rows[new]] = self._met(rows[new], d, before, shifts)
        return self._d[rows]

    def _met(self, rows: NDArray[np.int64], d: Array, before: Array, shifts: Array) -> Array:
        contact, state = self.contact, self.contact.state
        places = contact.places_at(rows, state.x)
        after = moves_of(contact, rows, places, d, shifts, contact.pose)
        if state.T is None:
            return after
        first = moves_of(contact, rows, places, d, before, state.T)
        y0, y1 = (frames.apply(frames.inverse(T), places) for T in (state.T, contact.pose))
        u, v = contact.shape.distance(y0), contact.shape.distance(y1)
        met = (v.d < 0.0) & (u.d > 0.0)
        closed = np.where(met, u.d - v.d, 1.0)
        s = np.where(met, u.d / closed, np.where(v.d < 0.0, 1.0, 0.0))
        du, dv = (np.einsum("ni,nip->np", g.gradient, m) for g, m in ((u, first), (v, after)))
        ds = np.where(met[:, None], (u.d[:, None] * dv - v.d[:, None] * du) / closed[:, None] ** 2, 0.0)
        return first + s[:, None, None] * (after - first) + ds[:, None, :] * (y1 - y0)[:, :, None]

    def commit(self, slope: Slope, moves: Array) -> None:
        """Let the anchors of what slides go with the ``moves`` (n, 3, p) m of its points."""
        self._d[slope.rows[slope.slides]] = moves[slope.slides]
