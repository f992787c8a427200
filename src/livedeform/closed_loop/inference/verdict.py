"""Before and after on recordings that were not fitted: errors on one scale, the noise floor, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.common import frames
from livedeform.common.types import Array

Verdict = Literal["none", "effect", "unexplained"]
# share of what a black box could explain on held-out data that the effects must take away to be called the cause
MIN_EXPLAINED = 0.7
AGAINST = 2.0  # chi2 on held-out data that effects may add: odds of e against them
OMNIBUS_P = 0.002
# twice the log likelihood, gained where it was fitted: elements have been seen to gain 40 where nothing was missing
MUCH = 60.0
MIN_EXCESS = 0.1  # of the noise of a single frame, that what is left and smooth must have to be worth a word


@dataclass(frozen=True)
class Metrics:
    """Euclidean errors of single frames' markers, m, each weighted with the time that it stands for; ``n`` of them."""

    rmse: float
    mean: float
    p95: float
    max: float
    n: int

    def as_dict(self) -> dict[str, float | int]:
        return {"rmse": self.rmse, "mean": self.mean, "p95": self.p95, "max": self.max, "n": self.n}


@dataclass(frozen=True)
class Errors:
    """Errors (k, m) m of single frames (NaN where not seen) with weights (k, m), and blocks (k,) for resampling."""

    size: Array
    weight: Array
    blocks: np.ndarray

    def metrics(self) -> Metrics:
        seen = np.isfinite(self.size)
        e, w = self.size[seen], self.weight[seen]
        if not len(e):
            return Metrics(float("nan"), float("nan"), float("nan"), float("nan"), 0)
        w = w / w.sum()
        order = np.argsort(e)
        p95 = float(np.interp(0.95, np.cumsum(w[order]) - 0.5 * w[order], e[order]))
        return Metrics(float(np.sqrt(w @ e**2)), float(w @ e), p95, float(e.max()), len(e))


def errors_of(observations: Sequence[Observation], runs: Sequence[Run], *, registered: bool = False) -> Errors:
    """Measured single frames minus predictions. Where the cameras were ``registered`` to the declared model at rest,
    they are registered to the predicted rest first, as a run of that model does."""
    size, weight, blocks, at = [], [], [], 0
    for o, run in zip(observations, runs, strict=True):
        single = _to_rest_of(o, run) if registered else o.single
        size.append(np.linalg.norm(single - run.points, axis=2))
        weight.append(np.repeat(o.weights[:, None], len(o.ids), axis=1))
        blocks.append(o.blocks + at)
        at += int(o.blocks.max()) + 1
    return Errors(np.concatenate(size), np.concatenate(weight), np.concatenate(blocks))


def _to_rest_of(o: Observation, run: Run) -> Array:
    """The single frames (k, m, 3) m, moved as the markers before the first press are to where the run has them."""
    moving = np.flatnonzero(o.phases != "rest")
    n_rest = max(1, int(moving[0]) if len(moving) else len(o.phases))
    measured, predicted = o.points[:n_rest], run.points[:n_rest]
    both = np.isfinite(measured).all(axis=2) & np.isfinite(predicted).all(axis=2)
    if both.sum() < 3:
        return o.single
    T = frames.fit_rigid(measured[both], predicted[both])
    return frames.apply(T, o.single.reshape(-1, 3)).reshape(o.single.shape)


def noise_floor(observations: Sequence[Observation]) -> float:
    """The rmse (Euclidean, m) that the measuring noise alone leaves on single frames."""
    total, weight = 0.0, 0.0
    for o in observations:
        seen = np.isfinite(o.single).all(axis=2)
        variance = np.trace(o.single_covariances, axis1=2, axis2=3)
        w = np.repeat(o.weights[:, None], len(o.ids), axis=1)
        total += float((variance * w)[seen].sum())
        weight += float(w[seen].sum())
    return float(np.sqrt(total / weight)) if weight else float("nan")


def improvement_interval(before: Errors, after: Errors, *, draws: int = 1000, seed: int = 0) -> tuple[float, float]:
    """95 % interval of 1 - rmse after / rmse before, resampling blocks (of time) and markers together (frames of one
    press are not independent, nor are those of one marker)."""
    rng = np.random.default_rng(seed)
    blocks = np.unique(before.blocks)
    m = before.size.shape[1]
    seen = np.isfinite(before.size) & np.isfinite(after.size)
    sums = []
    for x in (before.size, after.size):
        s = np.where(seen, x**2, 0.0) * before.weight
        sums.append(np.array([s[before.blocks == b].sum(axis=0) for b in blocks]))
    out = []
    for _ in range(draws):
        w = np.outer(
            rng.multinomial(len(blocks), np.full(len(blocks), 1.0 / len(blocks))),
            rng.multinomial(m, np.full(m, 1.0 / m)),
        )
        b, a = float((w * sums[0]).sum()), float((w * sums[1]).sum())
        if b > 0.0:
            out.append(1.0 - np.sqrt(a / b))
    if not out:
        return float("nan"), float("nan")
    return float(np.quantile(out, 0.025)), float(np.quantile(out, 0.975))


def explained_share(gain_before: float, gain_after: float, taken: float = 0.0) -> float:
    """Share of what a flexible black box could take away (twice its log evidence on held-out data) that the effects
    leave it no more; NaN where it could take away nothing to begin with.

    A black box that is smooth in time cannot follow what rings: where the effects have ``taken`` away more chi2 than
    it could have, what there was to take is that and what it finds now.
    """
    there = max(gain_before, max(taken, 0.0) + max(gain_after, 0.0))
    return 1.0 - max(gain_after, 0.0) / there if there > 0.0 else float("nan")
