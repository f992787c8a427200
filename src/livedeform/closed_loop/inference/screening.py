"""Screen the effects: scores of all candidates at once, with control of false additions over all of them together.

A candidate's Jacobian columns at zero amplitude, one set per shape (place, time constant, thickness ...), make the
dictionary. On the fully whitened data (`gauss_newton.Marginal`) each has

- a *gain*, twice the log likelihood ratio of its best amplitude and shape, and its p-value: the gain's distribution
  when nothing but noise, marker places, registration and model error is there, by drawing data from exactly that
  (parametric bootstrap). The family-wise p-value of the m candidates is 1 - (1 - min p)^m (Sidak 1967), which holds for
  gains that are independent or positively dependent, and is too large rather than too small for candidates that look
  alike;
- a *score*, minus twice the log predictive density of left-out blocks (presses), relative to the model without it:
  what more parameters could do by chance costs there what it costs in truth (Geisser 1975; Vehtari & Ojanen 2012);
  and what it costs to doubt a stated value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from livedeform.closed_loop.candidates import Candidate, doubt
from livedeform.closed_loop.inference.gauss_newton import (
    Fit,
    LinearFit,
    Prior,
    Problem,
    Ridge,
)
from livedeform.closed_loop.inference.training import Products
from livedeform.closed_loop.settings import ScreeningSettings
from livedeform.common.types import Array


class Views(NamedTuple):
    """Scores of the left-out blocks of ``time`` and of the left-out groups of ``markers``, two views of one thing, and
    what the ``doubt`` of stated values costs."""

    time: float
    markers: float
    doubt: float = 0.0

    def score(self, mute: float) -> float:
        """Take the view that says more, provided that the other does not contradict: what is constant is mute in time,
        give or take the share ``mute`` of what it says."""
        more, less = min(self.time, self.markers), max(self.time, self.markers)
        return (more if less < mute * abs(more) else less) + self.doubt

    @property
    def together(self) -> float:
        """Both views."""
        return self.time + self.markers + 2.0 * self.doubt

    def behind(self, other: Views) -> float:
        """Tell by how much it predicts worse than the other: in the view that tells more, or in what they leave
        together where they contradict each other. In one view alone two models may be alike: a body that is stiffer
        stands as high as one whose surface was scanned under less weight, whichever markers say so, but is pressed
        otherwise."""
        doubt = self.doubt - other.doubt
        time, markers = self.time - other.time + doubt, self.markers - other.markers + doubt
        return max(time, markers, key=abs) if time * markers > 0.0 else time + markers


@dataclass(frozen=True)
class DictionaryEntry:
    """One shape of one candidate: Jacobian ``columns`` (p,) of the dictionary, with priors and bounds of their
    amplitudes, and what is ``stated`` of them."""

    name: str
    shape: int
    columns: tuple[int, ...]
    sigma: Array
    lower: Array
    upper: Array
    stated: Array


@dataclass(frozen=True)
class Score:
    """A candidate's best entry: ``gain``, cross-validated ``score`` (negative is better), ``p_value`` under noise
    alone, its linear ``fit``, ``gains`` of all of its shapes, ``block_scores`` as `by_time`, ``views``. ``opposite``:
    shape and fit of its best entry of the other sign; None where there is none."""

    name: str
    shape: int
    gain: float
    p_value: float
    fit: LinearFit
    opposite: tuple[int, LinearFit] | None
    gains: Array
    block_scores: Array
    views: Views
    score: float


@dataclass(frozen=True)
class Screened:
    """All candidates, best score first, and the family-wise p-value of the best gain."""

    scores: tuple[Score, ...]
    family_p: float

    def __getitem__(self, name: str) -> Score:
        return next(s for s in self.scores if s.name == name)


@dataclass(frozen=True)
class Screening:
    """The method: scores of all candidates by the linear problem."""

    settings: ScreeningSettings

    def __call__(
        self, problem: Problem, dictionary: Array, entries: Sequence[DictionaryEntry], *, seed: int = 0
    ) -> Screened:
        """Score every candidate of the ``dictionary`` (n, P) on the problem's residual."""
        names = list(dict.fromkeys(e.name for e in entries))
        if not names:
            return Screened((), 1.0)
        products = self.products(problem, np.column_stack([dictionary, problem.residual]))
        ridges = [Ridge.of(product) for product in products.all]
        n_time, marginal = len(products.time), problem.marginal
        draws = marginal(noise_draws(problem, np.random.default_rng(seed), self.settings.draws))
        b_draws = marginal(dictionary).T @ draws
        scores = [self._score([e for e in entries if e.name == name], ridges, b_draws, n_time) for name in names]
        scores.sort(key=lambda s: s.score)
        return Screened(tuple(scores), family_wise([s.p_value for s in scores]))

    def _score(self, entries: Sequence[DictionaryEntry], ridges: Sequence[Ridge], b_draws: Array, n_time: int) -> Score:
        """Score one candidate by its ``entries``, one per shape."""
        fits = [_solve(ridges[0], e) for e in entries]
        gains = np.array([s.gain for s in fits])
        best = int(np.argmax([s.evidence for s in fits]))
        null = np.max([_gains(ridges[0].G, b_draws, e) for e in entries], axis=0)
        p_value = tail_probability(float(gains.max()), null, self.settings.tail)
        per_set = _cross_validated(ridges, entries)
        views = views_of(per_set, n_time, doubt(fits[best].theta, entries[best].stated, self.settings.doubt))
        return Score(
            name=entries[best].name,
            shape=entries[best].shape,
            gain=float(gains[best]),
            p_value=p_value,
            fit=fits[best],
            opposite=_opposite(entries, fits, best),
            gains=gains,
            block_scores=by_time(per_set, n_time),
            views=views,
            score=views.score(self.settings.mute),
        )

    def cross_validated(self, problem: Problem, fit: Fit, *candidates: Candidate) -> tuple[Views, Array]:
        """Score a nonlinear fit of candidates by its linearisation: its views, and scores of the blocks of time."""

        prior, n = Prior.of(candidates, fit.z), len(fit.z)
        sigma, slope = 1.0 / np.sqrt(prior.precision(fit.z)), prior.slope(fit.z)

        def evidence(product: Array) -> float:
            A = product[:n, :n] + np.diag(1.0 / sigma**2)
            b = product[:n, n] - slope
            _, logdet = np.linalg.slogdet(A * np.outer(sigma, sigma))
            left = product[n, n] + prior.cost(fit.z) - b @ np.linalg.solve(A, b)
            return float(product[n + 1, n + 1] - left - logdet)

        products = self.products(problem, np.column_stack([fit.columns, fit.residual, problem.residual]))
        stated = np.concatenate([c.stated for c in candidates])
        full, *sets = [evidence(product) for product in products.all]
        per_set, n_time = np.array(sets) - full, len(products.time)
        return views_of(per_set, n_time, doubt(fit.z, stated, self.settings.doubt)), by_time(per_set, n_time)

    def products(self, problem: Problem, columns: Array) -> Products:
        """Form the products of ``columns`` (n, p) over all data and over each training set."""
        return Products.of(problem, columns, self.settings.marker_folds)


