"""The recorded probe poses as a function of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from livedeform.common.types import Array, Pose


class PoseTrack:
    """``poses`` in the order of their stamps; between them positions and rotations are interpolated, before the first
    and after the last they stand still."""

    def __init__(self, poses: Sequence[Pose]) -> None:
        stamps = np.array([pose.stamp_ns for pose in poses], np.int64)
        stamps, first = np.unique(stamps, return_index=True)
        self._start_ns = int(stamps[0])
        self._seconds = 1e-9 * (stamps - self._start_ns)
        self._positions = np.array([poses[i].position for i in first], float)
        rotations = Rotation.from_quat([poses[i].orientation_xyzw for i in first])
        self._turn = Slerp(self._seconds, rotations) if len(stamps) > 1 else lambda t: rotations[0]

    def at(self, stamp_ns: float) -> Array:
        """T_phantom_probe (4, 4) at a stamp."""
        t = float(np.clip(1e-9 * (stamp_ns - self._start_ns), 0.0, self._seconds[-1]))
        T = np.eye(4)
        T[:3, :3] = self._turn(t).as_matrix()
        T[:3, 3] = [np.interp(t, self._seconds, column) for column in self._positions.T]
        return T
