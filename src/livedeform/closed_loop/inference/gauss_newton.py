"""Weighted least squares and MAP with everything that is always uncertain integrated out.

Residuals r = y - f are modelled as r = J theta + Z z + e with e ~ N(0, C), z ~ N(0, 1) the nuisance and theta ~ N(0,
prior) the parameters of a candidate. `Marginal` maps residuals and Jacobian columns to r~ and J~ in which z is
integrated out and the noise is white, so that all that follows is ordinary ridge regression:

    A = J~^T J~ + prior^-1,   b = J~^T r~,   theta = A^-1 b,   covariance A^-1,   gain = b^T A^-1 b = 2 log(likelihood
    ratio, MAP).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from livedeform.closed_loop.candidates import Candidate, Coordinate
from livedeform.closed_loop.evidence.noise import Covariance, Nuisance, Rows
from livedeform.closed_loop.settings import FitSettings
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array

NOTHING, RANK = 1e-30, 1e-10  # least square of a nuisance, and share of the largest one below which it adds nothing
ON_BOUND = 1e-12  # within which a coordinate sits on its bound


class Marginal:
    """Map x -> x~ on all rows, or on those where ``keep`` is True: white, and with the nuisance integrated out.

    With L^-1 Z = U S V^T the marginal precision in white coordinates is I - U diag(s2 / (1 + s2)) U^T, whose root is
    I - U diag(1 - 1/sqrt(1 + s2)) U^T.
    """

    def __init__(self, covariance: Covariance, nuisance: Nuisance, keep: np.ndarray | None = None) -> None:
        self.whitener = covariance.whitener if keep is None else covariance.whitener_of(keep)
        Zw = self.whitener.whiten(nuisance.columns)
        lmbda, V = np.linalg.eigh(Zw.T @ Zw)
        used = lmbda > RANK * max(lmbda.max(initial=0.0), NOTHING)
        s2 = lmbda[used]
        self.U = (Zw @ V[:, used]) / np.sqrt(s2)
        self.shrink = 1.0 - 1.0 / np.sqrt(1.0 + s2)

    def __call__(self, x: Array) -> Array:
        xw = self.whitener.whiten(x)
        inside = self.U.T @ xw
        return np.asarray(xw - self.U @ (self.shrink * inside if inside.ndim == 1 else self.shrink[:, None] * inside))


@dataclass(frozen=True)
class Problem:
    """A least-squares problem: what was measured minus what the model at hand predicts, with all that is uncertain
    anyway: ``residual`` (n,)."""

    rows: Rows
    residual: Array
    covariance: Covariance
    nuisance: Nuisance

    @cached_property
    def marginal(self) -> Marginal:
        """Integrates the nuisance out, on all rows."""
        return Marginal(self.covariance, self.nuisance)

    def marginal_of(self, keep: np.ndarray) -> Marginal:
        """Integrate the nuisance out on the rows to ``keep`` (n,)."""
        return Marginal(self.covariance, self.nuisance, keep)

    @property
    def chi2(self) -> float:
        """Chi-square of the residual, with all that is uncertain anyway integrated out."""
        return self.chi2_of(self.residual)

    def chi2_of(self, residual: Array) -> float:
        """Return the chi-square of another ``residual`` (n,)."""
        return float(np.sum(self.marginal(residual) ** 2))

    def left(self, fit: Fit) -> float:
        """Return the chi2 per datum that a fit of it leaves; NaN of a fit to other data."""
        if len(fit.residual) != self.rows.n:
            return float("nan")
        return self.chi2_of(fit.residual) / self.rows.n


@dataclass(frozen=True)
class Ridge:
    """Normal equations of Jacobian columns: ``G`` (p, p) = J~^T J~, ``b`` (p,) = J~^T r~, ``c`` = r~^T r~."""

    G: Array
    b: Array
    c: float

    @classmethod
    def of(cls, products: Array) -> Ridge:
        """Take them from the ``products`` (p + 1, p + 1) of the columns and, last, the residual."""
        return cls(products[:-1, :-1], products[:-1, -1], float(products[-1, -1]))

    def part(self, columns: Sequence[int] | np.ndarray) -> Ridge:
        """Keep some of the columns."""
        i = np.asarray(columns, int)
        return Ridge(self.G[np.ix_(i, i)], self.b[i], self.c)

    def solve(self, sigma: Array, lower: Array, upper: Array) -> LinearFit:
        """Find the MAP with priors of ``sigma`` (p,) about 0 and bounds; see `LinearFit`."""
        A = self.G + np.diag(1.0 / sigma**2)
        theta = bounded_minimum(A, self.b, lower, upper)
        gain = float(2.0 * self.b @ theta - theta @ A @ theta)
        _, logdet = np.linalg.slogdet(A * np.outer(sigma, sigma))
        at_bound = (theta <= lower + ON_BOUND) | (theta >= upper - ON_BOUND)
        return LinearFit(theta, np.asarray(np.linalg.inv(A), float), gain, gain - float(logdet), at_bound)


@dataclass(frozen=True)
class LinearFit:
    """``theta`` (p,), its ``covariance`` (p, p), ``gain`` = twice the log likelihood ratio against theta = 0 (with the
    prior), ``evidence`` = twice the log of the marginal likelihood ratio, ``at_bound`` (p,)."""

    theta: Array
    covariance: Array
    gain: float
    evidence: float
    at_bound: np.ndarray


def normal_equations(marginal: Marginal, residual: Array, columns: Array) -> Ridge:
    """Form the normal equations of raw ``residual`` (n,) and Jacobian ``columns`` (n, p) over all rows."""
    both = marginal(np.column_stack([columns, residual]))
    return Ridge.of(both.T @ both)


def bounded_minimum(A: Array, b: Array, lower: Array, upper: Array) -> Array:
    """Find argmin 1/2 x^T A x - b^T x within bounds, by an active set (A positive definite, p small)."""
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
    twice the log likelihood ratio against the model before (with the prior); ``residual`` (n,) and Jacobian
    ``columns`` (n, p) at the fit; ``n_runs`` of the model; ``converged``.
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
        """One standard deviation (p,) of each coordinate."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def correlation(self) -> Array:
        """Correlations (p, p) of the coordinates."""
        s = self.sigma
        return self.covariance / np.outer(s, s)

    def part(self, at: slice) -> Fit:
        """Return the coordinates ``at`` alone, the others as they are."""
        cut = {name: getattr(self, name)[at] for name in ("z", "start", "at_bound")}
        return replace(self, **cut, covariance=self.covariance[at, at], columns=self.columns[:, at])

    def has_settled(self, before: Fit) -> bool:
        """Tell whether nothing has moved by more than its sigma since the fit ``before``."""
        return bool(np.all(np.abs(self.z - before.z) < self.sigma))


