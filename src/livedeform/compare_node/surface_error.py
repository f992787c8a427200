"""Summarise how far measured points of a surface, of which nobody knows which is which, lie from the predicted one.

The distance is along the predicted surface's normal, positive where the measured surface lies outside. It is a lower
bound on the error of material points: a body that slid along its own surface shows none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from livedeform.common.types import Array
from livedeform.compare_node.metrics import PooledErrors, Statistic, block_bootstrap, correlation_frames, p95, rmse

NEIGHBOURS = 6  # of a point, whose mean distance is taken from its own: what is left is noise
BLIND = "distance of measured points from the predicted surface, along its normal; sliding along it is not seen"
SURFACE_CSV = "surface.csv"  # of a run: a row per moment
FRAMES = ("stamp_ns", "n", "bias", "rmse", "p95", "max", "coverage")


@dataclass(frozen=True)
class FrameDistances:
    """One moment: signed ``distances`` (n,) m of ``points`` (n, 3) m, measured - predicted along the outward normal;
    ``sigmas`` (n,) m of the points along it, NaN where nobody states them; ``coverage``: the share of the predicted
    surface that has a measured point nearby."""

    stamp_ns: int
    points: Array
    distances: Array
    sigmas: Array
    coverage: float

    @property
    def row(self) -> tuple[float, ...]:
        """Return the moment's numbers, in the order of ``FRAMES``."""
        size = np.abs(self.distances)
        return (
            self.stamp_ns, len(size), float(self.distances.mean()), rmse(size),
            p95(size), float(size.max()), self.coverage,
        )  # fmt: skip


@dataclass(frozen=True)
class SurfaceError:
    """Distances of ``n`` points in ``n_frames`` of ``n_measured`` moments (m): root mean square, mean and 95th
    percentile of their sizes and the signed mean (``bias``), with 95 % intervals over this recording's moments;
    ``noise`` m: what the points' noise alone would leave, ``noise_from`` "stated" or "neighbours"; ``coverage``: share
    of the predicted surface with points, at the median moment; ``refused`` moments by reason; ``registration``: by how
    much (m, one sigma, rms over the points) the pose that they were given may move them, alike in all moments; NaN
    where they came in the phantom's frame."""

    n: int
    n_frames: int
    n_measured: int
    rmse: Statistic
    mean: Statistic
    p95: Statistic
    bias: Statistic
    max: float
    noise: float
    noise_from: str
    coverage: float
    refused: Mapping[str, int] = field(default_factory=dict)
    registration: float = float("nan")

    @property
    def text(self) -> str:
        """Put it in a line."""
        if not self.n:
            return "no measured surface point could be compared with a predicted surface"
        return (
            f"{self.n} surface points without ids in {self.n_frames} of {self.n_measured} moments, on "
            f"{100 * self.coverage:.0f} % of the predicted surface: distance from it {_mm(self.rmse)} rms, signed mean "
            f"{_mm(self.bias, '+')} (outside is positive), noise {1e3 * self.noise:.3f} mm ({self.noise_from}); "
            f"blind to sliding along the surface{self._registered}"
        )

    @property
    def _registered(self) -> str:
        if not np.isfinite(self.registration):
            return ""
        return (
            "; laid on the body at rest, so that a rigid error at rest is not seen, and all moments may be off by "
            f"{1e3 * self.registration:.3f} mm (one sigma)"
        )

    def as_dict(self) -> dict[str, object]:
        """Return what ``metrics.json`` holds: lengths in m."""
        return {"of": BLIND, "unit": "m", "text": self.text, **asdict(self)}


def read_surface_error(document: Mapping[str, Any] | None) -> SurfaceError | None:
    """Read what `SurfaceError.as_dict` wrote to ``metrics.json``, where null is what is not known."""
    if document is None:
        return None
    known = {f.name: _known(document.get(f.name)) for f in fields(SurfaceError)}
    statistics = {key: Statistic(**known[key]) for key in ("rmse", "mean", "p95", "bias")}
    return SurfaceError(**(known | statistics))


def _known(value: Any) -> Any:
    """Return a value of a JSON file with NaN for null."""
    if isinstance(value, Mapping):
        return {key: _known(v) for key, v in value.items()}
    return float("nan") if value is None else value


def surface_error(frames: Sequence[FrameDistances], n_measured: int, refused: Mapping[str, int]) -> SurfaceError:
    """Summarise moments, each point counting once."""
    kept = [f for f in frames if len(f.distances)]
    if not kept:
        nan = float("nan")
        none = Statistic(nan, nan, nan)
        return SurfaceError(0, 0, n_measured, none, none, none, none, nan, nan, "", nan, dict(refused))
    by_frame = [f.distances for f in kept]
    size = np.abs(np.concatenate(by_frame))
    pool = PooledErrors(size, np.array([len(d) for d in by_frame]))
    signed = np.array([d.mean() for d in by_frame])
    block = max(1, round(2 * max(correlation_frames(pool.mean_squares), correlation_frames(signed))))
    of_rmse, of_mean, of_p95 = pool.intervals(block)
    (bias,) = block_bootstrap(by_frame, [lambda d: float(d.mean())], block)
    sigmas = np.concatenate([f.sigmas for f in kept])
    stated = bool(np.isfinite(sigmas).all())
    noise = float(np.sqrt(np.mean(sigmas**2))) if stated else noise_of_neighbours(kept)
    return SurfaceError(
        len(size), len(kept), n_measured, of_rmse, of_mean, of_p95, bias, float(size.max()), noise,
        "stated" if stated else "neighbours", float(np.median([f.coverage for f in kept])), dict(refused),
    )  # fmt: skip


def noise_of_neighbours(frames: Sequence[FrameDistances]) -> float:
    """Tell the points' noise (m, one sigma along the normal) by what neighbours do not share: the variance of a point's
    distance less the mean of ``NEIGHBOURS`` others is (1 + 1/k) that of the noise. Correlated noise is not seen."""
    squares, n = 0.0, 0
    for f in frames:
        if len(f.points) > NEIGHBOURS:
            _, near = KDTree(f.points).query(f.points, NEIGHBOURS + 1)
            own = f.distances - f.distances[near[:, 1:]].mean(axis=1)
            squares, n = squares + float((own**2).sum()), n + len(own)
    return float(np.sqrt(squares / n / (1.0 + 1.0 / NEIGHBOURS))) if n else float("nan")


def _mm(statistic: Statistic, sign: str = "") -> str:
    value = f"{1e3 * statistic.value:{sign}.3f} mm"
    if not np.isfinite(statistic.low):
        return value
    return f"{value} ({1e3 * statistic.low:{sign}.3f} to {1e3 * statistic.high:{sign}.3f}, this recording)"
