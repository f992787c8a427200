"""The recorded probe poses as a function of time."""

from __future__ import annotations

from collections.abc import Sequence

from livedeform.common.frames import PosePath, transform
from livedeform.common.types import Array, Pose


class PoseTrack:
    """The probe's pose at any time: between ``poses`` interpolated, before the first and after the last at rest."""

    def __init__(self, poses: Sequence[Pose]) -> None:
        self._path = PosePath(poses)

    def at(self, stamp_ns: float) -> Array:
        """Return T_phantom_probe (4, 4) at a stamp."""
        position, turn = self._path.at([stamp_ns])
        return transform(turn.as_matrix()[0], position[0])
