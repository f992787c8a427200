"""Points from two pictures: the maximum-likelihood point, its covariance and its chi-square."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from livedeform_common.types import Array
from stereo_node.camera import StereoRig, undistort


@dataclass(frozen=True)
class Triangulated:
    """Points (n, 3) m in the left frame, covariances (n, 3, 3) m2 from the pixel noise alone, chi-square (n,) with one
    degree of freedom each, and the rms distance (n,) px between seen and reprojected picture points."""

    points: Array
    covariances: Array
    chi2: Array
    reprojection_error_px: Array

    def take(self, rows: Any) -> Triangulated:
        """The points of these rows."""
        return Triangulated(
            self.points[rows], self.covariances[rows], self.chi2[rows], self.reprojection_error_px[rows]
        )


def triangulate(
    rig: StereoRig,
    left_px: Array,
    right_px: Array,
    left_cov: Array | None = None,
    right_cov: Array | None = None,
    sigma_px: float = 0.1,
    n_iterations: int = 4,
) -> Triangulated:
    """The point X that minimises sum over both pictures of (x - proj(X))^T S^-1 (x - proj(X)) (Hartley & Zisserman,
    ch. 12, in raw pixels, lens included), by Gauss-Newton from the linear solution; covariance (J^T S^-1 J)^-1.

    ``left_px``, ``right_px`` (n, 2) raw pixels; their covariances (n, 2, 2) px2, ``sigma_px``^2 I where None. Pairs
    whose rays do not meet in front of the cameras give NaN.
    """
    n = len(left_px)
    if n == 0:
        return Triangulated(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0))
    default = np.broadcast_to(np.eye(2) * sigma_px**2, (n, 2, 2))
    W = np.zeros((n, 4, 4))
    W[:, :2, :2] = np.linalg.inv(default if left_cov is None else left_cov)
    W[:, 2:, 2:] = np.linalg.inv(default if right_cov is None else right_cov)
    X = linear_points(rig, left_px, right_px)
    seen = np.hstack([left_px, right_px])
    for _ in range(n_iterations):
        r, J = _residual(rig, X, seen)
        JtW = np.swapaxes(J, 1, 2) @ W
        step = _solve(JtW @ J, (JtW @ r[:, :, None])[:, :, 0])
        X = X + step
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-8:  # m; the next step would be far smaller
            break
    r, J = _residual(rig, X, seen)
    covariances = _inverse(np.swapaxes(J, 1, 2) @ W @ J)
    chi2 = np.einsum("ni,nij,nj->n", r, W, r)
    return Triangulated(X, covariances, chi2, np.sqrt((r**2).sum(axis=1) / 2))


def linear_points(rig: StereoRig, left_px: Array, right_px: Array) -> Array:
    """The points (n, 3) halfway between the two rays' closest points: the start of the optimal solution."""
    a, _ = undistort(rig.left, left_px)
    b, _ = undistort(rig.right, right_px)
    R, t = rig.T_right_left[:3, :3], rig.T_right_left[:3, 3]
    u = np.hstack([a, np.ones((len(a), 1))])
    v = np.hstack([b, np.ones((len(b), 1))]) @ R  # right rays in the left frame
    c = -R.T @ t
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    det = uu * vv - uv**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (vv * (u @ c) - uv * (v @ c)) / det
        r = (uv * (u @ c) - uu * (v @ c)) / det
    X = 0.5 * (u * s[:, None] + c + v * r[:, None])
    X[~((s > 0) & (r > 0))] = np.nan
    return X


def _residual(rig: StereoRig, X: Array, seen: Array) -> tuple[Array, Array]:
    left, right, J_left, J_right = rig.project(X)
    return seen - np.hstack([left, right]), np.concatenate([J_left, J_right], axis=1)


def _solve(A: Array, b: Array) -> Array:
    good = np.isfinite(A).all(axis=(1, 2)) & np.isfinite(b).all(axis=1)
    out = np.full_like(b, np.nan)
    out[good] = np.linalg.solve(A[good], b[good][:, :, None])[:, :, 0]
    return out


def _inverse(A: Array) -> Array:
    good = np.isfinite(A).all(axis=(1, 2))
    out = np.full_like(A, np.nan)
    out[good] = np.linalg.inv(A[good])
    return out
