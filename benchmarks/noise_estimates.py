"""How well the measuring noise of ordinary recordings is told: estimated over true noise.

Markers on a dome are pressed by smooth dimples at changing places (no finite elements), at 5, 10 and 30 Hz, with pauses
of 0.3 to 3 s between ramps, white noise and noise that is correlated in time, with covariances stated rightly, wrongly
or not at all. Goal: 0.8 to 1.25, or the answer that it cannot be told. Numbers were
chosen by the cases of one half of the grid (even numbers); both halves were printed while the method was made, so that
the other half is no blind test. Other seeds are.

    python -m benchmarks.noise_estimates
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.signal import lfilter

from livedeform.closed_loop.evidence.measuring_noise import NoiseReport, noise_of
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array

GOAL = (0.8, 1.25)
SPREAD = np.array([0.6, 0.6, 1.5])  # a camera pair sees depth worst
RADIUS, SPEED = 0.05, 0.012  # m, m/s


@dataclass(frozen=True)
class Case:
    """One recording: ``rate`` Hz, ``pause`` s, ``tau`` s of the noise's correlation (0: white), ``stated`` sigma over
    the true one (NaN: none is stated), ``sigma`` m of a coordinate, ``markers``."""

    number: int
    rate: float
    pause: float
    tau: float
    stated: float
    sigma: float
    markers: int

    @property
    def tuned(self) -> bool:
        """Whether the case belongs to the half that numbers were chosen with."""
        return self.number % 2 == 0


def grid() -> list[Case]:
    """All cases, in an order that mixes both halves."""
    axes = product((5.0, 10.0, 30.0), (0.3, 0.8, 1.5, 3.0), (0.0, 0.15, 0.5), (1.0, 0.4, 2.5, float("nan")))
    rng = np.random.default_rng(5)
    cases = []
    for number, at in enumerate(rng.permutation(np.array(list(axes)))):
        sigma, markers = rng.choice([1e-5, 3e-5, 1e-4]), int(rng.choice([12, 30, 80]))
        cases.append(Case(number, *(float(v) for v in at), float(sigma), markers))
    return cases


def pressed(seconds: Array, pause: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Depth (f,) m and place (f, 2) m of a probe that ramps smoothly down and up, with pauses."""
    times, depths, places, t = [0.0], [0.0], [np.zeros(2)], 0.0
    while t < seconds[-1]:
        deep, place = rng.uniform(0.004, 0.012), rng.uniform(-0.02, 0.02, 2)
        for stay, to in ((pause, deep), (pause, 0.0)):
            t += stay
            times, depths, places = [*times, t], [*depths, depths[-1]], [*places, place]
            t += deep / SPEED
            times, depths, places = [*times, t], [*depths, to], [*places, place]
    share = np.interp(seconds, times, np.arange(len(times)))
    whole = np.minimum(share.astype(int), len(times) - 2)
    smooth = 0.5 - 0.5 * np.cos(np.pi * (share - whole))
    depth = np.array(depths)[whole] * (1.0 - smooth) + np.array(depths)[whole + 1] * smooth
    return depth, np.array(places)[whole + 1]


def recording(case: Case, seed: int, seconds: float = 24.0) -> tuple[Track, Array]:
    """The recording of a case, and its true covariance (3, 3) m2 of a point."""
    rng = np.random.default_rng([case.number, seed])
    t = np.arange(0.0, seconds, 1.0 / case.rate)
    u = rng.normal(size=(case.markers, 3))
    rest = RADIUS * np.abs(u / np.linalg.norm(u, axis=1)[:, None]) * [1.0, 1.0, 1.0]
    rest[:, :2] *= rng.choice([-1.0, 1.0], (case.markers, 2))
    depth, place = pressed(t, case.pause, rng)
    away = rest[None, :, :2] - place[:, None]
    reach = np.exp(-0.5 * (away**2).sum(axis=2) / 0.02**2) * rest[:, 2] / RADIUS
    crept = lfilter([0.02], [1.0, -0.98], depth)  # relaxes slowly, through the pauses too
    points = np.repeat(rest[None], len(t), axis=0)
    points[..., 2] -= (depth + 0.2 * crept)[:, None] * reach
    points[..., :2] += 0.3 * depth[:, None, None] * reach[..., None] * away / 0.02
    rho = np.exp(-1.0 / (case.rate * case.tau)) if case.tau else 0.0
    white = rng.normal(size=(len(t) + 200, case.markers, 3)) * np.sqrt(1.0 - rho**2)
    points += case.sigma * SPREAD * lfilter([1.0], [1.0, -rho], white, axis=0)[200:]
    truth = np.diag((case.sigma * SPREAD) ** 2)
    covariances = np.broadcast_to(truth * case.stated**2, (*points.shape, 3)).copy()
    return Track((t * 1e9).astype(np.int64), np.arange(case.markers), points, covariances), truth


def measure(case: Case, seed: int = 0) -> tuple[NoiseReport, float]:
    """The report of one recording, and the estimated over the true sigma of a point."""
    data, truth = recording(case, seed)
    report = noise_of(data, Settings().noise)
    return report, report.value / float(np.sqrt(np.trace(truth)))


def main() -> int:
    """Print both halves of the grid; 1 where a ratio is off the goal."""
    worst = 0
    for tuned in (True, False):
        rows = [(c, *measure(c)) for c in grid() if c.tuned == tuned]
        decided = [(c, r, ratio) for c, r, ratio in rows if r.measured]
        wrong = [x for x in decided if not GOAL[0] <= x[2] <= GOAL[1]]
        ratios = np.array([x[2] for x in decided])
        inside = [r.interval[0] <= r.value / ratio <= r.interval[1] for _, r, ratio in decided]
        print(f"{'tuned' if tuned else 'untouched'} half: {len(rows)} recordings, {len(rows) - len(decided)} undecided")
        print(f"  estimated over true: {ratios.min():.2f} to {ratios.max():.2f}, median {np.median(ratios):.2f}")
        print(f"  {len(wrong)} outside {GOAL[0]} to {GOAL[1]}; the interval holds the truth in {np.mean(inside):.0%}")
        for case, report, ratio in wrong:
            print(f"    {ratio:.2f} {case} {report.source}")
        worst += len(wrong)
    return int(worst > 0)


if __name__ == "__main__":
    sys.exit(main())
