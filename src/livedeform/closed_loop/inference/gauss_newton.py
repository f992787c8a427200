"""Weighted least squares and MAP with everything that is always uncertain integrated out.

Residuals r = y - f are modelled as r = J theta + Z z + e with e ~ N(0, C), z ~ N(0, 1) the nuisance and theta ~ N(0,
prior) the parameters of a candidate. ``Marginal`` maps residuals and columns to r~ and J~ in which z is integrated
out and the noise is white, so that all that follows is ordinary ridge regression:

    A = J~^T J~ + prior^-1,   b = J~^T r~,   theta = A^-1 b,   covariance A^-1,   gain = b^T A^-1 b = 2 log(likelihood
    ratio, MAP).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.closed_loop.evidence.noise import Covariance, Nuisance, Rows
from livedeform.common.types import Array

LENGTHS = (1.0, 0.35, 0.12)  # of a step, tried until one betters the fit


class Marginal:
    """x -> x~ on all rows, or on those where ``keep`` is True: white, and with the nuisance integrated out.

    With L^-1 Z = U S V^T the marginal precision in white coordinates is I - U diag(s2 / (1 + s2)) U^T, whose root is
    I - U diag(1 - 1/sqrt(1 + s2)) U^T.
    """

    def __init__(self, covariance: Covariance, nuisance: Nuisance, keep: np.ndarray | None = None) -> None:
        self.whitener = covariance.whitener(keep)
        Zw = self.whitener.whiten(nuisance.columns)
        lmbda, V = np.linalg.eigh(Zw.T @ Zw)
        used = lmbda > 1e-10 * max(lmbda.max(initial=0.0), 1e-30)
        s2 = lmbda[used]
        self.U = (Zw @ V[:, used]) / np.sqrt(s2)
        self.shrink = 1.0 - 1.0 / np.sqrt(1.0 + s2)

    def __call__(self, x: Array) -> Array:
        xw = self.whitener.whiten(x)
        inside = self.U.T @ xw
        return xw - self.U @ (self.shrink * inside if inside.ndim == 1 else self.shrink[:, None] * inside)


@dataclass(frozen=True)
class Problem:
    """What was measured minus what the model at hand predicts, with all that is uncertain anyway: ``residual`` (n,)."""

    rows: Rows
    residual: Array
    covariance: Covariance
    nuisance: Nuisance

    def marginal(self, keep: np.ndarray | None = None) -> Marginal:
        return Marginal(self.covariance, self.nuisance, keep)

    @property
    def chi2(self) -> float:
        """Of the residual, with all that is uncertain anyway integrated out."""
        return float(np.sum(self.marginal()(self.residual) ** 2))


@dataclass(frozen=True)
class Ridge:
    """The normal equations of a set of columns: ``G`` (p, p) = J~^T J~, ``b`` (p,), ``c`` = r~^T r~, of ``n`` data."""

    G: Array
    b: Array
    c: float
    n: int

    def part(self, columns: Sequence[int] | np.ndarray) -> Ridge:
        i = np.asarray(columns, int)
        return Ridge(self.G[np.ix_(i, i)], self.b[i], self.c, self.n)

    def solve(self, sigma: Array, lower: Array, upper: Array) -> Solution:
        """MAP with priors of ``sigma`` (p,) about 0 and bounds; see `Solution`."""
        A = self.G + np.diag(1.0 / sigma**2)
        theta = _bounded(A, self.b, lower, upper)
        gain = float(2.0 * self.b @ theta - theta @ A @ theta)
        _, logdet = np.linalg.slogdet(A * np.outer(sigma, sigma))
        at_bound = (theta <= lower + 1e-12) | (theta >= upper - 1e-12)
        return Solution(theta, np.asarray(np.linalg.inv(A), float), gain, gain - float(logdet), at_bound)


@dataclass(frozen=True)
class Solution:
    """``theta`` (p,), its ``covariance`` (p, p), ``gain`` = twice the log likelihood ratio against theta = 0 (with the
    prior), ``evidence`` = twice the log of the marginal likelihood ratio, ``at_bound`` (p,)."""

    theta: Array
    covariance: Array
    gain: float
    evidence: float
    at_bound: np.ndarray


def normal_equations(marginal: Marginal, residual: Array, columns: Array) -> Ridge:
    """Of raw ``residual`` (n,) and ``columns`` (n, p) over all rows."""
    r, J = marginal(residual), marginal(columns)
    return Ridge(J.T @ J, J.T @ r, float(r @ r), len(r))


def _bounded(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """argmin 1/2 x^T A x - b^T x within bounds, by an active set (A positive definite, p small)."""
    x = np.linalg.solve(A, b)
    free = np.ones(len(b), bool)
    for _ in range(2 * len(b) + 2):
        low, high = free & (x < lower), free & (x > upper)
        if not (low | high).any():
            gradient = A @ x - b
            wrong = ~free & (((x <= lower) & (gradient < 0)) | ((x >= upper) & (gradient > 0)))
            if not wrong.any():
                break
            free[np.flatnonzero(wrong)[np.argmax(np.abs(gradient[wrong]))]] = True
        else:
            free &= ~(low | high)
            x = np.where(low, lower, np.where(high, upper, x))
        held = ~free
        if free.any():
            x[free] = np.linalg.solve(A[np.ix_(free, free)], b[free] - A[np.ix_(free, held)] @ x[held])
    return np.clip(x, lower, upper)


@dataclass(frozen=True)
class Fit:
    """A candidate, fitted through the nonlinear model.

    ``z`` (p,) in the candidate's coordinates, ``covariance`` (p, p), ``start`` (p,), ``at_bound`` (p,); ``gain`` =
    twice the log likelihood ratio against the model before (with the prior); ``residual`` (n,) and ``columns`` (n, p)
    at the fit; ``n_runs`` of the model; ``converged``.
    """

    z: Array
    covariance: Array
    start: Array
    at_bound: np.ndarray
    gain: float
    residual: Array
    columns: Array
    n_runs: int
    converged: bool

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """(p, p)."""
        s = self.sigma
        return self.covariance / np.outer(s, s)


Model = Callable[
    [Array], tuple[Array, Array]
]  # z (p,) -> measured minus predicted (n,), columns d(predicted)/dz (n, p)


def gauss_newton(
    model: Model,
    marginal: Marginal,
    start: Array,
    centre: Array,
    sigma: Array,
    lower: Array,
    upper: Array,
    *,
    c0: float,
    max_runs: int = 5,
    tolerance: float = 0.5,
) -> Fit:
    """MAP of a nonlinear candidate: Gauss-Newton with shortened steps, from ``start``, prior N(``centre``, ``sigma``),
    within bounds.

    ``c0`` is r~^T r~ of the model before. A step whose expected gain is below ``tolerance`` (in units of twice the
    log likelihood; 0.5 is a seventh of a sigma or so) ends it. A run that raises is a step too far.
    """
    z = np.clip(start, lower, upper)
    residual, columns = model(z)
    n_runs, converged = 1, False
    r, J = marginal(residual), marginal(columns)
    cost = float(r @ r + np.sum(((z - centre) / sigma) ** 2))
    while True:
        A = J.T @ J + np.diag(1.0 / sigma**2)
        b = J.T @ r - (z - centre) / sigma**2
        step = _bounded(A, b, lower - z, upper - z)
        expected = float(2.0 * b @ step - step @ A @ step)
        if expected < tolerance:
            converged = True
            break
        gained = 0.0
        for length in LENGTHS:
            if n_runs >= max_runs:
                break
            trial = z + length * step
            new_residual, new_columns = model(trial)
            n_runs += 1
            new_r = marginal(new_residual)
            new_cost = float(new_r @ new_r + np.sum(((trial - centre) / sigma) ** 2))
            if np.isfinite(new_cost) and new_cost < cost:
                gained, cost = cost - new_cost, new_cost
                z, residual, columns, r, J = trial, new_residual, new_columns, new_r, marginal(new_columns)
                break
        if gained == 0.0:  # no step that was tried is better, which does not say that none is
            break
        if gained < tolerance:
            converged = True
            break
    A = J.T @ J + np.diag(1.0 / sigma**2)
    at_bound = (z <= lower + 1e-9 * (upper - lower)) | (z >= upper - 1e-9 * (upper - lower))
    return Fit(z, np.asarray(np.linalg.inv(A), float), start, at_bound, c0 - cost, residual, columns, n_runs, converged)


def robust_inflation(rows: Rows, covariance: Covariance, residual: Array, *, threshold: float = 5.0) -> Array:
    """Factors (n,) >= 1 by which single marker-moments that nothing smooth explains are to be trusted less.

    The squared standardised residual of one marker at one moment, relative to the median of this marker and of this
    moment: a missing effect raises those too, a swapped or slipped marker raises itself only (Huber 1964, with the
    scale from the neighbours).
    """
    scaled = residual / np.sqrt(np.concatenate([np.diag(b) for b in covariance.blocks]))
    factors = np.ones(rows.n)
    is_point = rows.marker >= 0
    if not is_point.any():
        return factors
    k, m = rows.moment.max() + 1, rows.marker.max() + 1
    size = np.full((k, m), np.nan)
    total = np.zeros((k, m))
    np.add.at(total, (rows.moment[is_point], rows.marker[is_point]), scaled[is_point] ** 2)
    seen = np.zeros((k, m), bool)
    seen[rows.moment[is_point], rows.marker[is_point]] = True
    size[seen] = np.sqrt(total[seen] / 3.0)
    ever = np.ix_(seen.any(axis=1), seen.any(axis=0))
    usual = np.ones((k, m))
    usual[ever] = np.maximum(np.nanmedian(size[ever], axis=1)[:, None], np.nanquantile(size[ever], 0.75, axis=0)[None])
    ratio = size / np.maximum(usual, 1.0)
    excess = np.where(np.nan_to_num(ratio) > threshold, np.nan_to_num(ratio) / threshold, 1.0)
    factors[is_point] = excess[rows.moment[is_point], rows.marker[is_point]] ** 2
    return factors
