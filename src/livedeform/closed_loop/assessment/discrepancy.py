"""Model discrepancy: what the best model leaves; how likely that is noise, where it is, when, along which direction,
and what it goes with. Whether it matters is for `verdict.judge` to say.

The black box is a ridge regression on smooth functions of the place on the body (all quadratic polynomials) times
functions of the load (constant, each press's course, each press's aftermath, time): a Gaussian process with a finite
basis. It says how much a flexible discrepancy could take away (Kennedy & O'Hagan 2001) and is never given as a cause.
Where much is uncertain anyway (a swing's shares of the motion, registration, places), it may be large and cancelled by
that: then no more is told of it than the residual itself has of such functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.closed_loop.assessment.held_out import HeldOutErrors, noise_floor
from livedeform.closed_loop.evidence.noise import Rows
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inference.screening import noise_draws, tail_probability
from livedeform.closed_loop.settings import DiscrepancySettings, Settings
from livedeform.common.types import Array

FLAT, STILL, NOTHING = 1e-6, 1e-12, 1e-30  # m of height, and least deviations that have a direction or a correlation


@dataclass(frozen=True)
class Discrepancy:
    """``p_value`` of the residual under noise alone; ``gain``: twice the log evidence for the black box; ``excess``
    m, rms of the smooth part beyond noise, ``chi2`` per datum of the markers' whitened residual; ``smooth`` (k, m,
    3) m: the black box's estimate of what is left, or the residual's own part of its functions where that is less, zero
    where nothing was ``seen`` (k, m) bool. All sizes are of what was seen. ``chi2_forces``: per datum of the
    ``n_forces`` components of forces, of which the black box knows nothing; NaN without any."""

    p_value: float
    gain: float
    excess: float
    chi2: float
    smooth: Array
    seen: np.ndarray
    chi2_forces: float = float("nan")
    n_forces: int = 0

    def rms(self, axis: int | None = None) -> Array:
        """Return the rms m of the smooth part where it was seen: of all, or over the moments (0) or markers (1)."""
        return _rms(self.smooth, self.seen, axis)

    def rms_at(self, moments: np.ndarray) -> float:
        """Return the rms m of the smooth part where it was seen at some ``moments`` (k,) bool."""
        return float(_rms(self.smooth[moments], self.seen[moments]))


def smooth_basis(
    rows: Rows,
    places: Array,
    motion: Array,
    rates: Array,
    blocks: np.ndarray,
    seconds: Array,
    settings: DiscrepancySettings,
) -> Array:
    """Form columns (n, q) of unit size: quadratic fields of the place times the courses of the load, and linear ones
    times the ``rates`` (k, m, 3) m/s of the markers, as what is late or early leaves them."""
    k, m = motion.shape
    x = (places - places.mean(axis=0)) / max(float(np.abs(places - places.mean(axis=0)).max()), 1e-9)
    x = np.nan_to_num(x)
    fields = [np.ones(m), *x.T, *(x[:, i] * x[:, j] for i in range(3) for j in range(i, 3))]
    course = motion.mean(axis=1) / max(float(motion.mean(axis=1).max()), 1e-9)
    times = [np.ones(k), (seconds - seconds.mean()) / max(float(np.ptp(seconds)), 1e-9)]
    for b in np.unique(blocks):
        here = blocks == b
        if course[here].max() > settings.pressed:
            times.append(np.where(here, course, 0.0))
            after = here & (seconds > seconds[here][np.argmax(course[here])]) & (course < settings.after)
            if after.sum() > 1:
                times.append(after.astype(float))
    shape = (k, m, 3)
    columns = []
    zero_force = np.zeros((k, 3))
    for t in times:
        for f in fields:
            for a in range(3):
                c = np.zeros(shape)
                c[..., a] = t[:, None] * f[None]
                columns.append(rows.take(c, zero_force))
    speed = rates / max(float(np.abs(rates).max(initial=0.0)), 1e-9)
    columns += [rows.take(speed * f[None, :, None], zero_force) for f in fields[:4]]
    return np.column_stack(columns)


def discrepancy(
    problem: Problem, basis: Array, shape: tuple[int, int], settings: Settings, *, seed: int = 1
) -> Discrepancy:
    """Test and estimate what is left in the problem's residual; ``shape`` (k, m)."""
    amplitudes, draws = settings.discrepancy.amplitudes, settings.discrepancy.draws
    marginal, points = problem.marginal, problem.rows.marker >= 0
    B, r = marginal(basis), marginal(problem.residual)
    lmbda, V = np.linalg.eigh(B.T @ B)
    lmbda = np.maximum(lmbda, 0.0)
    b = V.T @ (B.T @ r)
    null = V.T @ (B.T @ marginal(noise_draws(problem, np.random.default_rng(seed), draws)))
    evidence = np.array([_evidence(lmbda, b[:, None], a)[0] for a in amplitudes])
    null_best = np.max([_evidence(lmbda, null, a) for a in amplitudes], axis=0)
    a = amplitudes[int(np.argmax(evidence))]
    theta = V @ (b / (lmbda + 1.0 / a**2))
    found, there = (_field(problem.rows, x, shape) for x in (basis @ theta, _there(problem, basis)))
    seen = np.zeros(shape, bool)
    seen[problem.rows.moment[points], problem.rows.marker[points]] = True
    smooth = min(found, there, key=lambda field: float(_rms(field, seen)))
    p_value = tail_probability(float(evidence.max()), null_best, settings.screening.tail)
    excess = float(_rms(smooth, seen))
    chi2, of_forces = _mean_square(r[points]), _mean_square(r[~points])
    return Discrepancy(p_value, float(evidence.max()), excess, chi2, smooth, seen, of_forces, int(np.sum(~points)))


