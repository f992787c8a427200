"""Say within which bounds the next take's errors are expected, from takes of the same press, release or test.

The interval of one take's mean says nothing of the next take: what changes between takes (how a body was put down, held
or touched, how the tracker was registered) is one constant in each. Takes are independent of each other, so of n takes

    log x_next is within  mean(log x) +- t_(nu, 0.975) s sqrt(1 + 1/n),   nu = n - 1                 (Student 1908)

Logarithms, as an error is positive and scatters in proportion to its size. Groups of takes of several presses may share
one s (nu = sum of n_g - 1). A marker's s is pooled over markers by analysis of variance: what a take does to all
markers alike is known from n - 1 differences, what it does to each from (n - 1)(m - 1); Satterthwaite's (1946) degrees
of freedom say how much that is worth together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtrit

from livedeform.common.types import Array

HIGH = 0.975  # of a 95 % interval
NUMBERS = ("rmse", "mean", "p95")


@dataclass(frozen=True)
class Expected:
    """Geometric mean ``value`` of ``n`` takes, the 95 % interval of the mean over all takes, and that of the next take;
    NaN where takes do not say. ``freedom``: degrees of freedom of the scatter."""

    n: int
    value: float
    mean: tuple[float, float]
    next: tuple[float, float]
    freedom: float


ONE_TAKE = "the next take: one take does not say how takes differ; name runs of other takes with --repeat"


@dataclass(frozen=True)
class Takes:
    """Takes of one press, with one model: their ``names``, what is ``expected`` of rmse, mean and p95 (m) by name, and
    of each marker's rms error (m) by id."""

    names: tuple[str, ...]
    expected: Mapping[str, Expected]
    markers: Mapping[int, Expected] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Put it in a line."""
        rmse = self.expected["rmse"]
        if not np.isfinite(rmse.next).all():
            return ONE_TAKE
        low, high = (1e3 * v for v in rmse.next)
        return (
            f"the next take's rmse is expected between {low:.3f} and {high:.3f} mm (95 %, from {rmse.n} takes: "
            f"{', '.join(self.names)})"
        )

    def as_dict(self) -> dict[str, object]:
        """Return what ``metrics.json`` holds: lengths in m."""
        return {
            "text": self.text,
            "takes": list(self.names),
            "degrees_of_freedom": self.expected["rmse"].freedom,
            "interval_95": {name: list(e.next) for name, e in self.expected.items()},
            "mean_of_takes_95": {name: list(e.mean) for name, e in self.expected.items()},
            "markers_interval_95": {str(marker): list(e.next) for marker, e in self.markers.items()},
        }


def expected(groups: Sequence[Sequence[float]]) -> list[Expected]:
    """Expect the next take of each group of takes (values > 0), whose scatter on a log scale is one."""
    logs = [np.log(np.asarray(g, float)) if min(g, default=0.0) > 0.0 else np.full(len(g), np.nan) for g in groups]
    freedom = sum(len(g) - 1 for g in logs)
    square = sum(float(((g - g.mean()) ** 2).sum()) for g in logs)
    variance = square / freedom if freedom else float("nan")
    return [_expected(float(g.mean()), len(g), variance, freedom) for g in logs]


def expected_of_markers(values: Array) -> list[Expected]:
    """Expect the next take's value of each marker, of ``values`` (n takes, m markers) > 0; their scatter is pooled."""
    n, m = values.shape
    logs = np.log(values) if n > 1 and (values > 0.0).all() else np.full((n, m), np.nan)
    takes, markers = logs.mean(axis=1), logs.mean(axis=0)
    if n < 2:
        return [_expected(float(value), n, float("nan"), 0.0) for value in markers]
    common = float(((takes - takes.mean()) ** 2).sum()) / (n - 1)  # its expectation: of all markers + of each / m
    own, degrees = 0.0, 1
    if m > 1:
        degrees = (n - 1) * (m - 1)
        own = float(((logs - takes[:, None] - markers + logs.mean()) ** 2).sum()) / degrees * (m - 1) / m
    total = common + own
    worth = common**2 / (n - 1) + own**2 / degrees
    freedom = total**2 / worth if worth > 0.0 else float(n - 1)
    return [_expected(float(value), n, total, freedom) for value in markers]


def _expected(log_mean: float, n: int, variance: float, freedom: float) -> Expected:
    half = stdtrit(freedom, HIGH) * np.sqrt(variance) if freedom > 0 else float("nan")
    spans = []
    for share in (1.0 / n, 1.0 + 1.0 / n):
        low, high = np.exp(log_mean + half * np.sqrt(share) * np.array([-1.0, 1.0]))
        spans.append((float(low), float(high)))
    return Expected(n, float(np.exp(log_mean)), spans[0], spans[1], float(freedom))
