"""Numbers of the error, with their uncertainty, and the verdict.

Markers of one frame move together and frames follow each other slowly, so n markers in m frames are far fewer than n m
independent errors. Intervals therefore come from a circular block bootstrap over frames (Politis & Romano 1992): whole
frames are drawn, in blocks longer than the errors' correlation time, found by Sokal's windowed integrated
autocorrelation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from livedeform.common.types import Array
from livedeform.compare_node.at_rest import AtRest
from livedeform.compare_node.coverage import Coverage
from livedeform.compare_node.residual import Residual, ResidualTable, tabulate
from livedeform.compare_node.takes import Takes

if TYPE_CHECKING:
    from livedeform.compare_node.surface_error import SurfaceError

__all__ = [
    "ErrorSummary",
    "FrameMetrics",
    "Level",
    "MarkerMetrics",
    "RunMetrics",
    "RunningTotal",
    "Statistic",
    "block_bootstrap",
    "correlation_frames",
    "difference_of_rms",
    "frame_metrics",
    "marker_metrics",
    "noise_floor",
    "p95",
    "rmse",
    "run_metrics",
    "summarise",
    "verdict",
]

N_RESAMPLES = 400
RARE = 0.05  # share of the errors: what the 95th percentile leaves out
SEED = 20210531  # of the bootstrap: two runs must give the same interval


class Level(StrEnum):
    """The verdict of a frame or a run against the experiment's threshold."""

    OK = "OK"
    WARN = "WARN"
    ERROR = "ERROR"
    STALE = "STALE"


