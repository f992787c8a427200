"""Volume schemes: how an element keeps the volume by what it does with the volume ratio theta(F) of its quadrature
points.

Each scheme is a projection theta -> theta_h; the energy is sum_q w K U(theta_h), so that displacements stay the only
true unknowns and the pressure p = projection of K U'(theta_h) acts at the quadrature points:

- `Pointwise` (p1, p2): theta_h = theta;
- `Mean` (p2p0): theta_h = the element's mean (mean dilatation; Simo, Taylor & Pister 1985);
- `Continuous` (p2p1): theta_h = the continuous linear L2 projection (Taylor & Hood; three fields with equal spaces).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.element.kernels import nodal_forces
from livedeform.fem_node.materials.base import Volumetric
from livedeform.fem_node.solve.assembly import Positions, System


class VolumeScheme(Protocol):
    """Volumetric part of the energy on one space. ``w`` (e, q) m3, ``K`` (e, q) Pa, ``theta`` (e, q)."""

    def pressure(self, U: Volumetric, w: Array, K: Array, theta: Array) -> tuple[Array, Array, float]:
        """p (e, q) Pa, the curvature (e, q) that stays at the points, and the energy J."""
        ...

    def element_term(self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array) -> tuple[Array, Array]:
        """Return what couples the points of an element: vectors (e, 3 a) and factors (e,) of a rank-one stiffness;
        empty if nothing does."""
        ...

    def add_couplings(
        self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array, positions: Positions, system: System
    ) -> None:
        """Adds what couples displacements with pressures."""
        ...


def make_scheme(space: Space) -> VolumeScheme:
    """The scheme of the space's element."""
    if space.kind == "p2p0":
        return Mean(space)
    return Continuous(space) if space.kind == "p2p1" else Pointwise(space)


def _nothing(space: Space) -> tuple[Array, Array]:
    """No rank-one stiffness."""
    return np.zeros((0, 3 * space.cells.shape[1])), np.zeros(0)


class Pointwise:
    """No projection."""

    def __init__(self, space: Space) -> None:
        self._nothing = _nothing(space)

    def pressure(self, U: Volumetric, w: Array, K: Array, theta: Array) -> tuple[Array, Array, float]:
        return K * U.slope(theta), K * U.curvature(theta), float(np.sum(w * K * U.value(theta)))

    def element_term(self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array) -> tuple[Array, Array]:
        return self._nothing

    def add_couplings(
        self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array, positions: Positions, system: System
    ) -> None:
        """Add nothing: the scheme has no pressures."""


class Mean:
    """Element means."""

    def __init__(self, space: Space) -> None:
        self._mean, self._slopes = np.ones(len(space.cells)), space.slopes

    def pressure(self, U: Volumetric, w: Array, K: Array, theta: Array) -> tuple[Array, Array, float]:
        V = w.sum(axis=1)
        self._mean = np.einsum("eq,eq->e", w, theta) / V
        K_mean = np.einsum("eq,eq->e", w, K) / V
        p = np.broadcast_to((K_mean * U.slope(self._mean))[:, None], w.shape)
        return p, np.zeros(w.shape), float((V * K_mean) @ U.value(self._mean))

    def element_term(self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array) -> tuple[Array, Array]:
        V = w.sum(axis=1)
        vectors = np.empty((len(w), 3 * self._slopes.shape[1]))
        nodal_forces(c, w, self._slopes, frames, vectors)
        return vectors, np.einsum("eq,eq->e", w, K) * U.curvature(self._mean) / V**2

    def add_couplings(
        self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array, positions: Positions, system: System
    ) -> None:
        """Add nothing: the pressure is condensed in the element."""


class Continuous:
    """L2 projection on continuous linear functions; the pressures are unknowns of the linear systems only."""

    def __init__(self, space: Space) -> None:
        self._tets, self._N, self._slopes = space.mesh.tets, space.barycentric, space.slopes
        self._nothing = _nothing(space)
        self._n = len(space.mesh.nodes)
        self._weights: Array | None = None
        self._theta = np.ones(space.weights.shape)

    def _mass(self, w: Array) -> Array:
        """Element mass matrices (e, 4, 4)."""
        return np.asarray(np.einsum("eq,qa,qb->eab", w, self._N, self._N))

    def _project(self, w: Array, f: Array) -> Array:
        """The projection of a field (e, q), at the points again."""
        if self._weights is None or not np.array_equal(self._weights, w):
            rows = np.repeat(self._tets, 4, axis=1).ravel()
            columns = np.tile(self._tets, (1, 4)).ravel()
            shape = (self._n, self._n)
            self._factor = splu(
                csc_array((self._mass(w).ravel(), (rows, columns)), shape=shape), permc_spec="MMD_AT_PLUS_A"
            )
            self._weights = w.copy()
        load = np.bincount(self._tets.ravel(), ((w * f) @ self._N).ravel(), minlength=self._n)
        return np.asarray(self._factor.solve(load)[self._tets] @ self._N.T)

    def pressure(self, U: Volumetric, w: Array, K: Array, theta: Array) -> tuple[Array, Array, float]:
        self._theta = self._project(w, theta)
        p = self._project(w, K * U.slope(self._theta))
        return p, np.zeros(w.shape), float(np.sum(w * K * U.value(self._theta)))

    def element_term(self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array) -> tuple[Array, Array]:
        return self._nothing

    def add_couplings(
        self, U: Volumetric, w: Array, K: Array, c: Array, frames: Array, positions: Positions, system: System
    ) -> None:
        n = 3 * self._slopes.shape[1]
        pulled = w[..., None, None] * (c @ frames.transpose(0, 1, 3, 2))
        B = np.einsum("qp,eqik,qak->eaip", self._N, pulled, self._slopes, optimize=True).reshape(len(w), n, 4)
        system.add_blocks(positions[:, :n, n:], B)
        if not system.pattern.symmetric:
            system.add_blocks(positions[:, n:, :n], B.transpose(0, 2, 1))
        system.add_blocks(positions[:, n:, n:], -self._mass(w / (K * U.curvature(self._theta))))
