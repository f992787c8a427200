"""Ask a point's neighbours on the board for its place in the picture: whatever the lens, a board is seen smoothly.

Each point is predicted from those around it, without itself, by a quadratic map from the board to the picture (an
affine one where there are few), fitted with Cauchy weights. Neither lengths nor a lens model enter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

N_NEIGHBOURS = 16
REACH = 3.1  # squares: how far neighbours may be
FEWEST, FOR_QUADRATIC = 4, 9  # neighbours
N_ROUNDS = 6
LEAST_SCALE = 0.3  # px, of the weights
OFF = 0.12  # of the distance to the next point, and ..
OFF_PX = 1.0  # .. px by which a point may miss its prediction
UNTOLD = 1e9  # times that: a point of which too few neighbours tell


@dataclass(frozen=True)
class Lattice:
    """Predictions at every point: ``places`` (n, 2) px, NaN where too few neighbours tell it; ``along``, ``across``
    (n, 2) px per square of the board's x and y."""

    places: Array
    along: Array
    across: Array

    @property
    def spacing(self) -> Array:
        """Distance (n,) px to the next point of the board."""
        out: Array = np.minimum(np.linalg.norm(self.along, axis=1), np.linalg.norm(self.across, axis=1))
        return out

    @property
    def directions(self) -> tuple[Array, Array]:
        """Directions (n,) rad of the board's x and y in the picture."""
        return np.arctan2(self.along[:, 1], self.along[:, 0]), np.arctan2(self.across[:, 1], self.across[:, 0])


def predict(
    steps: Array, pixels: Array, good: NDArray[np.bool_] | None = None, of: NDArray[np.int64] | None = None
) -> Lattice:
    """Predict every point, or those numbered ``of`` (m,), from its neighbours.

    ``steps`` (n, 2): places on the board, in squares; ``pixels`` (n, 2) where they were found; only those that are
    ``good`` (n,) tell of others.
    """
    usable = np.ones(len(steps), bool) if good is None else good
    at = np.arange(len(steps)) if of is None else of
    away = np.linalg.norm(steps[at, None] - steps[None], axis=2)
    away[:, ~usable] = np.inf
    away[np.arange(len(at)), at] = np.inf
    nearest = np.argsort(away, axis=1)[:, :N_NEIGHBOURS]
    there = np.take_along_axis(away, nearest, axis=1) <= REACH
    d = steps[nearest] - steps[at, None]
    x, y = d[..., 0], d[..., 1]
    quadratic = (there.sum(axis=1) >= FOR_QUADRATIC)[:, None]
    A = np.stack([np.ones_like(x), x, y, x * x * quadratic, x * y * quadratic, y * y * quadratic], axis=2)
    q = _fit(A, pixels[nearest], there)
    q[there.sum(axis=1) < FEWEST] = np.nan
    return Lattice(q[:, 0], q[:, 1], q[:, 2])


def _fit(A: Array, seen: Array, there: NDArray[np.bool_]) -> Array:
    """Return coefficients (n, 6, 2) of the maps of ``A`` (n, k, 6) to ``seen`` (n, k, 2)."""
    weight = there.astype(float)
    ridge = 1e-9 * np.eye(A.shape[2])
    q = np.zeros((len(A), A.shape[2], 2))
    for _ in range(N_ROUNDS):
        of_weight = np.swapaxes(A * weight[:, :, None], 1, 2)
        q = np.linalg.solve(of_weight @ A + ridge, of_weight @ seen)
        r = np.linalg.norm(seen - A @ q, axis=2)
        r[~there] = np.nan
        scale = np.fmax(np.nanmedian(np.where(there.any(axis=1, keepdims=True), r, 0.0), axis=1), LEAST_SCALE)
        weight = np.where(there, 1.0 / (1.0 + (r / (2 * scale[:, None])) ** 2) ** 2, 0.0)
    return q


def fitting(steps: Array, pixels: Array, fit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which (n,) of the points that ``fit`` lie where their neighbours say.

    The worst of each neighbourhood is taken out at a time, and the others of it are judged again.
    """
    good = fit.copy()
    near = np.asarray(np.abs(steps[:, None] - steps[None]).max(axis=2) <= REACH)
    miss, judged = np.zeros(len(steps)), np.arange(len(steps))
    for _ in range(len(pixels)):
        lattice = predict(steps, pixels, good, judged)
        off = np.linalg.norm(pixels[judged] - lattice.places, axis=1) / np.maximum(OFF * lattice.spacing, OFF_PX)
        miss[judged] = np.nan_to_num(off, nan=UNTOLD)
        excess = np.where(good, miss, 0.0)
        worst = (excess > 1) & (excess >= np.where(near, excess, 0.0).max(axis=1))
        if not worst.any():
            break
        good &= ~worst
        judged = np.flatnonzero(near[worst].any(axis=0))
    return good
