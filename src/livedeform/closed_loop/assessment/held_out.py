"""Compare before and after on recordings that were not fitted: errors of single frames on one scale, and the noise
floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.common import frames
from livedeform.common.checks.presses import shows_the_body
from livedeform.common.types import Array
from livedeform.compare_node import metrics
from livedeform.compare_node.coverage import Coverage
from livedeform.compare_node.takes import HIGH, Expected, expected

LEAST_SIGMA = 1e-9  # m
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class RecordingErrors:
    """Single frames of one recording at its key moments, against the predictions of a model.

    ``stamps_ns`` (k,) and ``ids`` (m,); ``measured`` (k, m, 3) m, moved to the predicted rest where the cameras were
    registered to it, and ``predicted`` (k, m, 3) m: NaN where not seen and where the model found no equilibrium;
    ``covariances`` (k, m, 3, 3) m2 of what was measured; ``weights`` (k,) s, the time that each moment stands for;
    ``blocks`` (k,) of time; ``presses`` (k,) the number of the press that is going on, from 1; 0 in none.
    """

    name: str
    start_ns: int
    stamps_ns: np.ndarray
    ids: np.ndarray
    measured: Array
    predicted: Array
    covariances: Array
    weights: Array
    blocks: np.ndarray
    presses: np.ndarray

    @property
    def size(self) -> Array:
        """Length of each error (k, m) m, NaN where there is none."""
        return np.asarray(np.linalg.norm(self.measured - self.predicted, axis=2))

    @property
    def in_noise(self) -> Array:
        """Mean square (k, m) of each error's three components, each in units of its own noise; NaN where there is
        none."""
        error = self.measured - self.predicted
        seen = np.isfinite(error).all(axis=2)
        out = np.full(seen.shape, np.nan)
        certain = LEAST_SIGMA**2 * np.eye(3)  # a tracker may say that it knows a direction exactly
        weighed = np.linalg.solve(self.covariances[seen] + certain, error[seen][..., None])[..., 0]
        out[seen] = np.sum(error[seen] * weighed, axis=1) / 3.0
        return out


@dataclass(frozen=True)
class HeldOutErrors:
    """The errors of a model on what was held out: every figure, table and number about them is made of this record."""

    recordings: tuple[RecordingErrors, ...]

    @property
    def size(self) -> Array:
        """Length of each error (k, m) m over all moments, NaN where there is none."""
        return np.concatenate([r.size for r in self.recordings])

    @property
    def in_noise(self) -> Array:
        """Mean square of each error's components in units of their noise (k, m) over all moments, NaN where none."""
        return np.concatenate([r.in_noise for r in self.recordings])

    @property
    def weight(self) -> Array:
        """Time (k, m) s that each error stands for."""
        return np.concatenate([np.repeat(r.weights[:, None], len(r.ids), axis=1) for r in self.recordings])

    @property
    def blocks(self) -> np.ndarray:
        """Number of the block (k,), counted through all recordings."""
        starts = np.cumsum([0, *(int(r.blocks.max()) + 1 for r in self.recordings)])
        return np.concatenate([r.blocks + at for r, at in zip(self.recordings, starts, strict=False)])

    @property
    def loads(self) -> np.ndarray:
        """Number (k,) what presses or lets go of the body, through all recordings; a rest counts to the press before
        it, or to the first one, and a recording without any is one."""
        numbers, out = dict[tuple[str, int], int](), []
        for r in self.recordings:
            for press in np.maximum(np.maximum.accumulate(r.presses), 1):
                out.append(numbers.setdefault((r.name, int(press)), len(numbers)))
        return np.array(out)

    def metrics(self) -> metrics.ErrorSummary:
        """Summarise them, each weighted with the time that it stands for."""
        size = self.size
        seen = np.isfinite(size)
        return metrics.summarise(size[seen], self.weight[seen])

    def chi2(self) -> float:
        """Find chi2 per datum by the measuring noise alone, each weighted with the time that it stands for."""
        squares = self.in_noise
        seen = np.isfinite(squares)
        return float(np.average(squares[seen], weights=self.weight[seen])) if seen.any() else float("nan")

    def noise_floor(self) -> float:
        """Find the rmse (Euclidean, m) that the measuring noise alone would leave of the same errors."""
        seen = np.isfinite(self.size)
        variances = np.concatenate([np.trace(r.covariances, axis1=2, axis2=3) for r in self.recordings])
        return metrics.noise_floor(variances[seen], self.weight[seen])


def noise_floor(before: HeldOutErrors, after: HeldOutErrors) -> float:
    """Find the rmse (m) that the measuring noise alone would leave, by the errors themselves: noise that were larger
    than an error would show in it."""
    return min(before.noise_floor(), before.metrics().rmse, after.metrics().rmse)


def coverage_of(observations: Sequence[Observation], after: HeldOutErrors) -> Coverage:
    """Count the held-out frames that errors are taken of, one for each key moment, and the presses among them."""
    seen = [np.isfinite(r.measured).all(axis=2).sum(axis=1) for r in after.recordings]
    measured = [n > 0 for n in seen]
    compared = [
        np.isfinite(r.size).any(axis=1) & shows_the_body(n) for r, n in zip(after.recordings, seen, strict=True)
    ]
    return Coverage(
        frames_measured=int(sum(x.sum() for x in measured)),
        frames_compared=int(sum(x.sum() for x in compared)),
        presses=sum(_n_presses(o.presses) for o in observations),
        presses_compared=sum(_n_presses(o.presses[c]) for o, c in zip(observations, compared, strict=True)),
    )


