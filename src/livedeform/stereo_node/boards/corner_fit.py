"""Sub-pixel checkerboard corners: two blurred edges that cross, fitted to the grey values around every corner.

    I(p) = m + g . (p - c) + a E(d1) E(d2),   E(d) = erf(d / (sqrt(2) s)),   d_i = -(u - x) sin(t_i) + (v - y) cos(t_i)

Nine parameters: corner x, y, edge directions t1, t2, blur s, mean m, gradient g (2), amplitude a. All corners of a
picture are fitted together as arrays, by Levenberg-Marquardt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from livedeform.common.types import Array
from livedeform.stereo_node.detect.picture import Picture

N_ITERATIONS = 25
SETTLED = 2e-5  # px, a step after which a corner is left where it is
REACH = 0.42  # of the distance to the next corner: how far around a corner pixels take part


@dataclass(frozen=True)
class _Patches:
    """The pixels around every corner: columns ``u``, rows ``v``, ``grey`` values and weights, (n, pixels) each; and the
    corners' first places ``start`` (n, 2)."""

    u: Array
    v: Array
    grey: Array
    weight: Array
    start: Array

    def of(self, rows: NDArray[Any]) -> _Patches:
        """Return the patches of some corners, by number or flag."""
        return _Patches(self.u[rows], self.v[rows], self.grey[rows], self.weight[rows], self.start[rows])

    def cost(self, p: Array) -> tuple[Array, Array, Array]:
        """Return the weighted sum of squares (n,), residual (n, pixels) and derivative (n, pixels, 9) at parameters
        ``p``."""
        r, J = _equations(p, self.u, self.v, self.grey, self.start)
        return (self.weight * r**2).sum(axis=1), r, J


def fit_corners(picture: Picture, corners: Array, first: Array, second: Array, spacing: Array) -> tuple[Array, Array]:
    """Return the corners (n, 2) px that fit best and their covariances (n, 2, 2).

    A corner that runs away stays where it was (NaN covariance). ``first``, ``second`` (n,) rad: directions of the two
    edges; ``spacing`` (n,) px to the next corner.
    """
    patches = _cut_out(picture, corners, spacing)
    p, cost, H = _descend(_start(patches, first, second), patches)
    sigma2 = cost / np.maximum(patches.weight.sum(axis=1) - 9, 1)
    covariance = np.linalg.pinv(H, hermitian=True)[:, :2, :2] * sigma2[:, None, None]
    lost = np.linalg.norm(p[:, :2] - corners, axis=1) > np.maximum(0.2 * spacing, 1.5)
    covariance[lost] = np.nan
    return np.where(lost[:, None], corners, p[:, :2]), covariance


def _cut_out(picture: Picture, corners: Array, spacing: Array) -> _Patches:
    half = int(np.clip(np.median(spacing) * REACH, 3, 12))
    h, w = picture.shape
    centre = np.round(corners).astype(int)
    du, dv = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1))
    columns = np.clip(centre[:, :1] + du.ravel(), 0, w - 1)
    rows = np.clip(centre[:, 1:] + dv.ravel(), 0, h - 1)
    u, v = columns.astype(float), rows.astype(float)
    reach = np.minimum(spacing[:, None] * REACH, half + 0.5)
    weight = (np.hypot(u - corners[:, :1], v - corners[:, 1:]) <= reach).astype(float)
    return _Patches(u, v, picture[rows, columns].astype(float), weight, corners)


