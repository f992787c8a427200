"""Rigid transforms T_target_source as 4 x 4 matrices, poses in between, and the best rigid fit of two point sets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, Pose

__all__ = ["PosePath", "apply", "fit_rigid", "inverse", "matrix_pose", "pose_matrix", "slerp", "transform", "unit_pose"]

MAKE_A_FRAME = 3  # points, if they are not in one line
NO_ROTATION = "a pose is not finite or has the quaternion zero"


def pose_matrix(pose: Pose) -> Array:
    """Return T_target_source (4, 4) of a pose; the quaternion is normalised."""
    return transform(Rotation.from_quat(pose.orientation_xyzw).as_matrix(), pose.position)


def unit_pose(stamp_ns: int, position: Sequence[float], orientation_xyzw: Sequence[float]) -> Pose:
    """Return the pose with its quaternion normalised; ``RecordingError`` for one that is not finite or no rotation."""
    pose = unit_poses([stamp_ns], np.array([position], float), np.array([orientation_xyzw], float))[0]
    if pose is None:
        raise RecordingError(
            NO_ROTATION,
            remedy="publish position in metres and a unit quaternion x, y, z, w",
        )
    return pose


def unit_poses(stamps_ns: Sequence[int], positions: Array, orientations_xyzw: Array) -> list[Pose | None]:
    """Return poses of ``positions`` (n, 3) m and quaternions (n, 4), which are normalised; None for one that is not
    finite or no rotation."""
    with np.errstate(all="ignore"):
        norms = np.sqrt((orientations_xyzw**2).sum(axis=1))
        units = orientations_xyzw / norms[:, None]
    good = np.isfinite(positions).all(axis=1) & np.isfinite(norms) & (norms >= 1e-6)
    rows = zip(stamps_ns, positions, units, good.tolist(), strict=True)
    return [Pose(stamp_ns, position, unit) if is_good else None for stamp_ns, position, unit, is_good in rows]


def transform(rotation: Array, translation: Array) -> Array:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def matrix_pose(T: Array, stamp_ns: int = 0) -> Pose:
    """Return the pose of a (4, 4) transform."""
    return Pose(stamp_ns, T[:3, 3].copy(), Rotation.from_matrix(T[:3, :3]).as_quat())


def apply(T: Array, points: Array) -> Array:
    """Transform ``points`` (n, 3) from the source frame into the target frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def inverse(T: Array) -> Array:
    """Return T_source_target of T_target_source."""
    R = T[:3, :3].T
    return transform(R, -R @ T[:3, 3])


def fit_rigid(source: Array, target: Array, weights: Array | None = None) -> Array:
    """Find T_target_source (4, 4) that minimises sum_i w_i |target_i - T source_i|^2 (Kabsch 1976; Umeyama 1991).

    ``source`` and ``target`` (n, 3), n >= 3 and not on a line; ``weights`` (n,) >= 0.
    """
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    H = (source - source_mean).T @ ((target - target_mean) * w[:, None])
    U, _, Vt = np.linalg.svd(H)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    R = Vt.T @ D @ U.T
    return transform(R, target_mean - R @ source_mean)


def slerp(both: Rotation, s: float) -> Rotation:
    """Return the rotation at the fraction ``s`` of the way between ``both`` (2), at constant angular velocity."""
    return Slerp([0.0, 1.0], both)(s)


class PosePath:
    """Poses as a function of time: positions on straight lines, orientations by slerp.

    Before the first and after the last pose it stands still; of two poses with the same stamp the first counts.
    """

    def __init__(self, poses: Sequence[Pose]) -> None:
        """Take one or more ``poses``, in any order."""
        stamps, first = np.unique(np.array([pose.stamp_ns for pose in poses], np.int64), return_index=True)
        self._start_ns = int(stamps[0])
        self._seconds = 1e-9 * (stamps - self._start_ns)
        self._positions = np.array([poses[i].position for i in first], float)
        self._turns = Rotation.from_quat([poses[i].orientation_xyzw for i in first])
        self._slerp = Slerp(self._seconds, self._turns) if len(stamps) > 1 else None

    def at(self, stamps_ns: ArrayLike, offset: float = 0.0) -> tuple[Array, Rotation]:
        """Return positions (n, 3) m and rotations (n) at ``stamps_ns`` (n,) + ``offset`` s."""
        t = np.clip(1e-9 * (np.asarray(stamps_ns) - self._start_ns) + offset, 0.0, self._seconds[-1])
        positions = np.column_stack([np.interp(t, self._seconds, column) for column in self._positions.T])
        if self._slerp is None:
            return positions, self._turns[np.zeros(len(t), np.int64)]
        return positions, self._slerp(t)