def _n_presses(numbers: np.ndarray) -> int:
    return len(np.unique(numbers[numbers > 0]))


def errors_of(observations: Sequence[Observation], runs: Sequence[Run], *, registered: bool = False) -> HeldOutErrors:
    """Take predictions from measured single frames. Where the cameras were ``registered`` to the declared model at
    rest, they are registered to the predicted rest first, as a run of that model does."""
    out = []
    for o, run in zip(observations, runs, strict=True):
        T = _to_rest_of(o, run) if registered else np.eye(4)
        R = T[:3, :3]
        out.append(
            RecordingErrors(
                name=o.name,
                start_ns=o.start_ns,
                stamps_ns=o.stamps_ns,
                ids=np.asarray(o.ids),
                measured=frames.apply(T, o.single.reshape(-1, 3)).reshape(o.single.shape),
                predicted=run.points,
                covariances=R @ o.single_covariances @ R.T,
                weights=o.weights,
                blocks=o.blocks,
                presses=o.presses,
            )
        )
    return HeldOutErrors(tuple(out))


def in_common(one: Sequence[Run], two: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """Leave the moments out of both that either model finds no equilibrium for: two models are compared by the same
    data."""
    out: tuple[list[Run], list[Run]] = ([], [])
    for a, b in zip(one, two, strict=True):
        lost = np.asarray(~np.isfinite(a.points + b.points).all(axis=(1, 2)))
        for kept, run in zip(out, (a, b), strict=True):
            kept.append(replace(run, points=np.where(lost[:, None, None], np.nan, run.points)))
    return out


def _to_rest_of(o: Observation, run: Run) -> Array:
    """The transform (4, 4) that moves the markers at rest to where the run has them, weighted by their noise as the
    tracker's own registration is: by millimetres alone depth, which two cameras see several times worse, would turn
    what they see sideways. At rest is what is before the first press; in a part of a recording that begins in one,
    what is after it, and where there is none nothing is moved: what is pressed would take the model's errors upon
    itself."""
    at_rest = o.phases == "rest"
    if at_rest[0]:
        at_rest = np.logical_and.accumulate(at_rest)
    measured, predicted = o.points[at_rest], run.points[at_rest]
    both = np.isfinite(measured).all(axis=2) & np.isfinite(predicted).all(axis=2)
    if both.sum() < 3:
        return np.eye(4)
    start = frames.fit_rigid(measured[both], predicted[both])
    return frames.fit_misplaced(measured[both], o.covariances[at_rest][both], predicted[both], start)


@dataclass(frozen=True)
class NextRecording:
    """Say what is expected of the next recording that is as alike to those that were held out as these are among
    themselves: its rms error (m) with the given model, and its ``ratio`` to that of the declared one."""

    error: Expected
    ratio: Expected

    @property
    def improvement(self) -> tuple[float, float]:
        """Return the 95 % interval of 1 - after/before."""
        return 1.0 - self.ratio.next[1], 1.0 - self.ratio.next[0]


def next_recording(before: HeldOutErrors, after: HeldOutErrors) -> NextRecording | None:
    """Expect the next recording's errors from how those that were held out differ (Student's t); None of fewer than
    two."""
    rows = []
    for name in dict.fromkeys(r.name for r in before.recordings):
        sums = [HeldOutErrors(tuple(r for r in e.recordings if r.name == name)).metrics().rmse for e in (before, after)]
        if np.isfinite(sums).all():
            rows.append(sums)
    if len(rows) < 2:
        return None
    table = np.array(rows)
    after_all, ratios = table[:, 1].tolist(), (table[:, 1] / table[:, 0]).tolist()
    return NextRecording(expected([after_all])[0], expected([ratios])[0])


def improvement_interval(before: HeldOutErrors, after: HeldOutErrors) -> tuple[float, float]:
    """Find the 95 % interval of 1 - rmse after / rmse before over presses and markers like these; NaN of one press.

    Linearised in the logarithm of the ratio (ratio estimator, Cochran 1977, 6.4), clustered both ways (Cameron, Gelbach
    & Miller 2011), with Student's t of the presses: what a model gets wrong differs from press to press, and a
    bootstrap of two says that they tell it.
    """
    seen = np.isfinite(before.size) & np.isfinite(after.size)
    sums = [np.where(seen, e.size**2, 0.0) * before.weight for e in (before, after)]
    total = [float(s.sum()) for s in sums]
    if min(total) <= 0.0:
        return float("nan"), float("nan")
    parts = 0.5 * (sums[1] / total[1] - sums[0] / total[0])  # of the logarithm, by each error
    units = np.unique(before.loads, return_inverse=True)[1]
    by_press, by_marker = np.bincount(units, parts.sum(axis=1)), parts.sum(axis=0)[seen.any(axis=0)]
    if len(by_press) < 2:
        return float("nan"), float("nan")
    variances = [len(v) / max(len(v) - 1, 1) * float((v**2).sum()) for v in (by_press, by_marker)]
    freedom = [max(len(v) - 1, 1) for v in (by_press, by_marker)]
    nu = sum(variances) ** 2 / max(sum(v**2 / n for v, n in zip(variances, freedom, strict=True)), TINY)
    half = float(stdtrit(max(nu, 1.0), HIGH)) * np.sqrt(sum(variances))
    ratio = np.sqrt(total[1] / total[0])
    return float(1.0 - ratio * np.exp(half)), float(1.0 - ratio * np.exp(-half))
