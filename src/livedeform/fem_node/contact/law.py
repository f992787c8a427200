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

from livedeform.common.compiled import njit
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
    pressure, stiffness, energy = np.empty(len(gap)), np.empty(len(gap)), np.empty(len(gap))
    _normal(gap, multiplier, penalty, attached, strength, pressure, stiffness, energy)
    return Normal(pressure, stiffness, energy)


def has_let_go(
    gap: Array, pressure: Array, attached: NDArray[np.bool_], strength: float, opening: float
) -> NDArray[np.bool_]:
    """Return which attached points (n,) bool bear their full strength and have opened by more than ``opening``
    (Dugdale's law: the work of separation, strength x opening, does not depend on the mesh)."""
    return attached & (pressure <= -strength) & (gap > opening)


def tangential(slip: Array, normals: Array, multiplier: Array, limit: Array, penalty: float) -> Tangential:
    """Friction by an augmented Lagrangian with the limit (mu p of the last outer iteration) held fixed.

    ``slip`` (n, 3) m from the point's anchor, of which what is along the unit ``normals`` (n, 3) does not count,
    ``multiplier`` (n, 3) Pa, ``limit`` (n,) Pa: sticking while |trial| <= limit, else sliding at the limit. With a
    fixed limit friction has an energy (of Huber's form) and a symmetric tangent; the outer iteration moves the limit.
    """
    n = len(slip)
    traction, stiffness, energy = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    _tangential(slip, normals, multiplier, limit, penalty, traction, stiffness, energy)
    return Tangential(traction, stiffness, energy)


@njit(cache=True)
def _normal(gap, multiplier, penalty, attached, strength, pressure, stiffness, energy):
    for k in range(len(gap)):
        trial = multiplier[k] - penalty * gap[k]
        lower = -strength if attached[k] else 0.0
        if trial > lower:
            pressure[k], stiffness[k], energy[k] = trial, penalty, trial * trial / (2.0 * penalty)
            continue
        pressure[k], stiffness[k], energy[k] = lower, 0.0, 0.0
        if attached[k]:
            start = (multiplier[k] + strength) / penalty  # the gap at which the strength is reached
            energy[k] = strength**2 / (2.0 * penalty) + strength * (gap[k] - start)


@njit(cache=True)
def _tangential(slip, normals, multiplier, limit, penalty, traction, stiffness, energy):
    trial = np.empty(3)
    for k in range(len(slip)):
        n, along = normals[k], 0.0
        for i in range(3):
            trial[i] = multiplier[k, i] - penalty * slip[k, i]
            along += n[i] * trial[i]
        square = 0.0
        for i in range(3):
            trial[i] -= along * n[i]
            square += trial[i] * trial[i]
        size = np.sqrt(square)
        slides = size > limit[k] or limit[k] == 0.0
        ratio = limit[k] / max(size, 1e-300) if slides else 1.0
        for i in range(3):
            traction[k, i] = ratio * trial[i]
            for j in range(3):
                plane = (1.0 if i == j else 0.0) - n[i] * n[j]
                turned = trial[i] * trial[j] / max(square, 1e-300) if slides else 0.0
                stiffness[k, i, j] = penalty * ratio * (plane - turned)
        energy[k] = (2.0 * limit[k] * size - limit[k] ** 2 if slides else square) / (2.0 * penalty)
