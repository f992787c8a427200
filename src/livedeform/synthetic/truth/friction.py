"""The truth's friction: Coulomb's law with multipliers, so that a point that sticks stays where it stuck.

A penalty alone is a spring: under a pressure p it gives by mu p / penalty before it slides, 0.6 mm under a gelatin's
press. With a multiplier that takes the spring's force over, round after round, the spring is left with none of it
(augmented Lagrangian; Simo & Laursen 1992). All arrays are per face point, in the probe's frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

SOFT_SLIP = 1e-6  # m: what begins to slide does so over twice this way, so that Newton does not flip points to and fro


class Shear(NamedTuple):
    """Hold the ``traction`` (n, 3) Pa along the probe, its ``stiffness`` -dt/dx (n, 3, 3) Pa/m, and what ``sticks``
    (n,)."""

    traction: Array
    stiffness: Array
    sticks: NDArray[np.bool_]


def coulomb(
    trial: Array, n: Array, H: Array, pressure: Array, hardness: Array, penalty: float, friction: float
) -> Shear:
    """Return the friction of points pressed with ``pressure`` (n,) Pa, whose stiffness is ``hardness`` (n,) Pa/m.

    ``trial`` (n, 3) Pa is the multiplier less the penalty (Pa/m) times the way from the anchor; its part along the
    surface acts where it is within the limit, friction times the present pressure, else the limit in its direction;
    the kink between is rounded.
    ``n`` (n, 3) and ``H`` (n, 3, 3) 1/m are the gap's gradient and Hessian: a surface that turns turns the traction.
    """
    limit = friction * np.maximum(pressure, 0.0)
    along = np.einsum("ni,ni->n", trial, n)
    trial_t = trial - along[:, None] * n
    size = np.linalg.norm(trial_t, axis=1)
    borne, share, follows = _limited(size, limit, penalty * SOFT_SLIP)
    safe = np.maximum(size, 1e-12)
    ratio, d = np.where(size > 0.0, borne / safe, share), trial_t / safe[:, None]
    K = penalty * (np.eye(3) - _outer(n, n)) + along[:, None, None] * H + _outer(n, np.einsum("nij,nj->ni", H, trial))
    K = ratio[:, None, None] * K + _outer((share - ratio)[:, None] * d, np.einsum("ni,nij->nj", d, K))
    # how the limit follows the pressure: makes the tangent unsymmetric, and Newton fast
    K += (friction * follows * hardness)[:, None, None] * _outer(d, n)
    return Shear(trial_t * ratio[:, None], K, share == 1.0)


def _limited(size: Array, limit: Array, width: float) -> tuple[Array, Array, Array]:
    """Return min(size, limit) (n,) Pa with its kink rounded over ``width`` Pa to both sides, and its derivatives (n,).

    The derivatives are those by the size and by the limit. The width is half of the limit at most.
    """
    narrow = limit < 2.0 * width
    w = np.where(narrow, 0.5 * limit, width)
    safe = np.maximum(w, 1e-12)
    over = np.where(limit > 0.0, np.clip((size - limit + w) / (2.0 * safe), 0.0, 1.0), 1.0)
    borne = np.where(over < 1.0, size - over * over * w, limit)
    follows = np.where(limit > 0.0, over - np.where(narrow, 0.5, 0.0) * over * (1.0 - over), 0.0)
    return borne, 1.0 - over, follows


def unsettled(shear: Array, sticks: NDArray[np.bool_], multiplier: Array, limit: Array, penalty: float) -> float:
    """Return how far (m) the points still move by what multipliers (n, 3) Pa lack of the ``shear`` (n, 3) Pa found.

    All that a point that ``sticks`` (n,) lacks is a slip that it should not have; of one that slides only what is
    within its ``limit`` (n,) Pa counts.
    """
    size = np.maximum(np.linalg.norm(multiplier, axis=1), 1e-12)
    within = multiplier * np.where(sticks, 1.0, np.minimum(1.0, limit / size))[:, None]
    return float(np.linalg.norm(shear - within, axis=1).max(initial=0.0)) / penalty


def met(before: Array, after: Array, gap_before: Array, gap_after: Array) -> Array:
    """Return where (n, 3) m points that go straight from ``before`` to ``after`` (n, 3) m come nearest to the probe.

    The gaps (n,) m are those of the two places: where they change their sign, the points arrive.
    """
    closing = gap_after < gap_before
    share = np.where(closing, np.clip(gap_before / np.where(closing, gap_before - gap_after, 1.0), 0.0, 1.0), 0.0)
    places: Array = before + share[:, None] * (after - before)
    return places


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None, :]
