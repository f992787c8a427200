"""Which effect: scores of all candidates at once, with control of false additions over all of them together.

A candidate's columns at zero amplitude, one set per shape (place, time constant, thickness ...), make the dictionary.
On the fully whitened data (`fit.Marginal`) each has

- a *gain*, twice the log likelihood ratio of its best amplitude and shape, and the gain's distribution when nothing
  but noise,
  marker places, registration and model error is there, by drawing data from exactly that (parametric bootstrap): the
  family-wise p-value is that of the largest gain over all candidates together, each against its own distribution
  (Westfall & Young 1993);
- a *score*, minus twice the log predictive density of left-out blocks (presses), relative to the model without it:
  what more parameters could do by chance costs there what it costs in truth (Geisser 1975; Vehtari & Ojanen 2012);
  and what it costs to doubt a stated value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from livedeform.closed_loop.candidates import doubt
from livedeform.closed_loop.inference.gauss_newton import Problem, Ridge, Solution, normal_equations
from livedeform.common.types import Array

MIN_GAP = 9.0
GAP_SHARE = 0.02
MARKER_FOLDS = 4
MUTE = 0.1


class Views(NamedTuple):
    """Scores of the left-out blocks of ``time`` and of the left-out groups of ``markers``, two views of one thing, and
    what the ``doubt`` of stated values costs."""

    time: float
    markers: float
    doubt: float = 0.0

    @classmethod
    def of(cls, per_set: Array, n_time: int, doubt: float) -> Views:
        """Of all left-out sets, blocks of time first."""
        return cls(float(per_set[:n_time].sum()), float(per_set[n_time:].sum()), doubt)

    @property
    def score(self) -> float:
        """Of the view that says more, provided that the other does not contradict: what is constant is mute in time,
        give or take `MUTE` of what it says."""
        more, less = min(self.time, self.markers), max(self.time, self.markers)
        return (more if less < MUTE * abs(more) else less) + self.doubt

    @property
    def together(self) -> float:
        """Both views."""
        return self.time + self.markers + 2.0 * self.doubt

    def behind(self, other: Views) -> float:
        """By how much it predicts worse than the other: in the view that tells more, or in what they leave together
        where they contradict each other. In one view alone two models may be alike: a body that is stiffer stands as
        high as one whose surface was scanned under less weight, whichever markers say so, but is pressed otherwise."""
        doubt = self.doubt - other.doubt
        time, markers = self.time - other.time + doubt, self.markers - other.markers + doubt
        return max(time, markers, key=abs) if time * markers > 0.0 else time + markers


@dataclass(frozen=True)
class Entry:
    """One shape of one candidate: ``columns`` (p,) of the dictionary, with priors and bounds of their amplitudes, and
    what is ``stated`` of them."""

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
    alone, its ``solution``, ``gains`` of all of its shapes, ``block_scores`` as `by_time`, ``views``."""

    name: str
    shape: int
    gain: float
    p_value: float
    solution: Solution
    gains: Array
    block_scores: Array
    views: Views

    @property
    def score(self) -> float:
        return self.views.score


@dataclass(frozen=True)
class Screening:
    """All candidates, best score first, and the family-wise p-value of the best gain."""

    scores: tuple[Score, ...]
    family_p: float
    n_draws: int

    def __getitem__(self, name: str) -> Score:
        return next(s for s in self.scores if s.name == name)


def screen(
    problem: Problem, dictionary: Array, entries: Sequence[Entry], *, n_draws: int = 200, seed: int = 0
) -> Screening:
    """Scores every candidate of the ``dictionary`` (n, P) on the problem's residual."""
    names = list(dict.fromkeys(e.name for e in entries))
    if not names:
        return Screening((), 1.0, 0)
    marginals = [problem.marginal()] + [problem.marginal(keep) for keep in training_sets(problem)]
    ridges = [normal_equations(m, problem.residual, dictionary) for m in marginals]
    n_time = len(np.unique(problem.rows.fold))
    rng = np.random.default_rng(seed)
    draws = marginals[0](noise_draws(problem, rng, n_draws))
    b_draws = marginals[0](dictionary).T @ draws
    results, p_values = [], {}
    for name in names:
        mine = [e for e in entries if e.name == name]
        solutions = [_solve(ridges[0], e) for e in mine]
        gains = np.array([s.gain for s in solutions])
        best = int(np.argmax([s.evidence for s in solutions]))
        null = np.max([_gains(ridges[0].G, b_draws, e) for e in mine], axis=0)
        p_values[name] = tail_probability(float(gains.max()), null)
        per_set = _cross_validated(ridges, mine)
        views = Views.of(per_set, n_time, doubt(solutions[best].theta, mine[best].stated))
        shape, gain, p = mine[best].shape, float(gains[best]), p_values[name]
        own = by_time(per_set, n_time)
        results.append(Score(name, shape, gain, p, solutions[best], gains, own, views))
    results.sort(key=lambda s: s.score)
    family = 1.0 - (1.0 - min(p_values.values())) ** len(names)
    return Screening(tuple(results), float(family), n_draws)


