"""Find in which steps values were written, and what rounding to them leaves of a measurement.

The error of a rounded value that is repeated has two parts. One is another from time to time, as noise carries the
value over the border of a step; it is what repeats show. The other stays as long as the true value does, and no mean of
repeats is rid of it. Where true values are spread evenly over a step both follow from the noise and the step (Widrow
and Kollar 2008, Quantization Noise): of a noise that is much smaller than the step nearly nothing shows.
"""

from __future__ import annotations

import numpy as np

from livedeform.closed_loop.settings import NoiseSettings
from livedeform.common.types import Array


def steps_of(differences: Array, largest: float, settings: NoiseSettings) -> Array:
    """Find the steps (3,) in which values were written whose second ``differences`` (n, 3) those are, in their unit,
    and of which the ``largest`` is that large: 0 along axes where there is none, or one far below the noise.

    Values that were turned after they were rounded show their step in none of the axes, and all the same in how long
    differences are: a sum of squares of whole steps.
    """
    least = 16.0 * float(np.finfo(np.float32).eps) * largest  # what messages and turns leave of values that are alike
    along = np.sqrt(_step((differences**2).sum(axis=1), least**2, settings))
    return np.array([max(_step(np.abs(d), least, settings), along) for d in differences.T])


def _step(sizes: Array, least: float, settings: NoiseSettings) -> float:
    """Find the largest number of which nearly all ``sizes`` (n,) above the ``least`` are multiples; 0 where there is
    none that one of the smallest of them is a few times."""
    share, near, most = settings.whole
    sizes = sizes[sizes > least]
    if len(sizes) < settings.few:
        return 0.0
    small = float(np.quantile(sizes, 1.0 - share, method="inverted_cdf"))
    for times in range(1, most + 1):
        parts = sizes * (times / small)
        if (np.abs(parts - np.rint(parts)) < near).mean() > share:
            return small / times
    return 0.0


def of_rounding(steps: Array) -> Array:
    """Return the variance (...) of rounding to ``steps`` (...), of true values that are spread evenly over them."""
    return np.asarray(np.square(steps) / 12.0)


def that_lasts(repeats: Array, steps: Array) -> Array:
    """Return the variance (...) of the part of a rounding error that stays while the true value does, where the
    variance ``repeats`` (...) is seen from one repeat to the next, and values are written in ``steps`` (...)."""
    # noise of s steps: the error's mean over repeats has harmonics k of amplitude exp(-2 (pi k s)^2) / (pi k)
    s, k = np.linspace(0.0, 1.0, 201), np.arange(1.0, 501.0)
    lasts = (np.exp(-4.0 * (np.pi * s[:, None] * k) ** 2) / k**2).sum(axis=1) / (2.0 * np.pi**2)
    shown = s**2 + lasts[0] - lasts
    square = np.square(steps)
    seen = np.divide(repeats, square, out=np.full(np.shape(square), np.inf), where=square > 0.0)
    return np.asarray(square * np.interp(seen, shown, lasts, right=0.0))