def family_wise(p_values: Sequence[float]) -> float:
    """P(the least of so many p-values is as small), 1 - (1 - min p)^m (Sidak 1967)."""
    return float(1.0 - (1.0 - min(p_values)) ** len(p_values))


def views_of(per_set: Array, n_time: int, doubt: float) -> Views:
    """Sum the scores of all left-out sets, blocks of time first."""
    return Views(float(per_set[:n_time].sum()), float(per_set[n_time:].sum()), doubt)


def by_time(per_set: Array, n_time: int) -> Array:
    """Take the scores of the blocks of time; nothing where groups of markers say more: what is constant, as a wrong
    scale, says little in a block, since the markers' places have learned it from the others."""
    time, markers = per_set[:n_time], per_set[n_time:]
    return time if time.sum() <= markers.sum() else np.zeros(n_time)


def in_one_block(block_scores: Array) -> bool:
    """Tell whether the blocks besides the best one speak against it: what is odd about one press is no effect."""
    return bool(block_scores.sum() - block_scores.min() > 0.0)


def _solve(ridge: Ridge, entry: DictionaryEntry) -> LinearFit:
    return ridge.part(entry.columns).solve(entry.sigma, entry.lower, entry.upper)


def _opposite(entries: Sequence[DictionaryEntry], fits: Sequence[LinearFit], best: int) -> tuple[int, LinearFit] | None:
    """Find the best entry whose one amplitude has the other sign: a soft ball above a press and a stiff one below it
    are alike to first order, and no way leads from one to the other."""
    if len(fits[best].theta) != 1:
        return None
    others = [i for i, fit in enumerate(fits) if fit.theta[0] * fits[best].theta[0] < 0.0]
    if not others:
        return None
    i = max(others, key=lambda k: fits[k].evidence)
    return entries[i].shape, fits[i]