@dataclass(frozen=True)
class Statistic:
    """A value (m) with its 95 % interval (m); NaN bounds where there is too little to say."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class FrameMetrics:
    """The errors of one frame: all in m.

    ``sigma_rmse`` is the standard deviation that the measurement's covariances give the rmse, ``noise_floor`` the rmse
    that the measuring noise alone would show; NaN without covariances.
    """

    stamp_ns: int
    n: int
    rmse: float
    mean: float
    p95: float
    max: float
    sigma_rmse: float
    noise_floor: float
    level: Level


@dataclass(frozen=True)
class MarkerMetrics:
    """One marker over all frames (m): ``bias`` (3,) is its mean error vector, ``scatter`` the rms around it."""

    id: int
    n: int
    rmse: float
    max: float
    bias: tuple[float, float, float]
    scatter: float


@dataclass(frozen=True)
class RunMetrics:
    """The errors of a whole recording, each marker in each frame counting once.

    ``n`` errors in ``n_frames`` frames, of which ``n_effective`` are worth independent ones; ``worst_stamp_ns`` is the
    frame with the largest rmse. ``level`` compares the errors with the threshold alone until `judgement.judge` takes
    ``coverage``, ``doubts`` and what is ``wrong`` with the inputs (one line each) into account. ``mesh`` says in lines
    what body was predicted with, and what was repaired of its surface; ``rest``: the error at rest, at the
    recording's ends; ``takes``: what this and other takes let expect of the next, where others were given;
    ``surface``: distances of points without ids, where they were measured; ``places``: the rmse (m) that the stated
    uncertainty of the markers' places alone would leave, which the intervals have in them; 0 where none is stated.
    ``interpolation_judged`` (m) is by how much interpolation can have changed what is judged, ``interpolation_bound``
    by how much in any frame (`interpolation.Interpolated`); NaN where it is not known.
    """

    n: int
    n_frames: int
    n_effective: float
    rmse: Statistic
    mean: Statistic
    p95: Statistic
    max: float
    noise_floor: float
    interpolation_bound: float
    threshold: float
    level: Level
    worst_stamp_ns: int | None
    markers: tuple[MarkerMetrics, ...]
    coverage: Coverage | None = None
    doubts: tuple[str, ...] = ()
    wrong: tuple[str, ...] = ()
    mesh: tuple[str, ...] = ()
    rest: tuple[AtRest, ...] = ()
    takes: Takes | None = None
    surface: SurfaceError | None = None
    places: float = 0.0
    interpolation_judged: float = float("nan")

    @property
    def relative(self) -> float:
        """The rmse over the rms of the measured motion; NaN where that is not known, or none."""
        moved = self.coverage.motion_rms if self.coverage is not None else float("nan")
        return self.rmse.value / moved if moved > 0.0 else float("nan")


@dataclass(frozen=True)
class ErrorSummary:
    """``n`` Euclidean errors: ``rmse``, ``mean``, ``p95`` and ``max`` m; NaN of none."""

    rmse: float
    mean: float
    p95: float
    max: float
    n: int

    def as_dict(self) -> dict[str, float | int]:
        """Return what a JSON file holds."""
        return {"rmse": self.rmse, "mean": self.mean, "p95": self.p95, "max": self.max, "n": self.n}


def summarise(distances: Array, weights: Array) -> ErrorSummary:
    """Summarise error lengths (n,) m, each with a weight (n,), as the time that it stands for."""
    if not len(distances):
        nan = float("nan")
        return ErrorSummary(nan, nan, nan, nan, 0)
    share = weights / weights.sum()
    high = float(distances.max())
    return ErrorSummary(rmse(distances, share), _mean(distances, share), p95(distances, share), high, len(distances))


def rmse(distances: Array, share: Array | None = None) -> float:
    """Compute sqrt(mean d^2) of error lengths (n,) m, each counting once or by its ``share`` (n,) of all; NaN of
    none."""
    if share is not None:
        return float(np.sqrt(share @ distances**2))
    return float(np.sqrt(np.mean(np.square(distances)))) if len(distances) else float("nan")


def p95(distances: Array, share: Array | None = None) -> float:
    """Compute the 95th percentile of error lengths (n,) m; with a ``share`` (n,) of all for each, an error stands in
    the middle of its own (Hazen 1914)."""
    if share is None:
        return float(np.percentile(distances, 95))
    order = np.argsort(distances)
    return float(np.interp(0.95, np.cumsum(share[order]) - 0.5 * share[order], distances[order]))


def noise_floor(variances: Array, weights: Array | None = None) -> float:
    """Compute the rmse (m) that noise alone would show, of variances (n,) m2, the traces of covariances; NaN of
    none."""
    if not len(variances):
        return float("nan")
    if weights is None:
        return float(np.sqrt(variances.mean()))
    return float(np.sqrt((variances * weights).sum() / weights.sum()))


def verdict(rmse_m: float, p95_m: float, threshold: float) -> Level:
    """Judge: ERROR where the rmse is over the threshold, WARN where one error in twenty is, STALE with nothing to
    judge."""
    if not np.isfinite(rmse_m):
        return Level.STALE
    if rmse_m > threshold:
        return Level.ERROR
    return Level.WARN if p95_m > threshold else Level.OK


class RunningTotal:
    """The errors of all frames so far, without keeping them: ``n``, ``rmse`` and ``max`` (m), the verdict, and the
    ``most`` markers that a frame had."""

    def __init__(self, threshold: float) -> None:
        self.n, self.most, self.max = 0, 0, float("nan")
        self._threshold, self._n_over, self._sum, self._squares = threshold, 0, 0.0, 0.0

    def add(self, distances: Array) -> None:
        """Add the errors (n,) m of one frame."""
        self.n, self.most = self.n + len(distances), max(self.most, len(distances))
        self._n_over += int((distances > self._threshold).sum())
        self._sum, self._squares = self._sum + float(distances.sum()), self._squares + float(distances @ distances)
        self.max = float(np.fmax(self.max, distances.max(initial=0.0)))

    @property
    def rmse(self) -> float:
        return float(np.sqrt(self._squares / self.n)) if self.n else float("nan")

    @property
    def level(self) -> Level:
        """Judge as `verdict` does, the 95th percentile by how many errors are over the threshold."""
        over = self._n_over > RARE * self.n
        return verdict(self.rmse, np.inf if over else 0.0, self._threshold)

    def as_dict(self) -> dict[str, float | int]:
        """Return what a status says."""
        mean = self._sum / self.n if self.n else float("nan")
        return {"n": self.n, "rmse": self.rmse, "mean": mean, "max": self.max, "threshold": self._threshold}


def frame_metrics(residual: Residual, threshold: float) -> FrameMetrics:
    """Compute the numbers of one frame.

    First-order propagation of the measurement's covariances C_i through rmse = sqrt(sum |e_i|^2 / n):
    var(rmse) = sum_i e_i' C_i e_i / (n rmse)^2; noise_floor = sqrt(sum_i tr C_i / n).
    """
    d, e, C = residual.distances, residual.errors, residual.covariances
    n = len(d)
    if n == 0:
        nan = float("nan")
        return FrameMetrics(residual.stamp_ns, 0, nan, nan, nan, nan, nan, nan, Level.STALE)
    value = rmse(d)
    quadratic = float(np.einsum("ni,nij,nj->", e, C, e))
    high = p95(d)
    return FrameMetrics(
        stamp_ns=residual.stamp_ns,
        n=n,
        rmse=value,
        mean=float(d.mean()),
        p95=high,
        max=float(d.max()),
        sigma_rmse=float(np.sqrt(max(quadratic, 0.0))) / (n * value) if value > 0 else 0.0 * quadratic,
        noise_floor=noise_floor(np.trace(C, axis1=1, axis2=2)),
        level=verdict(value, high, threshold),
    )


def run_metrics(residuals: Sequence[Residual], threshold: float) -> RunMetrics:
    """Compute the numbers of a whole recording, with 95 % intervals."""
    kept = [r for r in residuals if len(r.ids)]
    table = tabulate(kept)
    d = table.distances
    if len(d) == 0:
        nan = float("nan")
        none = Statistic(nan, nan, nan)
        return RunMetrics(0, 0, 0.0, none, none, none, nan, nan, nan, threshold, Level.STALE, None, ())
    pool = PooledErrors(d, np.array([len(r.ids) for r in kept]))
    tau = correlation_frames(pool.mean_squares)
    value_rmse, value_mean, value_p95 = pool.intervals(block=max(1, round(2 * tau)))
    bounds = [r.interpolation_bound for r in kept if np.isfinite(r.interpolation_bound)]
    return RunMetrics(
        n=len(d),
        n_frames=len(kept),
        n_effective=len(kept) / tau,
        rmse=value_rmse,
        mean=value_mean,
        p95=value_p95,
        max=float(d.max()),
        noise_floor=float(np.sqrt(np.nanmean(table.variances))) if np.isfinite(table.variances).any() else float("nan"),
        interpolation_bound=max(bounds) if bounds else float("nan"),
        threshold=threshold,
        level=verdict(value_rmse.value, value_p95.value, threshold),
        worst_stamp_ns=kept[int(pool.mean_squares.argmax())].stamp_ns,
        markers=marker_metrics(table),
    )


def marker_metrics(table: ResidualTable) -> tuple[MarkerMetrics, ...]:
    """Return one row per marker id, ascending."""
    order = np.argsort(table.ids, kind="stable")
    markers, first = np.unique(table.ids[order], return_index=True)
    rows = []
    for marker, e in zip(markers, np.split(table.errors[order], first[1:]), strict=True):
        d = np.linalg.norm(e, axis=1)
        bias = e.mean(axis=0)
        scatter = float(np.sqrt(np.mean(np.sum((e - bias) ** 2, axis=1))))
        rows.append(MarkerMetrics(int(marker), len(d), rmse(d), float(d.max()), tuple(bias.tolist()), scatter))
    return tuple(rows)


def correlation_frames(series: Array) -> float:
    """Return the integrated autocorrelation time of a series (m,), in frames, >= 1 (Sokal's window: the first M >= 5
    tau(M))."""
    m = len(series)
    x = series - series.mean()
    if m < 4 or not np.any(x):
        return 1.0
    spectrum = np.fft.rfft(x, 2 * m)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[:m]
    tau = 2 * np.cumsum(correlation / correlation[0]) - 1
    window = np.nonzero(np.arange(m) >= 5 * tau)[0]
    return float(np.clip(tau[window[0]] if len(window) else tau[-1], 1.0, m))


def block_bootstrap(
    by_frame: Sequence[Array],
    statistics: Sequence[Callable[[Array], float]],
    block: int,
    n_resamples: int = N_RESAMPLES,
) -> list[Statistic]:
    """Compute 95 % percentile intervals of statistics of the pooled errors, blocks of ``block`` frames drawn with
    replacement.

    ``by_frame`` holds one (n_i,) array of error lengths per frame. With fewer than two blocks there is no interval.
    """
    values = [s(np.concatenate(by_frame)) for s in statistics]
    samples = [
        [s(pooled) for s in statistics]
        for frames in drawn_frames(len(by_frame), block, n_resamples)
        for pooled in [np.concatenate([by_frame[f] for f in frames])]
    ]
    return _percentile_intervals(values, samples)


def difference_of_rms(squares: Array, counts: np.ndarray, block: int) -> Statistic:
    """Return the rms of the second errors less that of the first, of frames with sums of squares (m, 2) m2 over
    ``counts`` (m,) pairs of errors, with the interval of `block_bootstrap`: by how often a resample has each frame."""

    def of(times: np.ndarray) -> float:
        first, second = np.sqrt(times @ squares / (times @ counts))
        return float(second - first)

    m = len(counts)
    samples = [(of(np.bincount(frames, minlength=m)),) for frames in drawn_frames(m, block)]
    return _percentile_intervals([of(np.ones(m))], samples)[0]


def drawn_frames(m: int, block: int, n_resamples: int = N_RESAMPLES) -> Iterator[np.ndarray]:
    """Yield the rows (m,) of frames that each resample has, in blocks of ``block``; nothing of fewer than two."""
    if m < 2 * block:
        return
    rng = np.random.default_rng(SEED)
    for _ in range(n_resamples):
        starts = rng.integers(0, m, -(-m // block))
        yield ((starts[:, None] + np.arange(block)) % m).ravel()[:m]


def _percentile_intervals(values: Sequence[float], samples: Sequence[Sequence[float]]) -> list[Statistic]:
    """Return the values with the 95 % intervals of their resamples; NaN bounds where there are none."""
    if not len(samples):
        return [Statistic(v, float("nan"), float("nan")) for v in values]
    low, high = np.percentile(np.array(samples), [2.5, 97.5], axis=0)
    return [Statistic(v, float(a), float(b)) for v, a, b in zip(values, low, high, strict=True)]


class PooledErrors:
    """Error lengths (n,) m of frames with ``counts`` (m,) each, all > 0, one frame behind the other.

    Its bootstrap is `block_bootstrap`'s of rmse, mean and 95th percentile. It does not put resamples together: it
    counts how often each frame is in one, and looks at the largest errors only.
    """

    def __init__(self, distances: Array, counts: np.ndarray) -> None:
        self._distances, self._counts = distances, counts
        starts = np.cumsum(counts) - counts
        self._sums = np.add.reduceat(distances, starts)
        self._squares = np.add.reduceat(distances**2, starts)
        self.mean_squares: Array = self._squares / counts
        self._frames = np.repeat(np.arange(len(counts)), counts)
        self._order = np.argsort(-distances, kind="stable")  # the largest first

    def intervals(self, block: int) -> list[Statistic]:
        """Return rmse, mean and 95th percentile with their 95 % intervals, frames drawn in blocks."""
        samples = []
        for frames in drawn_frames(len(self._counts), block):
            times = np.bincount(frames, minlength=len(self._counts))
            n = int(times @ self._counts)
            square, mean = float(times @ self._squares) / n, float(times @ self._sums) / n
            samples.append((np.sqrt(square), mean, self._p95(times, n)))
        d = self._distances
        return _percentile_intervals([rmse(d), float(d.mean()), p95(d)], samples)

    def _p95(self, times: np.ndarray, n: int) -> float:
        """Return numpy's 95th percentile of the ``n`` errors of a resample that has each frame ``times`` (m,)."""
        place = 0.95 * (n - 1)
        low = int(place)
        wanted = np.array([n - 1 - low, max(n - 2 - low, 0)])  # ranks of both neighbours, from the largest
        window = n // 16 + 1
        while True:
            rows = self._order[:window]
            reached = np.cumsum(times[self._frames[rows]])
            if reached[-1] > wanted[0] or len(rows) == len(self._order):
                break
            window *= 2
        a, b = self._distances[rows[np.searchsorted(reached, wanted, side="right")]]
        share = place - low
        return float(b - (b - a) * (1.0 - share) if share >= 0.5 else a + (b - a) * share)


def _mean(d: Array, share: Array | None = None) -> float:
    return float(d.mean()) if share is None else float(share @ d)
