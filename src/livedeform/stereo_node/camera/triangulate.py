"""Find the point of two pictures, whose rays meet or miss each other, its covariance as triangulated, and chi2."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.frames import inverse
from livedeform.common.types import Array
from livedeform.stereo_node.camera.lens import lens_of, to_pixel, to_ray
from livedeform.stereo_node.camera.rig import StereoRig

__all__ = ["Triangulated", "triangulate", "triangulate_missing"]


@dataclass(frozen=True)
class Triangulated:
    """Points (n, 3) m in the left frame, covariances (n, 3, 3) m2 from the pixel noise alone, chi-square (n,) with one
    degree of freedom each, and the rms distance (n,) px between seen and reprojected picture points."""

    points: Array
    covariances: Array
    chi2: Array
    reprojection_error_px: Array

    def take(self, rows: Any) -> Triangulated:
        """Return the points of these rows."""
        return Triangulated(
            self.points[rows], self.covariances[rows], self.chi2[rows], self.reprojection_error_px[rows]
        )

    def put(self, rows: Any, others: Triangulated) -> Triangulated:
        """Return the points with ``others`` in these rows."""
        mixed = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, values in mixed.items():
            values[rows] = getattr(others, name)
        return Triangulated(**mixed)


def triangulate(
    rig: StereoRig,
    left_px: Array,
    right_px: Array,
    left_cov: Array | None = None,
    right_cov: Array | None = None,
    sigma_px: float = 0.1,
    n_iterations: int = 4,
) -> Triangulated:
    """Find the point X that minimises sum over both pictures of (x - proj(X))^T S^-1 (x - proj(X)) (Hartley &
    Zisserman, ch. 12, in raw pixels, lens included), by Gauss-Newton from the linear solution; covariance (J^T S^-1
    J)^-1.

    ``left_px``, ``right_px`` (n, 2) raw pixels; their covariances (n, 2, 2) px2, ``sigma_px``^2 I where None. Pairs
    whose rays do not meet in front of the cameras give NaN.
    """
    default = np.broadcast_to(np.eye(2) * sigma_px**2, (len(left_px), 2, 2))
    return Triangulated(
        *_optimal(
            lens_of(rig.left),
            lens_of(rig.right),
            rig.T_right_left,
            np.ascontiguousarray(left_px, float),
            np.ascontiguousarray(right_px, float),
            np.linalg.inv(default if left_cov is None else left_cov),
            np.linalg.inv(default if right_cov is None else right_cov),
            n_iterations,
        )
    )


def triangulate_missing(
    rig: StereoRig, left_px: Array, right_px: Array, left_cov: Array, right_cov: Array
) -> Triangulated:
    """Find the points whose rays miss each other by more than noise, as refracted ones do.

    `triangulate` shares a miss out as if it were noise: by how sure each picture is, and along its covariance's long
    axis, which makes it a depth. The correction of refraction is of the point halfway between the rays. So that one is
    taken, and moved by as much of the miss as noise explains beside what all of them miss by (the best linear
    estimate); that is in the covariances. Where noise explains all of it this is `triangulate`, whose chi-square it is.
    """
    points = _halfways(
        lens_of(rig.left),
        lens_of(rig.right),
        rig.T_right_left,
        np.ascontiguousarray(left_px, float),
        np.ascontiguousarray(right_px, float),
    )
    left, right, J_left, J_right = rig.project(points)
    moves = _moves(rig, points, J_left, J_right)
    S = np.zeros((len(points), 4, 4))
    S[:, :2, :2], S[:, 2:, 2:] = left_cov, right_cov
    off = np.concatenate([left_px - left, right_px - right], axis=1)
    apart = _unit_null(np.concatenate([J_left, J_right], axis=1))
    miss, by_noise = (apart * off).sum(axis=1), np.einsum("ni,nij,nj->n", apart, S, apart)
    variance = by_noise + _common(miss, by_noise)
    together = np.einsum("nai,nij,nj->na", moves, S, apart)
    shift = -together * (miss / variance)[:, None]
    left, right, _, _ = rig.project(points + shift)
    square = ((left - left_px) ** 2).sum(axis=1) + ((right - right_px) ** 2).sum(axis=1)
    covariances = moves @ S @ np.swapaxes(moves, 1, 2) - _outer(together, together) / variance[:, None, None]
    return Triangulated(points + shift, covariances, miss**2 / by_noise, np.sqrt(square / 2))


def _moves(rig: StereoRig, points: Array, J_left: Array, J_right: Array) -> Array:
    """Return (n, 3, 4) m/px: how the point halfway between two rays moves with both pixels.

    Each ray moves across itself, J^T (J J^T)^-1; the point is where the squared distances from both are least.
    """
    across, out = np.zeros((len(points), 3, 3)), np.empty((len(points), 3, 4))
    for k, (eye, J) in enumerate(((np.zeros(3), J_left), (inverse(rig.T_right_left)[:3, 3], J_right))):
        u = (points - eye) / np.linalg.norm(points - eye, axis=1)[:, None]
        across += np.eye(3) - _outer(u, u)
        J_T = np.swapaxes(J, 1, 2)
        out[:, :, 2 * k : 2 * k + 2] = J_T @ np.linalg.inv(J @ J_T)
    return np.linalg.inv(across) @ out


def _common(miss: Array, by_noise: Array) -> Array:
    """Return (n,) px2: the variance of what the rays ``miss`` (n,) each other by beyond ``by_noise`` (n,), of all of
    them that meet before both cameras, the sharpest counting most, or the own one where that is more."""
    beyond = miss**2 - by_noise
    known = np.isfinite(beyond)
    weight = (by_noise[known].min(initial=np.inf) / by_noise[known]) ** 2
    common = float((weight * beyond[known]).sum() / weight.sum()) if known.any() else 0.0
    return np.asarray(np.maximum(beyond, max(common, 0.0)))


def _unit_null(J: Array) -> Array:
    """Return the unit vectors (n, 4) of pixels in which no point moves, of the derivatives ``J`` (n, 4, 3)."""
    out = np.stack([(-1) ** k * np.linalg.det(np.delete(J, k, axis=1)) for k in range(4)], axis=1)
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None])


def _outer(a: Array, b: Array) -> Array:
    """Return the products (n, i, j) of vectors (n, i) and (n, j)."""
    return np.asarray(a[:, :, None] * b[:, None])


@njit(cache=True, error_model="numpy")
def _halfways(left, right, T, left_px, right_px):
    """Apply ``_halfway`` to pixels (n, 2) of both pictures: points (n, 3)."""
    X = np.empty((len(left_px), 3))
    for i in range(len(left_px)):
        X[i, 0], X[i, 1], X[i, 2] = _halfway(left, right, T, left_px[i], right_px[i])
    return X


@njit(cache=True, error_model="numpy")
def _optimal(left, right, T, left_px, right_px, left_weight, right_weight, n_iterations):
    """Return points (n, 3), covariances (n, 3, 3), chi-square (n,) and rms (n,) px, from pixels (n, 2) and the inverses
    (n, 2, 2) of their covariances. ``left``, ``right``: lenses."""
    n, same = len(left_px), np.eye(4)
    X, C, chi2, rms = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n)
    H, g = np.empty((3, 3)), np.empty(3)
    for i in range(n):
        X[i, 0], X[i, 1], X[i, 2] = _halfway(left, right, T, left_px[i], right_px[i])
        stands = False
        for k in range(n_iterations + 1):
            H[:] = 0.0
            g[:] = 0.0
            cost, square = _add(left, same, X[i], left_px[i], left_weight[i], H, g)
            more_cost, more_square = _add(right, T, X[i], right_px[i], right_weight[i], H, g)
            _invert(H, C[i])
            if stands or k == n_iterations:
                break
            longest = 0.0
            for a in range(3):
                step = C[i, a, 0] * g[0] + C[i, a, 1] * g[1] + C[i, a, 2] * g[2]
                X[i, a] += step
                longest = max(longest, abs(step))
            stands = not longest > 1e-8  # m; the next step would be far smaller
        chi2[i] = cost + more_cost
        rms[i] = math.sqrt((square + more_square) / 2.0)
    return X, C, chi2, rms


@njit(cache=True, error_model="numpy")
def _halfway(left, right, T, left_px, right_px):
    """Return the point x, y, z halfway between the two rays' closest points.

    NaN where they do not meet in front of both cameras.
    """
    a = to_ray(left[0], left[1], left[2], left_px[0], left_px[1])
    b = to_ray(right[0], right[1], right[2], right_px[0], right_px[1])
    u, v, c = (a[0], a[1], 1.0), np.empty(3), np.empty(3)
    uu = uv = vv = uc = vc = 0.0
    for k in range(3):  # the right ray and the right camera's place in the left frame
        v[k] = T[0, k] * b[0] + T[1, k] * b[1] + T[2, k]
        c[k] = -(T[0, k] * T[0, 3] + T[1, k] * T[1, 3] + T[2, k] * T[2, 3])
        uu += u[k] * u[k]
        uv += u[k] * v[k]
        vv += v[k] * v[k]
        uc += u[k] * c[k]
        vc += v[k] * c[k]
    det = uu * vv - uv * uv
    s, r = (vv * uc - uv * vc) / det, (uv * uc - uu * vc) / det
    if not (s > 0.0 and r > 0.0):
        return math.nan, math.nan, math.nan
    return (
        0.5 * (u[0] * s + c[0] + v[0] * r),
        0.5 * (u[1] * s + c[1] + v[1] * r),
        0.5 * (u[2] * s + c[2] + v[2] * r),
    )


@njit(cache=True, error_model="numpy")
def _add(lens, T, X, seen, weight, H, g):
    """Add one picture's part to the normal equations of the point ``X`` (3,); returns r^T W r and r^T r, px2."""
    x = T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]
    y = T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]
    z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
    u, v, u_x, u_y, u_z, v_x, v_y, v_z = to_pixel(lens[0], lens[1], lens[2], x, y, z)
    e, f = seen[0] - u, seen[1] - v
    w, wx, wz = weight[0, 0], 0.5 * (weight[0, 1] + weight[1, 0]), weight[1, 1]
    for i in range(3):
        p = u_x * T[0, i] + u_y * T[1, i] + u_z * T[2, i]
        q = v_x * T[0, i] + v_y * T[1, i] + v_z * T[2, i]
        wp, wq = w * p + wx * q, wx * p + wz * q
        g[i] += wp * e + wq * f
        for j in range(3):
            H[i, j] += wp * (u_x * T[0, j] + u_y * T[1, j] + u_z * T[2, j])
            H[i, j] += wq * (v_x * T[0, j] + v_y * T[1, j] + v_z * T[2, j])
    return w * e * e + 2.0 * wx * e * f + wz * f * f, e * e + f * f


@njit(cache=True, error_model="numpy")
def _invert(A, out):
    """Invert a symmetric 3 x 3 matrix by its cofactors."""
    out[0, 0] = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    out[0, 1] = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    out[0, 2] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    out[1, 2] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = A[0, 0] * out[0, 0] + A[0, 1] * out[0, 1] + A[0, 2] * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= det
            out[j, i] = out[i, j]