def _solve(ridge: Ridge, entry: Entry) -> Solution:
    return ridge.part(entry.columns).solve(entry.sigma, entry.lower, entry.upper)


def training_sets(problem: Problem) -> list[np.ndarray]:
    """Rows to keep when each block of time is left out, then when each of `MARKER_FOLDS` interleaved groups of
    markers is.

    Blocks of time alone do not test what is constant: the markers' places would learn it from the other blocks.
    """
    rows = problem.rows
    sets = [rows.fold != f for f in np.unique(rows.fold)]
    return sets + [(rows.marker < 0) | (rows.marker % MARKER_FOLDS != g) for g in range(MARKER_FOLDS)]


def by_time(per_set: Array, n_time: int) -> Array:
    """The scores of the blocks of time; nothing where groups of markers say more: what is constant, as a wrong scale,
    says little in a block, since the markers' places have learned it from the others."""
    time, markers = per_set[:n_time], per_set[n_time:]
    return time if time.sum() <= markers.sum() else np.zeros(n_time)


def in_one_block(block_scores: Array) -> bool:
    """Whether the blocks besides the best one speak against it: what is odd about one press is no effect."""
    return bool(block_scores.sum() - block_scores.min() > 0.0)


def _cross_validated(ridges: Sequence[Ridge], entries: Sequence[Entry]) -> Array:
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
    """Residuals (rows, n) that hold nothing but C and the nuisance."""
    whitener = problem.covariance.whitener()
    noise = whitener.color(rng.standard_normal((problem.rows.n, n)), problem.rows.n)
    return noise + problem.nuisance.columns @ rng.standard_normal((problem.nuisance.columns.shape[1], n))


def _gains(G: Array, b_draws: Array, entry: Entry) -> Array:
    """Gains (n_draws,) of one entry on draws."""
    i = np.array(entry.columns)
    A = G[np.ix_(i, i)] + np.diag(1.0 / entry.sigma**2)
    b = b_draws[i]
    theta = np.linalg.solve(A, b)
    theta = np.clip(theta, entry.lower[:, None], entry.upper[:, None])
    return np.maximum(2.0 * (b * theta).sum(axis=0) - np.einsum("pd,pq,qd->d", theta, A, theta), 0.0)


def tail_probability(value: float, null: Array) -> float:
    """P(null >= value): empirical where ten draws lie beyond, else with the exponential tail exp(-x/2) of
    chi-square."""
    n = len(null)
    beyond = int((null >= value).sum())
    if beyond >= 10:
        return (beyond + 1) / (n + 1)
    level = float(np.sort(null)[max(n - 10, 0)])
    if value <= level:
        return min((beyond + 1) / (n + 1), 1.0)
    return float(10.0 / n * np.exp(-0.5 * (value - level)))


# --- what cannot be told apart
# -----------------------------------------------------------------------------------------


def leader(views: Mapping[str, Views]) -> str:
    """Who predicts best in both views together."""
    return min(views, key=lambda name: views[name].together)


def indistinguishable(views: Mapping[str, Views], gain: float) -> dict[str, tuple[str, ...]]:
    """For each candidate, those that the data cannot tell from it, nearest first.

    Two belong together where one is behind the other by less than ``MIN_GAP`` (odds of 90), or by less than
    ``GAP_SHARE`` of the best one's ``gain``: a model that is right within a few per cent cannot decide by less than
    that.
    """
    limit = max(MIN_GAP, GAP_SHARE * gain)
    return {
        a: tuple(
            sorted(
                (b for b in views if b != a and abs(views[a].behind(views[b])) < limit),
                key=lambda b: abs(views[a].behind(views[b])),
            )
        )
        for a in views
    }
