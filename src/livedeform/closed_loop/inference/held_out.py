"""Compare before and after on recordings that were not fitted: errors of single frames on one scale, and the noise
floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.common import frames
from livedeform.common.types import Array
from livedeform.compare_node import metrics

DRAWS = 1000  # of the bootstrap
LEVELS = (0.025, 0.975)  # of a 95 % interval


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors (k, m) m of single frames (NaN where not seen) with weights (k, m) s, the time that each stands for, and
    blocks (k,) for resampling."""

    size: Array
    weight: Array
    blocks: np.ndarray

    def metrics(self) -> metrics.ErrorSummary:
        """Summarise them, each weighted with the time that it stands for."""
        seen = np.isfinite(self.size)
        return metrics.summarise(self.size[seen], self.weight[seen])


def errors_of(observations: Sequence[Observation], runs: Sequence[Run], *, registered: bool = False) -> HeldOutErrors:
    """Take predictions from measured single frames. Where the cameras were ``registered`` to the declared model at
    rest, they are registered to the predicted rest first, as a run of that model does."""
    size, weight, blocks, at = [], [], [], 0
    for o, run in zip(observations, runs, strict=True):
        single = _to_rest_of(o, run) if registered else o.single
        size.append(np.linalg.norm(single - run.points, axis=2))
        weight.append(np.repeat(o.weights[:, None], len(o.ids), axis=1))
        blocks.append(o.blocks + at)
        at += int(o.blocks.max()) + 1
    return HeldOutErrors(np.concatenate(size), np.concatenate(weight), np.concatenate(blocks))


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
    """Find the rmse (Euclidean, m) that the measuring noise alone leaves on single frames."""
    variances, weights = [], []
    for o in observations:
        seen = np.isfinite(o.single).all(axis=2)
        variances.append(np.trace(o.single_covariances, axis1=2, axis2=3)[seen])
        weights.append(np.repeat(o.weights[:, None], len(o.ids), axis=1)[seen])
    return metrics.noise_floor(np.concatenate(variances), np.concatenate(weights))


def improvement_interval(before: HeldOutErrors, after: HeldOutErrors, *, seed: int = 0) -> tuple[float, float]:
    """Find the 95 % interval of 1 - rmse after / rmse before, resampling blocks (of time) and markers together (frames
    of one press are not independent, nor are those of one marker)."""
    rng = np.random.default_rng(seed)
    blocks = np.unique(before.blocks)
    m = before.size.shape[1]
    seen = np.isfinite(before.size) & np.isfinite(after.size)
    sums = []
    for x in (before.size, after.size):
        s = np.where(seen, x**2, 0.0) * before.weight
        sums.append(np.array([s[before.blocks == b].sum(axis=0) for b in blocks]))
    out = []
    for _ in range(DRAWS):
        w = np.outer(
            rng.multinomial(len(blocks), np.full(len(blocks), 1.0 / len(blocks))),
            rng.multinomial(m, np.full(m, 1.0 / m)),
        )
        b, a = float((w * sums[0]).sum()), float((w * sums[1]).sum())
        if b > 0.0:
            out.append(1.0 - np.sqrt(a / b))
    if not out:
        return float("nan"), float("nan")
    low, high = (float(np.quantile(out, level)) for level in LEVELS)
    return low, high
