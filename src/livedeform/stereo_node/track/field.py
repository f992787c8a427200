"""The smooth field by which markers move: a Gaussian process over their places at rest (Rasmussen & Williams 2006).

It is asked many times for each picture, for sets of markers that differ by a few. So the inverse K^-1 of the kernel of
a set about as large is kept, and a smaller one's is that less what the markers beside it account for,
A - B^T D^-1 B with K^-1 = [A, B^T; B, D] (Schur's complement, ibid. A.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array

Rows = NDArray[np.int64]
MIN_NEIGHBOURS = 8


@dataclass(frozen=True)
class Among:
    """Solve with the kernel of markers (n,): its inverse is that of ``precision`` (k, k) at ``rows`` (n,), less
    W^T W, ``left_out`` (r, n)."""

    precision: Array
    rows: Rows
    left_out: Array

    def solve(self, values: Array) -> Array:
        """Return the inverse times ``values`` (n, c)."""
        spread = np.zeros((len(self.precision), values.shape[1]))
        spread[self.rows] = values
        out: Array = (self.precision @ spread)[self.rows] - self.left_out.T @ (self.left_out @ values)
        return out

    def size(self, moved: Array) -> float:
        """Return the size (m) of the field by which the markers ``moved`` (n, 3) m, beside their mean."""
        if len(moved) == 0:
            return 0.0
        rest = moved - moved.mean(axis=0)
        # from the data themselves (their quadratic form), per axis
        return math.sqrt(max(float((rest * self.solve(rest)).sum()), 0.0) / (3 * len(rest)))

    def move_together(self, surprise: Array, allowed: Array, least: int = 0) -> NDArray[np.bool_]:
        """Tell which markers (n,) are about as far from their prediction, ``surprise`` (n, 3) m, as their neighbours
        foretell (leave-one-out kriging; Rasmussen & Williams 5.4.2), within ``allowed`` (n,) m and their own scatter.

        Those that are not are dropped worst first, one by one, while there are ``least`` left.
        """
        solved = self.solve(np.column_stack([surprise, np.ones(len(surprise))]))
        diagonal = np.diag(self.precision)[self.rows] - (self.left_out**2).sum(axis=0)
        keep = np.ones(len(surprise), np.bool_)
        least = max(least, MIN_NEIGHBOURS)
        _drop_worst(self.precision, self.rows, self.left_out, solved, diagonal, surprise, allowed, least, keep)
        return keep


class SmoothField:
    """Matern 3/2 over markers' places: a field with continuous slopes."""

    def __init__(self, distance: Array, length: float) -> None:
        """Take the ``distance`` (m, m) m of the markers at rest and the correlation ``length`` m."""
        a = np.sqrt(3) * distance / length
        self._kernel = (1 + a) * np.exp(-a)
        self._base: Rows = np.zeros(0, np.int64)  # the markers of which the inverse is kept
        self._precision: Array = np.zeros((0, 0))

    def among(self, markers: Rows) -> Among:
        """Return what solves with the kernel of ``markers`` (n,), each of them once."""
        if 2 * len(markers) < len(self._base):  # few: what is beside them would cost more
            return Among(self._inverse(markers), np.arange(len(markers)), np.zeros((0, len(markers))))
        at = np.full(len(self._kernel), -1)
        at[self._base] = np.arange(len(self._base))
        if (at[markers] < 0).any():
            self._base = np.union1d(self._base, markers)
            self._precision = self._inverse(self._base)
            at[self._base] = np.arange(len(self._base))
        rows = at[markers]
        others = np.ones(len(self._base), bool)
        others[rows] = False
        beside = np.flatnonzero(others)
        factor = np.linalg.cholesky(self._precision[np.ix_(beside, beside)])
        return Among(self._precision, rows, np.linalg.inv(factor) @ self._precision[np.ix_(beside, rows)])

    def _inverse(self, markers: Rows) -> Array:
        """Return the inverse (n, n) of the kernel of ``markers`` (n,)."""
        return np.linalg.inv(self._kernel[np.ix_(markers, markers)] + 1e-3 * np.eye(len(markers)))

    def carried(self, markers: Rows, moved: Array, lost: Rows) -> tuple[Array, Array, float]:
        """Return how far ``lost`` markers (l,) moved, (l, 3) m, where ``markers`` (n,) ``moved`` by (n, 3) m (kriging;
        Rasmussen & Williams 2.2), the standard deviation of that, (l,) m, and the field's size, m."""
        among, mean = self.among(markers), moved.mean(axis=0)
        k = self._kernel[np.ix_(lost, markers)]
        left_over = np.maximum(1 - (among.solve(k.T).T * k).sum(axis=1), 0.0)
        size = among.size(moved)
        return mean + k @ among.solve(moved - mean), size * np.sqrt(left_over), size


@njit(cache=True, error_model="numpy")
def _drop_worst(precision, rows, left_out, solved, diagonal, surprise, allowed, least, keep):
    """Drop from ``keep`` (n,) the markers of `Among.move_together`. ``solved`` (n, 4): the inverse times the surprise
    and times one; ``diagonal`` (n,): the inverse's. A dropped marker takes v v^T off the inverse."""
    n, n_kept = len(rows), len(rows)
    taken, off, middle, some = np.empty((n, n)), np.empty(n), np.empty(3), np.empty(n)
    while n_kept >= least:
        for axis in range(3):
            middle[axis] = _median(surprise[:, axis], keep, some)
        for i in range(n):
            square = 0.0
            for axis in range(3):
                square += (solved[i, axis] - solved[i, 3] * middle[axis]) ** 2
            off[i] = math.sqrt(square / diagonal[i])  # spreads
        size, most, worst = _median(off, keep, some), 0.0, -1
        for i in range(n):
            excess = (off[i] - 6.0 * size) / math.sqrt(diagonal[i]) - allowed[i]
            if keep[i] and excess > most:
                most, worst = excess, i
        if worst < 0:
            break
        v = taken[n - n_kept]
        _column(precision, rows, left_out, taken[: n - n_kept], worst, v)
        share = 1.0 / v[worst]
        for i in range(n):
            diagonal[i] -= v[i] * v[i]
            for axis in range(4):
                solved[i, axis] -= v[i] * share * solved[worst, axis] if i != worst else 0.0
        keep[worst] = False
        n_kept -= 1


@njit(cache=True, error_model="numpy")
def _median(values, keep, some):
    """Return the median of those ``values`` (n,) that are kept; ``some`` (n,) is written to."""
    n = 0
    for i in range(len(values)):
        if keep[i]:
            some[n] = values[i]
            n += 1
    return np.median(some[:n])


@njit(cache=True, error_model="numpy")
def _column(precision, rows, left_out, taken, k, out):
    """Write column ``k`` of the inverse over the root of its diagonal into ``out`` (n,)."""
    for i in range(len(out)):
        out[i] = precision[rows[k], rows[i]]
    for before in (left_out, taken):
        for j in range(len(before)):
            share = before[j, k]
            for i in range(len(out)):
                out[i] -= share * before[j, i]
    root = math.sqrt(out[k])
    for i in range(len(out)):
        out[i] /= root
