"""Count in a run's error how uncertain the markers' stated places are: it is alike in all frames, so that no number of
frames makes it smaller.

A marker that is declared b_i beside where it is errs by b_i in every frame. With b_i ~ N(0, s_i^2 I), s_i as stated in
``markers.csv``, places alone leave an rmse of sqrt(3 mean s_i^2), and the spread that drawn b_i give to the numbers
is uncertainty of them beside that of the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livedeform.common.experiment.schema import Markers
from livedeform.compare_node.metrics import SEED, RunMetrics, Statistic, p95, rmse
from livedeform.compare_node.residual import Residual, tabulate

DRAWS = 200
MOST_FRAMES = 200  # that the spread is told from, evenly over the recording
TWO_SIDED = 1.96  # sigmas of 95 %


def with_places(metrics: RunMetrics, residuals: Sequence[Residual], markers: Markers) -> RunMetrics:
    """Widen a run's intervals by the stated sigmas of the places of its markers; unchanged where none is stated."""
    stated = dict(zip(markers.ids.tolist(), np.nan_to_num(markers.sigmas).tolist(), strict=True))
    seen = [r for r in residuals if len(r.ids)]
    if not seen or not any(stated.values()):
        return metrics
    table = tabulate(seen[:: -(-len(seen) // MOST_FRAMES)])
    ids, row = np.unique(table.ids, return_inverse=True)
    sigma = np.array([stated.get(int(i), 0.0) for i in ids])
    rng, numbers = np.random.default_rng(SEED), []
    for _ in range(DRAWS):
        beside = sigma[:, None] * rng.standard_normal((len(ids), 3))
        d = np.linalg.norm(table.errors + beside[row], axis=1)
        numbers.append((rmse(d), float(d.mean()), p95(d)))
    spread = np.std(numbers, axis=0)
    return replace(
        metrics,
        places=float(np.sqrt(3.0 * np.mean(sigma[row] ** 2))),
        rmse=_wider(metrics.rmse, float(spread[0])),
        mean=_wider(metrics.mean, float(spread[1])),
        p95=_wider(metrics.p95, float(spread[2])),
    )


def _wider(statistic: Statistic, sigma: float) -> Statistic:
    """Return a number whose interval has one more uncertainty, independent of the first; none stays none."""
    value, more = statistic.value, TWO_SIDED * sigma
    low = value - float(np.hypot(value - statistic.low, more))
    return Statistic(value, max(low, 0.0), value + float(np.hypot(statistic.high - value, more)))
