"""Baselines: what simpler methods, as people use them today, make of the same recordings. Never acted upon.

- *modulus alone*: the stiffness is refitted, whatever is the matter;
- *Gaussian process*: a discrepancy as a smooth function of the place and of the predicted displacement, learned on the
  fitted recordings and added to the predictions of the others (Kennedy & O'Hagan 2001); it names nothing;
- *BIC*: of all candidates the one with the least n ln(RSS / n) + p ln n, by ordinary least squares (Schwarz 1978);
- *signature*: the candidate whose predicted change of the markers is most like the residual (its cosine);
- *EDMF*: error-domain model falsification: every candidate stays that, at its best values, explains each single datum
  to within what all uncertainties together allow (Pasquier & Smith 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtri

from livedeform.closed_loop.evidence.measuring_noise import MAD_PER_SIGMA
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.screening import DictionaryEntry
from livedeform.closed_loop.settings import BaselineSettings
from livedeform.common.types import Array

RELIABILITY = 0.95  # with which a right model survives falsification, over all data together
MOTION = 6  # numbers of an input: a place, and where it is predicted to have moved


@dataclass(frozen=True)
class Baselines:
    """``by_bic`` and ``by_signature`` name a candidate ('' for none); ``not_falsified`` are those that EDMF leaves, ''
    for the declared model; ``modulus_rmse``, ``process_rmse`` m of what was held out; ``cosine`` of the most similar
    signature; ``finer_before``, ``finer_after`` m: the errors of the declared and the fitted model with what a finer
    mesh tells differently taken off."""

    by_bic: str
    by_signature: str
    not_falsified: tuple[str, ...]
    cosine: float
    modulus_rmse: float
    process_rmse: float
    finer_before: float
    finer_after: float

    def as_dict(self) -> dict[str, Any]:
        """Return the record for a JSON file; what is not known is null."""

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        return {
            "bic": self.by_bic or "none",
            "signature": self.by_signature or "none",
            "edmf": [name or "none" for name in self.not_falsified],
            "cosine": number(self.cosine),
            "modulus_rmse": number(self.modulus_rmse),
            "process_rmse": number(self.process_rmse),
            "finer_before_rmse": number(self.finer_before),
            "finer_after_rmse": number(self.finer_after),
        }


def by_bic(problem: Problem, dictionary: Array, entries: Sequence[DictionaryEntry]) -> str:
    """The candidate's name, '' where none is worth its parameters."""
    r, J = _of_markers(problem, dictionary)
    n = len(r)
    best, name = n * np.log(r @ r / n), ""
    for e in entries:
        columns = J[:, list(e.columns)]
        left = r - columns @ np.linalg.lstsq(columns, r, rcond=None)[0]
        shapes = sum(other.name == e.name for other in entries) > 1
        bic = n * np.log(left @ left / n) + (len(e.columns) + shapes) * np.log(n)
        if bic < best:
            best, name = bic, e.name
    return name


def by_signature(
    problem: Problem, dictionary: Array, entries: Sequence[DictionaryEntry], settings: BaselineSettings
) -> tuple[str, float]:
    """The candidate's name, '' where nothing is similar, and the cosine."""
    r, J = _of_markers(problem, dictionary)
    best, name = 0.0, ""
    for e in entries:
        columns = J[:, list(e.columns)]
        like = columns @ np.linalg.lstsq(columns, r, rcond=None)[0]
        size = float(np.linalg.norm(like) * np.linalg.norm(r))
        cosine = float(like @ r) / size if size > 0.0 else 0.0
        if cosine > best:
            best, name = cosine, e.name
    return (name if best > settings.similar else ""), best


def not_falsified(problem: Problem, dictionary: Array, entries: Sequence[DictionaryEntry]) -> tuple[str, ...]:
    """Return the candidates that no datum falsifies, '' for the declared model; none where all are falsified.

    Bounds are those of each datum's combined uncertainty, at a reliability of 0.95^(1/n) for each of n (Sidak 1967).
    """
    r, J = _of_markers(problem, dictionary)
    keep = problem.rows.marker >= 0
    variance = np.concatenate([np.diag(block) for block in problem.covariance.blocks])
    sigma = np.sqrt(variance + np.sum(problem.nuisance.columns**2, axis=1))[keep]
    r, J = r / sigma, J / sigma[:, None]
    bound = float(ndtri(0.5 * (1.0 + RELIABILITY ** (1.0 / len(r)))))
    left = [""] if np.abs(r).max() <= bound else []
    for e in entries:
        columns = J[:, list(e.columns)]
        if np.abs(r - columns @ np.linalg.lstsq(columns, r, rcond=None)[0]).max() <= bound and e.name not in left:
            left.append(e.name)
    return tuple(left)


def _of_markers(problem: Problem, dictionary: Array) -> tuple[Array, Array]:
    keep = problem.rows.marker >= 0
    return problem.residual[keep], dictionary[keep]


def process_discrepancy(
    known: Array, residual: Array, wanted: Array, settings: BaselineSettings, *, seed: int = 0
) -> Array:
    """The discrepancy (w, 3) at inputs ``wanted`` (w, d), from ``residual`` (n, 3) at ``known`` (n, d): a Gaussian
    process with a squared-exponential kernel, its length and size by the marginal likelihood."""
    good = np.isfinite(residual).all(axis=1) & np.isfinite(known).all(axis=1)
    known, residual = known[good], residual[good]
    pick = np.random.default_rng(seed).permutation(len(known))[: settings.most]
    known, residual = known[pick], residual[pick]
    spread = np.maximum(known.std(axis=0), 1e-9)
    a, b = known / spread, wanted / spread
    noise = float(np.median(np.abs(residual))) / MAD_PER_SIGMA
    length, size = _by_evidence(a[: settings.chosen_by], residual[: settings.chosen_by], noise, settings)
    factor = cho_factor(size * _kernel(a, a, length) + noise**2 * np.eye(len(a)), overwrite_a=True)
    return np.asarray(size * _kernel(b, a, length) @ cho_solve(factor, residual))


def _by_evidence(known: Array, residual: Array, noise: float, settings: BaselineSettings) -> tuple[float, float]:
    """Choose the length and the variance m2 of the process by its marginal likelihood."""
    best, chosen = -np.inf, (settings.lengths[0], 0.0)
    for length in settings.lengths:
        K = _kernel(known, known, length)
        for ratio in settings.ratios:
            size = (ratio * noise) ** 2
            factor = cho_factor(size * K + noise**2 * np.eye(len(known)), overwrite_a=True)
            fits = float(np.sum(residual * cho_solve(factor, residual)))
            evidence = -0.5 * fits - 3.0 * float(np.log(np.diag(factor[0])).sum())
            if evidence > best:
                best, chosen = evidence, (length, size)
    return chosen


def process_inputs(points: Array, places: Array) -> Array:
    """Inputs (k m, 6): a marker's place (m, 3) at rest, and where it is predicted to have moved (k, m, 3), m."""
    return np.concatenate([np.broadcast_to(places, points.shape), points - places], axis=2).reshape(-1, MOTION)


def _kernel(a: Array, b: Array, length: float) -> Array:
    d2 = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1)[None] - 2.0 * a @ b.T
    return np.asarray(np.exp(-0.5 * np.maximum(d2, 0.0) / (a.shape[1] * length**2)))
