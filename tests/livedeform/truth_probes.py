"""Probes on a flat block, for the tests of the truth."""

from __future__ import annotations

import numpy as np

from livedeform.common.frames import transform
from livedeform.common.types import Array
from livedeform.synthetic.truth.probe import TruthProbe

TOP, PLATE, BALL = 0.02, TruthProbe("box", (0.09, 0.08, 0.04), 0.0), TruthProbe("sphere", (0.025,))


def down(x: float, y: float, z: float) -> Array:
    """Return the pose (4, 4) of a probe at a place in m, whose face looks down."""
    return transform(np.diag([1.0, -1.0, -1.0]), np.array([x, y, z]))
