"""The contact laws at a point of the surface: pure functions of gap and slip at the quadrature points.

Augmented Lagrangian (Alart & Curnier 1991; Simo & Laursen 1992). With the gap g (m, negative: penetration), a
multiplier lambda (Pa, per scanned area), and a penalty eps (Pa/m), the pressure is p = max(0, lambda - eps g); it is
the negative derivative of an energy density, so that a minimum of the incremental energy is sought. Repeating
lambda <- p drives the penetration to zero: the multipliers become Lagrange's. All arrays are per point, (n,) or (n, 3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array


class Normal(NamedTuple):
    """Pressure p (n,) Pa (negative: tension), stiffness -dp/dg (n,) Pa/m, energy density (n,) J/m2."""

    pressure: Array
    stiffness: Array
    energy: Array


class Tangential(NamedTuple):
    """Traction on the body t (n, 3) Pa, stiffness -dt/ds (n, 3, 3) Pa/m, energy density (n,) J/m2."""

    traction: Array
    stiffness: Array
    energy: Array


def normal(gap: Array, multiplier: Array, penalty: float, attached: NDArray[np.bool_], strength: float) -> Normal:
    """Pressure between probe and surface.

    Free points can only be pushed. ``attached`` ones also bear tension up to ``strength`` (Pa, may be infinite) and
    keep it while they open; that they have let go is for the outer iteration to say (`has_let_go`).
    """
    trial = multiplier - penalty * gap
    lower = np.where(attached, -strength, 0.0)
    elastic = trial > lower
    pressure = np.where(elastic, trial, lower)
    stiffness = np.where(elastic, penalty, 0.0)
    energy = np.where(elastic, trial * trial, 0.0) / (2.0 * penalty)
    held = attached & ~elastic
    if held.any():
        start = (multiplier[held] + strength) / penalty  # the gap at which the strength is reached
        energy[held] = strength**2 / (2.0 * penalty) + strength * (gap[held] - start)
    return Normal(pressure, stiffness, energy)


def has_let_go(
    gap: Array, pressure: Array, attached: NDArray[np.bool_], strength: float, opening: float
) -> NDArray[np.bool_]:
    """Return which attached points (n,) bool bear their full strength and have opened by more than ``opening``
    (Dugdale's law: the work of separation, strength x opening, does not depend on the mesh)."""
    return attached & (pressure <= -strength) & (gap > opening)


def tangential(slip: Array, projector: Array, multiplier: Array, limit: Array, penalty: float) -> Tangential:
    """Friction by an augmented Lagrangian with the limit (mu p of the last outer iteration) held fixed.

    ``slip`` (n, 3) m from the point's anchor, ``projector`` (n, 3, 3) onto the tangent plane, ``multiplier`` (n, 3) Pa,
    ``limit`` (n,) Pa: sticking while |trial| <= limit, else sliding at the limit. With a fixed limit friction has an
    energy (of Huber's form) and a symmetric tangent; the outer iteration moves the limit.
    """
    trial = np.einsum("nij,nj->ni", projector, multiplier - penalty * slip)
    size = np.linalg.norm(trial, axis=1)
    sliding = (size > limit) | (limit == 0.0)
    safe = np.maximum(size, 1e-300)
    direction = trial / safe[:, None]
    ratio = np.where(sliding, np.where(np.isinf(limit), 0.0, limit) / safe, 1.0)
    along = direction[:, :, None] * direction[:, None, :]
    stiffness = penalty * ratio[:, None, None] * (projector - np.where(sliding, 1.0, 0.0)[:, None, None] * along)
    bounded = np.where(sliding, limit, 0.0)
    energy = np.where(sliding, 2.0 * bounded * size - bounded * bounded, size * size) / (2.0 * penalty)
    return Tangential(trial * ratio[:, None], stiffness, energy)
