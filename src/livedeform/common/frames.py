"""Rigid transforms T_target_source as 4 x 4 matrices, poses in between, and the best rigid fit of two point sets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, Pose

__all__ = [
    "PosePath",
    "apply",
    "fit_misplaced",
    "fit_rigid",
    "fit_rigid_by_noise",
    "increment_jacobian",
    "inverse",
    "make_a_frame",
    "matrix_pose",
    "pose_matrix",
    "slerp",
    "transform",
    "unit_pose",
]

MAKE_A_FRAME = 3  # points, if they are not in one line
ON_A_LINE = 0.02  # of the spread along a line, beside it: a turn about it is as uncertain as 50 misfits
LEAST_NOISE = 1e-7  # m: a tracker may say that it knows a place exactly
ODD_NORM = 0.01  # by which a quaternion's norm may differ from 1: some robots write three digits
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


def odd_norms(orientations_xyzw: Array) -> int:
    """Count quaternions (n, 4) that are a rotation only once they are normalised: angles, or a part is missing."""
    with np.errstate(all="ignore"):
        return int((np.abs(np.sqrt((orientations_xyzw**2).sum(axis=1)) - 1.0) > ODD_NORM).sum())


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


def make_a_frame(points: Array) -> bool:
    """Tell whether ``points`` (n, 3) leave no turn open: three or more, and not on a line."""
    if len(points) < MAKE_A_FRAME:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > ON_A_LINE * spread[0])


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


def fit_rigid_by_noise(source: Array, covariances: Array, target: Array, T: Array, misplaced: float) -> Array:
    """Find T_target_source (4, 4), from ``T``, that minimises sum_i e_i^T (R S_i R^T + misplaced^2 I)^-1 e_i with e_i =
    target_i - T source_i: ``source`` (n, 3) m has the ``covariances`` S_i (n, 3, 3) m2, and ``target`` (n, 3) m is
    known to ``misplaced`` m (Gauss-Newton)."""
    for _ in range(5):
        R = T[:3, :3]
        W = np.linalg.inv(R @ covariances @ R.T + np.eye(3) * misplaced**2)
        placed = apply(T, source)
        middle = placed.mean(axis=0)
        J = increment_jacobian(placed - middle)
        JtW = np.swapaxes(J, 1, 2) @ W
        step = np.linalg.lstsq(
            (JtW @ J).sum(axis=0), (JtW @ (target - placed)[:, :, None]).sum(axis=0)[:, 0], rcond=1e-12
        )[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        T = transform(turn @ T[:3, :3], turn @ (T[:3, 3] - middle) + middle + step[3:])
        if np.abs(step).max() < 1e-10:
            break
    return T


def fit_misplaced(source: Array, covariances: Array, target: Array, T: Array) -> Array:
    """Find T_target_source (4, 4) by `fit_rigid_by_noise` where the ``target`` lies off its places by more than the
    noise of the ``source``, as its residuals show."""
    misplaced = 0.0
    for _ in range(3):
        T = fit_rigid_by_noise(source, covariances, target, T, max(misplaced, LEAST_NOISE))
        residual = target - apply(T, source)
        noise = np.maximum(np.trace(covariances, axis1=1, axis2=2), 3.0 * LEAST_NOISE**2)
        # the median: one point in a wrong place must not make all others count alike
        ratio = np.median((residual**2).sum(axis=1) / noise)
        misplaced = float(np.sqrt(np.median(noise) / 3 * max(ratio - 1.0, 0.0)))
    return T


def increment_jacobian(arms: Array) -> Array:
    """Return d(R x + t)/d(rotation vector, translation) (n, 3, 6) for points at ``arms`` (n, 3) m from the turning
    centre."""
    J = np.zeros((len(arms), 3, 6))
    x, y, z = arms.T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, 3:] = np.eye(3)
    return J


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