# z (p,) -> measured minus predicted (n,), Jacobian columns d(predicted)/dz (n, p)
Residuals = Callable[[Array], tuple[Array, Array]]
# z (p,) -> measured minus predicted (n,) alone
Glance = Callable[[Array], Array]


@dataclass(frozen=True)
class Prior:
    """Prior of coordinates, cut off at ``lower`` and ``upper`` (p,): normal about ``centre`` with ``sigma`` (p,), but
    for those of the ``coordinates`` (p, or none) that have a `usual` one.

    A ball's size and contrast are nearly one number to who sees it from afar: of all that look alike the likelihood
    says nothing, and the best point is where the prior has it. In the logarithms of the radius and of what is seen of a
    contrast these are a straight line, and it is where most of them are; in that of the ratio of moduli it would be far
    from there, at a large ball that is hardly stiffer.
    """

    centre: Array
    sigma: Array
    lower: Array
    upper: Array
    coordinates: tuple[Coordinate, ...] = ()

    @classmethod
    def of(cls, candidates: Sequence[Candidate], start: Array) -> Prior:
        """Return that of all coordinates; one that nothing slopes towards stays at its ``start`` (p,)."""
        arrays = ("centre", "sigma", "lower", "upper")
        centre, sigma, lower, upper = (np.concatenate([c.array(name) for c in candidates]) for name in arrays)
        coordinates = tuple(c for candidate in candidates for c in candidate.coordinates)
        between = np.array([bool(c.edges) for c in coordinates])
        return cls(np.where(between, start, centre), sigma, lower, upper, coordinates)

    def cost(self, z: Array) -> float:
        """Minus twice the log density at ``z`` (p,), but for a constant."""
        return float(np.sum(self._away(z)[0] ** 2))

    def slope(self, z: Array) -> Array:
        """Return half the derivative (p,) of the cost."""
        away, by = self._away(z)
        return away * by

    def precision(self, z: Array) -> Array:
        """Return the inverse squares (p,) of its sigmas at ``z`` (p,), to first order."""
        return self._away(z)[1] ** 2

    def at_bound(self, z: Array) -> NDArray[np.bool_]:
        """Tell which coordinates of ``z`` (p,) are at a bound."""
        near = 1e-9 * (self.upper - self.lower)
        return np.asarray((z <= self.lower + near) | (z >= self.upper - near))

    def _away(self, z: Array) -> tuple[Array, Array]:
        """Return how far (p,) from the middle ``z`` (p,) is, in sigmas, and the derivative (p,) of that."""
        away, by = (z - self.centre) / self.sigma, 1.0 / self.sigma
        for i, coordinate in enumerate(self.coordinates):
            found = coordinate.from_usual(float(z[i]))
            if found is not None:
                away[i], by[i] = found
        return away, by


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton with shortened steps: the MAP of a nonlinear candidate within bounds.

    A step whose expected gain is below ``settings.tolerance`` ends it. Where a ``glance`` at a place costs far less
    than its columns, as along a motion, a step is taken only if that is better, and is damped instead of shortened
    (Marquardt 1963): what swings depends on all coordinates through its rate, and a step that is too long in those
    which hardly matter spoils what is right of the others.
    """

    settings: FitSettings

    def __call__(
        self,
        residuals: Residuals,
        marginal: Marginal,
        start: Array,
        prior: Prior,
        *,
        c0: float,
        max_runs: int,
        glance: Glance | None = None,
    ) -> Fit:
        """Fit from ``start`` (p,) by at most ``max_runs`` of the model; ``c0`` is r~^T r~ of the model before. Raises
        ``ConvergenceError`` if the model is lost at the start."""
        z = np.clip(start, prior.lower, prior.upper)
        residual, columns = residuals(z)
        n_runs, converged, level = 1, False, 0
        r, J = marginal(residual), marginal(columns)
        cost = _cost(r, prior, z)
        while True:
            # 1. the step that the linearisation asks for
            A, b, step, expected = _next_step(r, J, prior, z)
            if expected < self.settings.tolerance:
                converged = True
                break
            # 2. as much of it as betters the fit
            gained = 0.0
            for number, trial in enumerate(self._trials(z, step, A, b, prior, level, damped=glance is not None)):
                if n_runs >= max_runs:
                    break
                if glance is not None and not _betters(glance, marginal, prior, trial, cost):
                    continue
                n_runs += 1
                new_residual, new_columns = _or_lost(residuals, trial, residual, columns)
                new_r = marginal(new_residual)
                new_cost = _cost(new_r, prior, trial)
                if np.isfinite(new_cost) and new_cost < cost:
                    gained, cost, level = cost - new_cost, new_cost, max(level + number - 1, 0)
                    z, residual, columns, r, J = trial, new_residual, new_columns, new_r, marginal(new_columns)
                    break
            if gained == 0.0:  # no step that was tried is better, which does not say that none is
                break
            if gained < self.settings.tolerance:
                converged = True
                break
        A = J.T @ J + np.diag(prior.precision(z))
        covariance = np.asarray(np.linalg.inv(A), float)
        return Fit(z, covariance, start, prior.at_bound(z), c0 - cost, residual, columns, n_runs, converged)

    def last_step(self, fit: Fit, marginal: Marginal, prior: Prior, held: Prior) -> Fit | None:
        """Return a fit, which the prior ``held``, with the step that it would still go by ``prior``, as its own columns
        tell what that changes: the model is not run for a step of which little is expected, but that may be 0.7 sigma.
        None where more is expected."""
        r, J = marginal(fit.residual), marginal(fit.columns)
        A, _, step, expected = _next_step(r, J, prior, fit.z)
        if expected >= self.settings.tolerance:
            return None
        z, covariance = fit.z + step, np.asarray(np.linalg.inv(A), float)
        at_bound, residual = prior.at_bound(z), fit.residual - fit.columns @ step
        gain = fit.gain + held.cost(fit.z) - prior.cost(fit.z) + expected
        return replace(fit, z=z, covariance=covariance, at_bound=at_bound, gain=gain, residual=residual)

    def _trials(
        self, z: Array, step: Array, A: Array, b: Array, prior: Prior, level: int, *, damped: bool
    ) -> Iterator[Array]:
        """Yield the places (p,) to try from ``z``: along the ``step``, or ``damped`` more and more from a level on."""
        if not damped:
            yield from (z + length * step for length in self.settings.lengths)
            return
        for damping in self.settings.dampings[level:]:
            yield z + bounded_minimum(A + damping * np.diag(np.diag(A)), b, prior.lower - z, prior.upper - z)


def _next_step(r: Array, J: Array, prior: Prior, z: Array) -> tuple[Array, Array, Array, float]:
    """Return the normal equations A (p, p) and b (p,) at ``z`` (p,), of the whitened residual ``r`` (n,) and columns
    ``J`` (n, p), the step within bounds that these ask for, and the gain that is expected of it."""
    A = J.T @ J + np.diag(prior.precision(z))
    b = J.T @ r - prior.slope(z)
    step = bounded_minimum(A, b, prior.lower - z, prior.upper - z)
    return A, b, step, float(2.0 * b @ step - step @ A @ step)


def _or_lost(residuals: Residuals, z: Array, residual: Array, columns: Array) -> tuple[Array, Array]:
    """Return the residual and columns at ``z`` (p,); a residual of NaN, shaped as the last ones are, where the model is
    lost: that is no better, and a shorter step may be."""
    try:
        return residuals(z)
    except ConvergenceError:
        return np.full_like(residual, np.nan), columns


def _betters(glance: Glance, marginal: Marginal, prior: Prior, z: Array, cost: float) -> bool:
    """Tell whether a glance at ``z`` (p,) costs less than ``cost``; it does not where the model is lost."""
    try:
        return _cost(marginal(glance(z)), prior, z) < cost
    except ConvergenceError:
        return False


def _cost(r: Array, prior: Prior, z: Array) -> float:
    """Minus twice the log posterior at ``z`` (p,), of the whitened residual ``r`` (n,), but for a constant."""
    return float(r @ r + prior.cost(z))
