"""Tells which side of a flat pattern the cameras see.

The places of markers in a plane fit just as well mirrored, as a half turn out of the plane: a list whose axis runs the
wrong way turns the body upside down, and no residual shows it. Only what is known of the body tells: cameras see its
outside.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

FLAT = 0.02  # of a pattern's length that it stands out of its plane (singular values): mirrored, it fits as well
STEPS = (0.003, 0.01, 0.03)  # of the body's diagonal, from a marker to both sides: thin bodies, and places beside it
ENOUGH = 16  # markers that are asked


def nearly_flat(points: Array) -> bool:
    """Tell whether ``points`` (n, 3) m lie in a plane as nearly as registrations can tell."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(spread) < 3 or spread[2] < FLAT * spread[0])


def outward_side(body: Surface, points: Array) -> Array | None:
    """Return the unit normal (3,) of the plane of markers at ``points`` (n, 3) m that points out of the ``body``; None
    where they do not lie on one side of it."""
    normal = np.asarray(np.linalg.svd(points - points.mean(axis=0))[2][2])
    asked = points[np.linspace(0, len(points) - 1, min(len(points), ENOUGH)).astype(int)]
    votes = 0
    for step in STEPS:
        away = step * body.diagonal * normal
        votes += int(body.contains(asked - away).sum()) - int(body.contains(asked + away).sum())
    if 2 * abs(votes) <= len(asked):
        votes = _votes_of_those_above(body, asked, normal)
    if 2 * abs(votes) <= len(asked):
        return None
    return normal if votes > 0 else -normal


def _votes_of_those_above(body: Surface, points: Array, normal: Array) -> int:
    """Count for which side ``normal`` (3,) points (n, 3) m are that stand off the ``body``, as balls and pins do: along
    it their distance from the surface grows, one to one where it is the nearest place's own normal.

    Those inside have no voice: cameras may look at them through the thicker part as well.
    """
    step = STEPS[0] * body.diagonal
    slope = (body.distance(points + step * normal) - body.distance(points - step * normal)) / (2 * step)
    clear = (np.abs(slope) > 0.5) & ~body.contains(points)  # those beside the body are nearest to it across the normal
    return int(np.sign(slope[clear]).sum())


def sees_outside(T_phantom_left: Array, points: Array, outward: Array) -> bool:
    """Tell whether cameras at ``T_phantom_left`` (4, 4) see markers at ``points`` (n, 3) m from their side ``outward``
    (3,)."""
    return bool((T_phantom_left[:3, 3] - points.mean(axis=0)) @ outward > 0)
