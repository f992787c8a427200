"""Newton's method with a line search along each correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import IntArray
from livedeform.synthetic.truth.linear import Factors
from livedeform.synthetic.truth.probe import Tractions

MAX_ITERATIONS = 40
LONGEST_CORRECTION = 0.004  # m that a node goes at most in one iteration
SINGULAR = 0.5  # m; a correction that long comes from a singular matrix


@dataclass(frozen=True)
class Evaluation:
    """Hold what the equations say at one place.

    ``sound`` is False where an element is inside out; ``data`` are the values of the tangent's pattern, ``residual``
    (k,) N the load minus the inner force of the free unknowns.
    """

    sound: bool
    data: Array
    residual: Array
    contact: Tractions | None


Evaluate = Callable[[Array], Evaluation]


def solve(
    x: Array, free: IntArray, evaluate: Evaluate, factors: Factors, *, symmetric: bool, tolerance: float
) -> tuple[Array, int, Tractions | None]:
    """Solve residual(x) = 0 from ``x`` (n, 3) m, in the unknowns ``free`` (k,).

    Returns the places, the iterations spent and the contact. Raises ConvergenceError where that fails. ``tolerance`` m
    is that of the last correction.
    """
    found = evaluate(x)
    if not found.sound:
        raise ConvergenceError("an element is inside out")
    for iteration in range(1, MAX_ITERATIONS + 1):
        correction = factors.solve(found.data, found.residual, symmetric=symmetric)
        largest = float(np.abs(correction).max())
        if not np.isfinite(largest) or largest > SINGULAR:
            raise ConvergenceError("the tangent is singular")
        if largest < tolerance:
            return _moved(x, free, correction), iteration, found.contact
        correction *= min(1.0, LONGEST_CORRECTION / largest)
        if symmetric and found.residual @ correction < 0.0:  # the tangent is indefinite there: go downhill all the same
            correction = -correction
        x, found = _along(x, free, correction, found.residual, evaluate)
        if not found.sound:
            raise ConvergenceError("an element turned inside out")
    raise ConvergenceError(f"no equilibrium after {iteration} iterations (last correction {largest:.2g} m)")


def _along(
    x: Array, free: IntArray, correction: Array, residual: Array, evaluate: Evaluate
) -> tuple[Array, Evaluation]:
    """Go along a correction until the energy's slope has turned little: with contact the full step overshoots.

    With friction there is no energy, and residual . correction may begin below zero; it falls to zero all the same.
    """
    start = float(residual @ correction)
    sign = -1.0 if start < 0.0 else 1.0
    start *= sign
    share, low, high = 1.0, 0.0, 1.0
    slope_low, slope_high, bounded = start, 0.0, False
    for _ in range(7):
        trial = _moved(x, free, share * correction)
        found = evaluate(trial)
        slope = sign * float(found.residual @ correction) if found.sound else -np.inf
        if slope > -0.4 * start and (not bounded or slope < 0.6 * start):
            break
        if slope < 0.0:
            high, slope_high, bounded = share, slope, True
        else:
            low, slope_low = share, slope
        if not np.isfinite(slope_high):
            share = 0.5 * (low + high)
        else:
            fraction = slope_low / (slope_low - slope_high)
            share = low + (high - low) * min(max(fraction, 0.1), 0.9)
    return trial, found


def _moved(x: Array, free: IntArray, correction: Array) -> Array:
    moved = x.copy()
    moved.reshape(-1)[free] += correction
    return moved
