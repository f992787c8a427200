"""Verify a contact solution: a state may be in balance, free of penetration, and wrong nevertheless.

Newton's method solves equations at contact points; that the state they give is one of a body touched from outside is
not among them. Here it is looked at, as a pure function of the deformed surface near the probe: nothing of the surface
lies inside the probe, also between the contact points; nothing is pulled where nothing sticks, and nothing is pushed
that does not touch; what is pushed looks at the probe (otherwise the probe stands behind it, inside the body); and the
probe is outside the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

FROM_BEHIND = 0.02  # of the pressure, on facets that look away from the probe: more is a probe behind the surface
PULL = 1e-6  # of the largest pressure


class Touched(NamedTuple):
    """The surface near a probe at its contact points (n,): gap ``gap`` m, pressure ``pressure`` Pa on the area
    ``weight`` m2, whether it is ``attached``; ``facing`` (n,): cosine between the body's outward normal and the
    direction in which the probe pushes; ``deepest_between`` m: how deep the surface is inside the probe anywhere."""

    gap: Array
    pressure: Array
    weight: Array
    attached: NDArray[np.bool_]
    facing: Array
    deepest_between: float


def flaw(touched: Touched, *, tolerance: float, compliance: float, between: float, pulls: float) -> str:
    """Say what is wrong with a contact; "" if nothing is.

    ``tolerance`` m: of gaps, and ``compliance`` m/Pa of a contact that is held by springs; ``between`` m: how deep the
    probe may stand between contact points, which only a finer mesh would see; ``pulls`` Pa: strength of adhesion.
    """
    p, gap = touched.pressure, touched.gap
    largest = float(np.abs(p).max(initial=0.0))
    depth = -float(np.min(gap + compliance * np.maximum(p, 0.0), initial=0.0))
    if depth > tolerance:
        return f"the surface is {1e3 * depth:.2f} mm inside the probe"
    if touched.deepest_between > between:
        return f"the probe stands {1e3 * touched.deepest_between:.1f} mm deep between the contact points"
    pulled = np.where(touched.attached, p + pulls, p)
    if float(pulled.min(initial=0.0)) < -PULL * max(largest, 1.0):
        return "the probe pulls at a surface that does not stick"
    afar = float(np.max(np.where(p > 0.0, gap, 0.0), initial=0.0))
    if afar > tolerance:
        return f"the probe pushes from {1e3 * afar:.2f} mm away"
    force = touched.weight * np.maximum(p, 0.0)
    total, behind = float(force.sum()), float(force[touched.facing > 0.0].sum())
    if behind > FROM_BEHIND * total:
        return f"{100.0 * behind / total:.0f} % of the contact force act on the surface from inside the body"
    return ""
