"""Tell what a released tip does in a few numbers: how often it swings, how fast that fades, how far it creeps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from livedeform.common.types import Array

EARLY = 0.1  # s after the release in which a hand may still have been at it
FINE = 2e-4  # s between which passages are looked for
LATE, AVERAGED = 2.5, 0.5  # s: the ringing has died; over which a height is averaged
SHIFTS = 31  # releases that are tried


@dataclass(frozen=True)
class Swings:
    """``hertz`` of the swing, its ``damping`` ratio (logarithmic decrement over 2 pi) and the ``creep`` m from `LATE`
    to the end."""

    hertz: float
    damping: float
    creep: float


def swings_of(seconds: Array, height: Array) -> Swings:
    """Return what a ``height`` (k,) m does at ``seconds`` (k,) after the release; NaN where it does not swing.

    Frequency and damping are of the second and third swing: a hand lets go during the first.
    """
    after = seconds > 0.0
    course = CubicSpline(seconds[after], height[after])
    t = np.arange(max(EARLY, seconds[after][0]), min(1.5, seconds[-1]), FINE)
    z = course(t) - height[(seconds > 0.5) & (seconds < 1.5)].mean()
    passes = np.flatnonzero((z[1:] >= 0.0) != (z[:-1] >= 0.0))[:6]
    ends = [(seconds > LATE) & (seconds <= LATE + AVERAGED), seconds > seconds[-1] - AVERAGED]
    creep = float(height[ends[1]].mean() - height[ends[0]].mean()) if ends[0].any() else float("nan")
    if len(passes) < 6:
        return Swings(float("nan"), float("nan"), creep)
    peaks = [float(np.abs(z[i : j + 1]).max()) for i, j in pairwise(passes)]
    damping = np.log((peaks[0] + peaks[1]) / (peaks[2] + peaks[3])) / (2.0 * np.pi)
    return Swings(float(2.0 / (t[passes[4]] - t[passes[0]])), float(damping), creep)


def release_of(seconds: Array, measured: Array, predicted: Array, most: float) -> float:
    """Return by how much (s, at most ``most``) the ``measured`` tip (k, m, 3) m was let go later than it is
    ``predicted`` to be, by the smallest error."""
    course = CubicSpline(seconds, predicted)
    shifts = np.linspace(-most, most, SHIFTS)
    return float(min(shifts, key=lambda s: float(np.nanmean((measured - course(seconds - s)) ** 2))))


def rms_error(seconds: Array, measured: Array, predicted: Array, shift: float = 0.0) -> float:
    """Return the rms length of the error m of the ``predicted`` points (k, m, 3) m, let go ``shift`` s later."""
    error = measured - CubicSpline(seconds, predicted)(seconds - shift)
    return float(np.sqrt(np.nanmean((error**2).sum(axis=2))))
