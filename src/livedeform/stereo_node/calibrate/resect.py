"""A camera from points at known places: the lens and the pose from one picture (direct linear transform, then least
squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from livedeform.common.errors import CalibrationError
from livedeform.common.frames import inverse, transform
from livedeform.common.types import Array
from livedeform.stereo_node.calibrate.bundle import FREE, Lens
from livedeform.stereo_node.camera.rig import StereoRig, make_rig


@dataclass(frozen=True)
class Resection:
    """The pose ``T_camera_object`` (4, 4) and the lens that fit known points best; ``residuals`` (n, 2) px."""

    lens: Lens
    T_camera_object: Array
    residuals: Array
    model: str


def resect(points: Array, pixels: Array, model: str = "k1k2") -> Resection:
    """Fit lens and pose of the camera that sees ``points`` (n, 3) m at ``pixels`` (n, 2); the points must not lie in
    one plane."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) < 8 or spread[2] < 1e-3 * spread[0]:
        raise CalibrationError(
            f"{len(points)} points in or near one plane do not give a camera",
            where="known points",
            remedy="use points of different depth",
        )
    free = list(FREE[model])

    def lens_of(p: Array) -> Lens:
        coefficients = np.zeros(8)
        coefficients[free] = p[10:]
        return Lens(p[6:10], coefficients)

    def project(p: Array) -> tuple[Array, Array]:
        lens = lens_of(p)
        seen, J = cv2.projectPoints(points, p[:3], p[3:6], lens.matrix, lens.coefficients)
        return np.asarray(seen, float).reshape(-1, 2), np.asarray(J, float)[:, [*range(10), *(10 + i for i in free)]]

    R, t, intrinsics = _direct(points, pixels)
    start = np.concatenate([Rotation.from_matrix(R).as_rotvec(), t, intrinsics, np.zeros(len(free))])
    fit = least_squares(
        lambda p: (project(p)[0] - pixels).ravel(), start, jac=lambda p: project(p)[1], x_scale="jac", max_nfev=200
    )
    T = transform(Rotation.from_rotvec(fit.x[:3]).as_matrix(), fit.x[3:6])
    return Resection(lens_of(fit.x), T, -fit.fun.reshape(-1, 2), model)


def _direct(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Solve the direct linear transform (Hartley & Zisserman, 7.1) with normalised coordinates: R, t and fx, fy, cx,
    cy."""
    centre, size = points.mean(axis=0), np.std(points) * np.sqrt(3)
    middle, spread = pixels.mean(axis=0), np.std(pixels) * np.sqrt(2)
    X = np.hstack([(points - centre) / size, np.ones((len(points), 1))])
    u, v = ((pixels - middle) / spread).T
    zero = np.zeros_like(X)
    A = np.concatenate([np.hstack([X, zero, -u[:, None] * X]), np.hstack([zero, X, -v[:, None] * X])])
    M = np.linalg.svd(A)[2][-1].reshape(3, 4)
    S = transform(np.eye(3) / size, -centre / size)
    P = np.array([[spread, 0, middle[0]], [0, spread, middle[1]], [0, 0, 1]]) @ M @ S
    P = P / np.linalg.norm(P[2, :3])
    if (P[2, :3] @ points.T + P[2, 3]).mean() < 0:
        P = -P
    K, R = _rq(P[:, :3])
    t = np.linalg.solve(K, P[:, 3])
    K = K / K[2, 2]
    return R, t, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])


def _rq(M: Array) -> tuple[Array, Array]:
    """Decompose M = K R with K upper triangular, its diagonal positive, and R a rotation."""
    flip = np.eye(3)[::-1]
    Q, U = np.linalg.qr((flip @ M).T)
    K, R = flip @ U.T @ flip, flip @ Q.T
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    return (K, R) if np.linalg.det(R) > 0 else (K @ np.diag([1.0, 1.0, 1.0]), -R)


def resected_rig(left: Resection, right: Resection, size: tuple[int, int]) -> tuple[StereoRig, Array]:
    """Return the rig of two resected cameras of pictures of ``size`` (width, height), and T_object_left."""
    ros = "rational_polynomial" if left.model == "rational" else "plumb_bob"
    n = 8 if left.model == "rational" else 5
    cameras = [
        (name, *size, r.lens.matrix, r.lens.coefficients[:n].copy(), ros)
        for name, r in (("left", left), ("right", right))
    ]
    rig = make_rig(cameras[0], cameras[1], right.T_camera_object @ inverse(left.T_camera_object))
    return rig, inverse(left.T_camera_object)