def _start(patches: _Patches, first: Array, second: Array) -> Array:
    """Start (n, 9) from the greys' mean and spread, with the sign of the amplitude that fits better."""
    grey, weight = patches.grey, patches.weight
    spread = np.sqrt((weight * (grey - grey.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) / weight.sum(axis=1))
    p = np.zeros((len(grey), 9))
    p[:, :2], p[:, 2], p[:, 3], p[:, 4] = patches.start, first, second, 1.0
    p[:, 5] = (weight * grey).sum(axis=1) / weight.sum(axis=1)
    p[:, 8] = spread
    residual_plus = patches.cost(p)[0]
    p[:, 8] = -spread
    residual_minus = patches.cost(p)[0]
    p[:, 8] = np.where(residual_minus < residual_plus, -spread, spread)
    return p


def _descend(p: Array, patches: _Patches) -> tuple[Array, Array, Array]:
    """Descend by Levenberg-Marquardt on all corners at once, each until it rests: parameters (n, 9), cost (n,) and
    normal matrix (n, 9, 9)."""
    out_p, out_cost, out_H = p.copy(), np.empty(len(p)), np.empty((len(p), 9, 9))
    moving, damping = np.arange(len(p)), np.full(len(p), 1e-3)
    cost, H, g = _normal(p, patches)
    for iteration in range(N_ITERATIONS + 1):
        out_p[moving], out_cost[moving], out_H[moving] = p, cost, H
        if iteration == N_ITERATIONS or not len(moving):
            break
        d = np.sqrt(np.maximum(np.einsum("nii->ni", H), 1e-12))
        A = H / d[:, :, None] / d[:, None] + damping[:, None, None] * np.eye(9)
        step = np.linalg.solve(A, (g / d)[:, :, None])[:, :, 0] / d
        trial = p + step
        trial[:, 4] = np.clip(trial[:, 4], 0.3, 5.0)
        cost_new, H_new, g_new = _normal(trial, patches)
        better = cost_new < cost
        for value, new in ((p, trial), (cost, cost_new), (H, H_new), (g, g_new)):
            value[better] = new[better]
        rests = ~(np.abs(step[:, :2]).max(axis=1) > SETTLED) & ((damping <= 1) | ~better)
        damping = np.where(better, damping * 0.2, np.minimum(damping * 10, 1e3))
        if rests.any():
            out_p[moving], out_cost[moving], out_H[moving] = p, cost, H
            on = ~rests
            moving, damping, patches = moving[on], damping[on], patches.of(on)
            p, cost, H, g = p[on], cost[on], H[on], g[on]
    return out_p, out_cost, out_H


def _normal(p: Array, patches: _Patches) -> tuple[Array, Array, Array]:
    """Return the cost (n,), normal matrix (n, 9, 9) and its right side (n, 9) at parameters ``p``."""
    cost, r, J = patches.cost(p)
    weighted = np.swapaxes(J * patches.weight[:, :, None], 1, 2)
    return cost, weighted @ J, (weighted @ r[:, :, None])[:, :, 0]


def _equations(p: Array, u: Array, v: Array, grey: Array, start: Array) -> tuple[Array, Array]:
    """Return residual (n, pixels) and the model's derivative (n, pixels, 9)."""
    x, y, t1, t2, s, m, gx, gy, a = (p[:, k : k + 1] for k in range(9))
    du, dv = u - x, v - y
    edges = []
    for t in (t1, t2):
        sin, cos = np.sin(t), np.cos(t)
        d = -du * sin + dv * cos
        value = erf(d / (np.sqrt(2) * s))
        slope = 2 / (np.sqrt(2 * np.pi) * s) * np.exp(-0.5 * (d / s) ** 2)
        edges.append((value, slope * sin, -slope * cos, slope * (-du * cos - dv * sin), -slope * d / s))
    (e1, e1x, e1y, e1t, e1s), (e2, e2x, e2y, e2t, e2s) = edges
    fu, fv = u - start[:, :1], v - start[:, 1:]
    r = grey - (m + gx * fu + gy * fv + a * e1 * e2)
    one = np.ones_like(r)
    J = np.stack(
        [
            a * (e1x * e2 + e1 * e2x), a * (e1y * e2 + e1 * e2y), a * e1t * e2, a * e1 * e2t,
            a * (e1s * e2 + e1 * e2s), one, fu, fv, e1 * e2,
        ],
        axis=2,
    )  # fmt: skip
    return r, J
