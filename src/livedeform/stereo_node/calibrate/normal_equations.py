"""The normal equations of a stereo bundle, picture by picture, and their solution with the board's points eliminated.

Every picture tells of its own lens, the rig, its own board's pose, and (where the board's shape is free) of three
coordinates of each point: the last are eliminated point by point (Schur complement; Triggs et al. 2000, 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array


@dataclass(frozen=True)
class ViewEquations:
    """One picture's part: residual ``r`` (2 k,) px; its negative derivative ``A`` (2 k, q) with respect to the
    parameters ``columns`` (q,), and ``S`` (k, 2, 3) with respect to the points ``rows`` (k,), None where they are
    fixed."""

    r: Array
    columns: NDArray[np.int64]
    A: Array
    S: Array | None
    rows: NDArray[np.int64]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations: ``H`` (p, p), ``g`` (p,); of free points ``B`` (n, 3, 3), ``gs`` (n, 3) and the coupling ``W``
    (n, 3, p)."""

    H: Array
    g: Array
    B: Array | None = None
    gs: Array | None = None
    W: Array | None = None

    def step(self, damping: float) -> tuple[Array, Array | None]:
        """Return the step (p,) of the parameters and (n, 3) of the points; ``damping`` relative to each diagonal.

        Raises ``LinAlgError`` where the equations are singular.
        """
        H: Array = self.H + damping * np.diag(np.diag(self.H))
        if self.B is None or self.gs is None or self.W is None:
            return _solve(H, self.g), None
        B = self.B * (1 + damping * np.eye(3))
        BW = np.asarray(np.linalg.solve(B, self.W), float)
        Bg = np.asarray(np.linalg.solve(B, self.gs[:, :, None])[:, :, 0], float)
        step = _solve(H - _product(self.W, BW), self.g - np.einsum("nap,na->p", BW, self.gs))
        return step, Bg - BW @ step

    def inverse(self, n: int) -> Array:
        """Return the first (n, n) of the inverse: the covariance over the residual's variance."""
        H = self.H
        if self.B is not None and self.W is not None:
            BW = np.asarray(np.linalg.solve(self.B, self.W), float)
            H = H - _product(self.W, BW)
        d = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        out: Array = (np.linalg.inv(H / d[:, None] / d) / d[:, None] / d)[:n, :n]
        return out


def _product(W: Array, BW: Array) -> Array:
    """Return sum over the points of W^T B^-1 W, (p, p), as one product of matrices."""
    p = W.shape[2]
    out: Array = W.reshape(-1, p).T @ BW.reshape(-1, p)
    return out


def _solve(H: Array, g: Array) -> Array:
    d = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
    out: Array = np.linalg.solve(H / d[:, None] / d, g / d) / d
    return out


def normal_equations(
    views: Sequence[ViewEquations], weights: Array, p: int, prior: Array | None = None, shape: Array | None = None
) -> NormalEquations:
    """Sum the pictures' parts, of ``p`` parameters, with weights (m,) of the residuals in their order; ``prior`` (n, 3)
    is the information that holds the points' displacements ``shape`` (n, 3) at zero."""
    H, g = np.zeros((p, p)), np.zeros(p)
    B = gs = W = None
    if prior is not None and shape is not None:
        B, gs, W = prior[:, :, None] * np.eye(3), -prior * shape, np.zeros((*prior.shape, p))
    at = 0
    for view in views:
        w = weights[at : at + len(view.r)]
        at += len(view.r)
        weighted = w[:, None] * view.A
        H[np.ix_(view.columns, view.columns)] += view.A.T @ weighted
        g[view.columns] += weighted.T @ view.r
        if view.S is not None and B is not None and gs is not None and W is not None:
            Sw = view.S * w.reshape(-1, 2, 1)
            B[view.rows] += np.einsum("kia,kib->kab", Sw, view.S)
            gs[view.rows] += np.einsum("kia,ki->ka", Sw, view.r.reshape(-1, 2))
            coupling = np.einsum("kia,kiq->kaq", Sw, view.A.reshape(-1, 2, len(view.columns)))
            W[np.ix_(view.rows, np.arange(3), view.columns)] += coupling
    return NormalEquations(H, g, B, gs, W)
