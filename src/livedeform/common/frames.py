"""Rigid transforms T_target_source as 4 x 4 matrices, and the best rigid fit of two point sets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, Pose

NO_ROTATION = "a pose is not finite or has the quaternion zero"


def pose_matrix(pose: Pose) -> Array:
    """T_target_source (4, 4) of a pose; the quaternion is normalised."""
    return transform(Rotation.from_quat(pose.orientation_xyzw).as_matrix(), pose.position)


def unit_pose(stamp_ns: int, position: Sequence[float], orientation_xyzw: Sequence[float]) -> Pose:
    """The pose with its quaternion normalised; ``RecordingError`` for one that is not finite or no rotation."""
    quaternion = np.array(orientation_xyzw, float)
    norm = float(np.linalg.norm(quaternion))
    if not np.isfinite(position).all() or not np.isfinite(norm) or norm < 1e-6:
        raise RecordingError(
            NO_ROTATION,
            remedy="publish position in metres and a unit quaternion x, y, z, w",
        )
    return Pose(stamp_ns, np.array(position, float), quaternion / norm)


def transform(rotation: Array, translation: Array) -> Array:
    """(4, 4) from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def matrix_pose(T: Array, stamp_ns: int = 0) -> Pose:
    """The pose of a (4, 4) transform."""
    return Pose(stamp_ns, T[:3, 3].copy(), Rotation.from_matrix(T[:3, :3]).as_quat())


def apply(T: Array, points: Array) -> Array:
    """``points`` (n, 3) in the source frame, as seen in the target frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def inverse(T: Array) -> Array:
    """T_source_target of T_target_source."""
    R = T[:3, :3].T
    return transform(R, -R @ T[:3, 3])


def fit_rigid(source: Array, target: Array, weights: Array | None = None) -> Array:
    """T_target_source (4, 4) that minimises sum_i w_i |target_i - T source_i|^2 (Kabsch 1976; Umeyama 1991).

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