def _mean_square(x: Array) -> float:
    """Return the mean of the squares of ``x`` (n,); NaN of none."""
    return float(x @ x) / len(x) if len(x) else float("nan")


def _there(problem: Problem, basis: Array) -> Array:
    """Return the part (n,) m of the points' residual that the ``basis`` (n, q) spans, whatever else may explain it."""
    p = problem.rows.marker >= 0
    out = np.zeros(problem.rows.n)
    out[p] = basis[p] @ np.linalg.lstsq(basis[p], problem.residual[p], rcond=None)[0]
    return out


def _field(rows: Rows, values: Array, shape: tuple[int, int]) -> Array:
    """Put the points among rows' ``values`` (n,) where they belong (k, m, 3); zero where nothing was measured."""
    out, p = np.zeros((*shape, 3)), rows.marker >= 0
    out[rows.moment[p], rows.marker[p], rows.axis[p]] = values[p]
    return out


def _rms(field: Array, seen: np.ndarray, axis: int | None = None) -> Array:
    """Return the rms of the vectors of a ``field`` (k, m, 3) where they were ``seen`` (k, m), along an ``axis``."""
    return np.asarray(np.sqrt((field**2).sum(axis=2).sum(axis=axis) / np.maximum(seen.sum(axis=axis), 1)))


def _evidence(lmbda: Array, b: Array, a: float) -> Array:
    """Twice the log evidence ratio of the ridge with prior scale ``a`` for ``b`` (q, d)."""
    A = lmbda + 1.0 / a**2
    return np.asarray((b**2 / A[:, None]).sum(axis=0) - np.log(A * a**2).sum())


def share_of_size(
    left: Sequence[Discrepancy], errors: Sequence[HeldOutErrors], moved: Sequence[float], *, swings: bool
) -> float:
    """Return the share of its mean square that effects take off what is smooth, or, where it ``swings``, off all that
    is more than noise; before and after, NaN if there was nothing. What effects ``moved`` elsewhere (m rms) is added to
    what there was."""
    if swings:
        floor = noise_floor(*errors)
        before, after = (max(e.metrics().rmse ** 2 - floor**2, 0.0) for e in errors)
    else:
        before, after = (max(d.excess, 0.0) ** 2 for d in left)
    before += sum(size**2 for size in moved)
    return 1.0 - after / before if before > 0.0 else float("nan")