def _cross_validated(ridges: Sequence[Ridge], entries: Sequence[DictionaryEntry]) -> Array:
    """-2 log p(y_s | y_-s) of the candidate over that of the model without it, for each left-out set s; its shape is
    chosen without y_s.

    log p(y_s | y_-s) = log p(y) - log p(y_-s), and each log p is a ridge regression's evidence. ``ridges`` are of all
    data, then without each set. Parameters common to both models cancel.
    """
    full = [_solve(ridges[0], e).evidence for e in entries]
    out = []
    for train in ridges[1:]:
        evidence = [_solve(train, e).evidence for e in entries]
        pick = int(np.argmax(evidence))
        out.append(evidence[pick] - full[pick])
    return np.array(out)


def noise_draws(problem: Problem, rng: np.random.Generator, n: int) -> Array:
    """Draw residuals (rows, n) that hold nothing but C and the nuisance."""
    whitener = problem.covariance.whitener
    noise = whitener.color(rng.standard_normal((problem.rows.n, n)), problem.rows.n)
    return np.asarray(
        noise + problem.nuisance.columns @ rng.standard_normal((problem.nuisance.columns.shape[1], n)), float
    )


def _gains(G: Array, b_draws: Array, entry: DictionaryEntry) -> Array:
    """Gains (n_draws,) of one entry on draws."""
    i = np.array(entry.columns)
    A = G[np.ix_(i, i)] + np.diag(1.0 / entry.sigma**2)
    b = b_draws[i]
    theta = np.linalg.solve(A, b)
    theta = np.clip(theta, entry.lower[:, None], entry.upper[:, None])
    gains = 2.0 * (b * theta).sum(axis=0) - np.einsum("pd,pq,qd->d", theta, A, theta)
    return np.asarray(np.maximum(gains, 0.0))


def tail_probability(value: float, null: Array, tail: int) -> float:
    """P(null >= value): empirical where ``tail`` draws lie beyond, else with the tail of a shifted chi-square of the
    draws' mean and variance (gains are sums of squares of weights up to 1), which never falls faster than exp(-x/2).

    The more parameters, the slower it falls at first: with exp(-x/2) a black box of 210 columns had p < 0.002 in one of
    a hundred draws of noise.
    """
    n = len(null)
    beyond = int((null >= value).sum())
    if beyond >= tail:
        return (beyond + 1) / (n + 1)
    level = float(np.sort(null)[max(n - tail, 0)])
    if value <= level:
        return min((beyond + 1) / (n + 1), 1.0)
    dof = max(0.5 * float(np.var(null)), 2.0)
    shift = float(np.mean(null)) - dof
    return float(tail / n * np.exp(chi2.logsf(value - shift, dof) - chi2.logsf(level - shift, dof)))


# --- what cannot be told apart
# -----------------------------------------------------------------------------------------


def leader(views: Mapping[str, Views]) -> str:
    """Name the one that predicts best in both views together."""
    return min(views, key=lambda name: views[name].together)


def indistinguishable(
    views: Mapping[str, Views], gain: float, settings: ScreeningSettings, left: Mapping[str, Array] | None = None
) -> dict[str, tuple[str, ...]]:
    """List for each candidate those that the data cannot tell from it, nearest first.

    Two belong together where one is behind the other by less than ``min_gap``, or by less than ``gap_share`` of the
    best one's ``gain``: a model that is right within a few per cent cannot decide by less than that. So do two that
    predict the same: what is ``left`` (n,), whitened, by either's fit differs by d; if one were right, its chi2 would
    be smaller by d^T d in the mean. And so do two whose chi2 are alike though they predict otherwise: the data lie
    between them. A lead that the chi2 do not show is of priors, or of fits that have not settled, not of data.

    All that belong to the best one are one set, each other's rivals: the one that is named is the simplest of them,
    which need not be the best.
    """
    limit = max(settings.min_gap, settings.gap_share * gain)
    left = left or {}

    def alike(a: str, b: str) -> bool:
        if abs(views[a].behind(views[b])) < limit:
            return True
        if a not in left or b not in left:
            return False
        apart, lead = np.sum((left[a] - left[b]) ** 2), np.sum(left[a] ** 2) - np.sum(left[b] ** 2)
        return bool(min(apart, abs(lead)) < settings.min_gap)

    groups = {a: {b for b in views if b != a and alike(a, b)} for a in views}
    if views:
        best = leader(views)
        for a in groups[best]:
            groups[a] |= groups[best] - {a} | {best}
    return {a: tuple(sorted(group, key=lambda b: abs(views[a].behind(views[b])))) for a, group in groups.items()}
