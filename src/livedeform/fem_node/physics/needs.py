"""Needs that several cards have of an experiment's declared physics, for their effects to show."""

from __future__ import annotations

import numpy as np

from livedeform.common.effect import Surroundings

LEAST_GRAVITY = 0.1  # m/s2


def weighs(around: Surroundings) -> bool:
    """Return whether gravity acts at all."""
    return bool(np.linalg.norm(around.physics.gravity) > LEAST_GRAVITY)


def is_bonded(around: Surroundings) -> bool:
    """Return whether a support is fixed, so that it could give way."""
    return any(support.type == "fixed" for support in around.physics.supports)