def describe(
    left: Discrepancy, observations: Sequence[Observation], places: Array, settings: DiscrepancySettings
) -> str:
    """Say where it is, when, along which direction, and what it goes with."""
    names, mm, per_marker = observations[0].ids, 1e3, left.rms(axis=0)
    worst, ever = int(np.argmax(per_marker)), left.seen.any(axis=0)
    at = ", ".join(f"{mm * c:.0f}" for c in places[worst])
    phases = np.concatenate([o.phases for o in observations])
    by_phase = {p: left.rms_at(phases == p) for p in np.unique(phases)}
    strongest = max(by_phase, key=lambda p: by_phase[p])
    direction, share = _direction(left.smooth)
    text = (
        f"Where: largest at marker {names[worst]} at ({at}) mm with {mm * per_marker[worst]:.3f} mm rms"
        f"{_height(per_marker[ever], places[ever], settings.correlated)}. When: "
        + ", ".join(f"{p} {mm * v:.3f} mm" for p, v in sorted(by_phase.items(), key=lambda kv: -kv[1]))
        + f"; most during {strongest}. Direction: {direction} ({100 * share:.0f} % of it). "
    )
    return text + _correlates(left, observations, settings)


def _direction(smooth: Array) -> tuple[str, float]:
    flat = smooth.reshape(-1, 3)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    e = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
    return "(" + ", ".join(f"{c:+.2f}" for c in e) + ")", float(values[-1] / max(values.sum(), NOTHING))


def _height(per_marker: Array, places: Array, least: float) -> str:
    z = places[:, 2]
    if len(z) < 2 or np.ptp(z) < FLAT:
        return ""
    c = float(np.corrcoef(z, per_marker)[0, 1])
    if abs(c) < least:
        return ""
    return ", growing towards the top" if c > 0 else ", growing towards the foot"


def _correlates(left: Discrepancy, observations: Sequence[Observation], settings: DiscrepancySettings) -> str:
    """Name the quantity that the residual's course follows best."""
    size = left.rms(axis=1)[left.seen.any(axis=1)]
    main = _main_course(left.smooth)
    seconds = np.concatenate([o.seconds for o in observations])
    load = np.concatenate([_load(o) for o in observations])
    speed = np.concatenate(
        [np.gradient(_load(o), o.seconds) if o.n_moments > 2 else np.zeros(o.n_moments) for o in observations]
    )
    tests = {
        "how far the body is pressed": load,
        "the speed of pressing": speed,
        "time (a drift)": seconds,
        "nothing but the rest shape (it is constant)": np.zeros_like(load),
    }
    best, value = "", 0.0
    for name, course in tests.items():
        if np.std(course) < STILL:
            continue
        c = float(np.corrcoef(course, main)[0, 1])
        if abs(c) > abs(value):
            best, value = name, c
    if np.std(size) < settings.steady * np.mean(size):
        return "It is there all the time, also at rest."
    return (
        f"It goes with {best} (correlation {value:+.2f})."
        if abs(value) > settings.correlated
        else "It follows neither load, speed nor time alone."
    )


def _main_course(smooth: Array) -> Array:
    """The course in time (k,) of the strongest pattern."""
    flat = smooth.reshape(len(smooth), -1)
    u, s, _ = np.linalg.svd(flat, full_matrices=False)
    return np.asarray(u[:, 0] * s[0])


def _load(o: Observation) -> Array:
    points = o.points[:, np.isfinite(o.points[:3]).all(axis=2).any(axis=0)]
    d = np.linalg.norm(points - np.nanmedian(points[:3], axis=0), axis=2)
    return np.asarray(np.nan_to_num(np.nanmean(d, axis=1)))
