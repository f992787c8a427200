"""Tell how much of what an effect moves held-out data call for.

In the error with an effect as in that without it are where markers were stuck, how cameras were registered, and what
elements err by. They scatter the fall of its mean square by a tenth of the noise's and more, as much as a true effect
takes off. In `gauss_newton.Marginal` they are integrated out, and the noise is white: of what is left without the
effect, r~, and of what it moves, m~, the least squares are

    share = m~.r~ / m~.m~,   with a standard error of 1 / |m~|.

The mean square of the error then falls by (2 share - 1) of that of what is moved: by all of it where the data call for
the whole effect, by nothing where they call for half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.closed_loop.assessment.held_out import HeldOutErrors
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.common.types import Array

NOTHING = 1e-12  # (standard errors)2 of what is moved: less is round-off


@dataclass(frozen=True)
class Called:
    """Says for how much of an effect held-out data call: for that ``share`` of what it moves, and its standard error
    ``sigma``; ``moved``: the mean square of that, as a part of the noise's."""

    share: float
    sigma: float
    moved: float

    @property
    def fall(self) -> float:
        """Return the part of the noise's mean square by which the error's falls. If data call for more than all of it,
        what more would take off is not of this effect as it is."""
        return self._fall(self.share)

    def matters(self, part: float) -> bool:
        """Tell whether the error's mean square falls by more than that ``part`` of the noise's, and still does if the
        data call for a standard error less."""
        return self._fall(self.share - self.sigma) > part

    def _fall(self, share: float) -> float:
        return (2.0 * min(share, 1.0) - 1.0) * self.moved


def called_for(
    problem: Problem, without: Array, having: Array, moved: float = np.nan, *, pressed: bool = True
) -> Called:
    """Tell it from what is left ``without`` the effect and ``having`` it (n,), m, of the markers in the rows of a
    ``problem``, which it ``moved`` by that part of the noise's mean square (NaN: nobody asks for it).

    The standard error is no less than that of independent data, nor than what presses and markers differ by; what is
    let go instead of ``pressed`` shows itself in one stretch of time, and is counted over markers alone.
    """
    marginal, rows = problem.marginal, problem.rows
    seen = rows.marker >= 0
    left, motion = marginal(without)[seen], marginal(without - having)[seen]
    size = float(motion @ motion)
    if not size > NOTHING:
        return Called(0.0, np.inf, moved)
    share = float(motion @ left) / size
    scores = motion * (left - share * motion)
    groups = (rows.fold, rows.marker) if pressed else (rows.marker,)
    spread = np.hypot.reduce([scatter(np.bincount(of[seen], scores)[np.unique(of[seen])]) for of in groups])
    return Called(share, float(max(np.sqrt(size), spread) / size), moved)


def moved_in_noise(without: HeldOutErrors, having: HeldOutErrors) -> float:
    """Find the mean square of what an effect moves held-out markers, each direction in units of its noise and each
    moment weighted with the time that it stands for; cameras are registered with it as they are without it."""
    pairs = zip(without.recordings, having.recordings, strict=True)
    moved = [replace(b, measured=a.measured - a.predicted, predicted=b.measured - b.predicted) for a, b in pairs]
    return float(np.nan_to_num(HeldOutErrors(tuple(moved)).chi2()))


def scatter(parts: Sequence[float] | Array) -> float:
    """Return the standard deviation of a sum of parts whose mean is zero."""
    n = len(parts)
    return float(np.sqrt(n / (n - 1) * np.sum(np.square(parts)))) if n > 1 else np.inf
