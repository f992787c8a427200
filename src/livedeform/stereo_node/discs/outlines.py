"""The picture of a disc's middle is not the middle of its picture: the disc from both outlines, and the correction.

A small flat patch with unit normal n at X, whose rim is X + B s^(1/2) (cos a, sin a) (B: two directions across n),
has to first order the outline p^T E^-1 p = 1 in a picture, E = J S J^T with S = B s B^T and J = d pixel / d X. For a
disc of radius r that is not stretched S = r^2 (I - n n^T); two pictures give six numbers for the three in m = r n.
Where n is known (``quadric``) they give the three in s, also of a disc that the body has stretched.

Perspective moves the middle of the outline (Heikkila 2000), and so does the curvature K of the body on which the disc
is painted: its rim lies t^T K t / 2 below its tangent plane. Both follow from the rim projected into the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.frames import apply
from livedeform.common.types import Array
from livedeform.stereo_node.camera.rig import StereoRig, project
from livedeform.stereo_node.discs.curvature import tangent_basis

OUTLINE_SIGMA = 0.012  # of E relative to its size: half a percent of the radius
N_RIM = 16
EYE = np.eye(3)
ROWS, COLS = np.array([0, 0, 1]), np.array([0, 1, 1])  # of the three numbers of a symmetric 2 x 2 matrix
ROUND_WEIGHT = 0.03  # of the prior that a disc is round, against an outline known to a percent


def neighbour_normals(points: Array, toward: Array, n_neighbours: int = 6) -> Array:
    """Return (n, 3) unit normals of planes through every point's neighbours, on the side of ``toward`` (3,).

    They only tell apart the two tilts that an outline allows, so they may be rough. Fewer than four points: towards
    the viewer.
    """
    ray = toward - points
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    if len(points) < 4:
        return ray
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = points[np.argsort(distance, axis=1)[:, : n_neighbours + 1]]
    near = near - near.mean(axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(near)
    normals = axes[:, 2]
    normals = normals * np.where((normals * ray).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return normals


def fit_discs(
    rig: StereoRig,
    points: Array,
    left_shapes: Array,
    right_shapes: Array,
    prior: Array,
    prior_sigma: float = 0.35,
    n_iterations: int = 8,
) -> Array:
    """Fit m = radius x normal (n, 3) m in the left frame of discs at ``points`` (n, 3), from their outlines in both
    pictures.

    ``left_shapes``, ``right_shapes`` (n, 2, 2) 1/px as ``Blobs.shapes``; ``prior`` (n, 3) unit normals, known to
    ``prior_sigma`` rad. The prior and its mirror image about the line of sight are tried, and the better one is kept.
    """
    _, _, J_left, J_right = rig.project(points)
    J = np.stack([J_left, J_right], axis=1)  # (n, 2 cameras, 2, 3)
    E = np.linalg.inv(np.stack([left_shapes @ left_shapes, right_shapes @ right_shapes], axis=1))
    size = np.trace(E, axis1=2, axis2=3)[:, :, None]
    outlines = _Outlines(J, E, size, prior, prior_sigma)
    focal = np.sqrt((J_left**2).sum(axis=(1, 2)) / 2)
    radius = np.sqrt(np.linalg.eigvalsh(E[:, 0])[:, 1]) / focal
    ray = points / np.linalg.norm(points, axis=1)[:, None]
    mirrored = 2 * (prior * ray).sum(axis=1)[:, None] * ray - prior
    best, best_cost = _fit(outlines, prior * radius[:, None], n_iterations)
    other, other_cost = _fit(outlines, mirrored * radius[:, None], n_iterations)
    return np.where((other_cost < best_cost)[:, None], other, best)


@dataclass(frozen=True)
class _Outlines:
    """The equations for discs m = radius x normal from their outlines.

    ``E`` (n, 2 cameras, 2, 2) px2 with ``size`` (n, 2, 1) px2, the points' derivatives ``J`` (n, 2, 2, 3) px/m, and
    ``prior`` normals (n, 3) known to ``prior_sigma`` rad.
    """

    J: Array
    E: Array
    size: Array
    prior: Array
    prior_sigma: float

    def residual(self, m: Array) -> tuple[Array, Array]:
        """Return the six outline numbers and three of the prior (n, 9), in sigmas, and |m| (n, 1)."""
        length = np.linalg.norm(m, axis=1)[:, None]
        S = (m * m).sum(axis=1)[:, None, None] * EYE - m[:, :, None] * m[:, None, :]
        out = (self.E - self.J @ S[:, None] @ np.swapaxes(self.J, 2, 3))[:, :, ROWS, COLS] / (OUTLINE_SIGMA * self.size)
        from_prior = (self.prior - m / length) / self.prior_sigma
        return np.concatenate([out.reshape(len(m), 6), from_prior], axis=1), length

    def derivative(self, m: Array, length: Array) -> Array:
        """Return the negative derivative (n, 9, 3) of the residual."""
        D = np.empty((len(m), 9, 3))
        for k in range(3):
            dS = (
                2 * m[:, k, None, None] * EYE
                - EYE[k][None, :, None] * m[:, None, :]
                - m[:, :, None] * EYE[k][None, None]
            )
            dE = self.J @ dS[:, None] @ np.swapaxes(self.J, 2, 3)
            D[:, :6, k] = (dE[:, :, ROWS, COLS] / (OUTLINE_SIGMA * self.size)).reshape(len(m), 6)
        n = m / length
        D[:, 6:] = (EYE - n[:, :, None] * n[:, None, :]) / (length[:, :, None] * self.prior_sigma)
        return D


def _fit(outlines: _Outlines, m: Array, n_iterations: int) -> tuple[Array, Array]:
    """Fit by damped Gauss-Newton on the six outline numbers and the prior; returns m (n, 3) and the cost (n,)."""
    r, length = outlines.residual(m)
    cost = (r**2).sum(axis=1)
    damping = np.full(len(m), 1e-3)
    for _ in range(n_iterations):
        D = outlines.derivative(m, length)
        H = np.swapaxes(D, 1, 2) @ D
        H = H + damping[:, None, None] * (H * EYE) + 1e-9 * H.trace(axis1=1, axis2=2)[:, None, None] * EYE
        trial = m + np.linalg.solve(H, np.swapaxes(D, 1, 2) @ r[:, :, None])[:, :, 0]
        new_r, new_length = outlines.residual(trial)
        new_cost = (new_r**2).sum(axis=1)
        better = new_cost < cost
        m = np.where(better[:, None], trial, m)
        r = np.where(better[:, None], new_r, r)
        length = np.where(better[:, None], new_length, length)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10)
    return m, cost


def stretched_discs(rig: StereoRig, points: Array, left_shapes: Array, right_shapes: Array, normals: Array) -> Array:
    """Fit the half axes (n, 3, 2) m of discs at ``points`` (n, 3) with ``normals`` (n, 3), by least squares on both
    outlines.

    The rim is points + axes @ (cos a, sin a); ``left_shapes``, ``right_shapes`` (n, 2, 2) 1/px as ``Blobs.shapes``.
    """
    _, _, J_left, J_right = rig.project(points)
    B = tangent_basis(normals)
    A, b = [], []
    for J, shape in ((J_left, left_shapes), (J_right, right_shapes)):
        G = J @ B
        E = np.linalg.inv(shape @ shape)
        size = np.trace(E, axis1=1, axis2=2)[:, None]
        for p, q in zip(ROWS, COLS, strict=True):
            terms = (
                G[:, p, 0] * G[:, q, 0],
                G[:, p, 0] * G[:, q, 1] + G[:, p, 1] * G[:, q, 0],
                G[:, p, 1] * G[:, q, 1],
            )
            A.append(np.stack(terms, axis=1) / size)
            b.append(E[:, p, q] / size[:, 0])
    M, v = np.stack(A, axis=1), np.stack(b, axis=1)
    # a disc seen edge-on shows nothing of one axis: the prior is that it is round
    scale = np.abs(M).max(axis=(1, 2))[:, None]
    round_ = ROUND_WEIGHT * scale[:, :, None] * np.array([[[1.0, 0.0, -1.0], [0.0, 2.0, 0.0]]])
    M, v = np.concatenate([M, round_], axis=1), np.concatenate([v, np.zeros((len(v), 2))], axis=1)
    Mt = np.swapaxes(M, 1, 2)
    s = np.linalg.solve(Mt @ M, Mt @ v[:, :, None])[:, :, 0]
    values, axes = np.linalg.eigh(s[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    least = 0.05 * np.abs(values).max(axis=1)[:, None]
    return np.asarray(B @ (axes * np.sqrt(np.maximum(values, least))[:, None, :]))


def rim_bias(rig: StereoRig, points: Array, axes: Array, normals: Array, curvatures: Array) -> tuple[Array, Array]:
    """Return the outline's middle minus the middle's picture (n, 2) px, left and right.

    The discs with half ``axes`` (n, 3, 2) m are painted on a surface with ``curvatures`` (n, 3, 3) 1/m.
    """
    angle = 2 * np.pi * np.arange(N_RIM) / N_RIM
    across = axes @ np.stack([np.cos(angle), np.sin(angle)])  # (n, 3, k)
    below = 0.5 * np.einsum("nik,nij,njk->nk", across, curvatures, across)
    rim = points[:, :, None] + across - normals[:, :, None] * below[:, None, :]
    rim = np.swapaxes(rim, 1, 2).reshape(-1, 3)
    outlines = (project(rig.left, rim)[0], project(rig.right, apply(rig.T_right_left, rim))[0])
    middles = (project(rig.left, points)[0], project(rig.right, apply(rig.T_right_left, points))[0])
    left, right = (
        area_centre(outline.reshape(len(points), N_RIM, 2) - middle[:, None])
        for outline, middle in zip(outlines, middles, strict=True)
    )
    return left, right


def area_centre(polygon: Array) -> Array:
    """Return the centres (n, 2) of the areas of polygons (n, k, 2)."""
    after = np.roll(polygon, -1, axis=1)
    cross = polygon[:, :, 0] * after[:, :, 1] - polygon[:, :, 1] * after[:, :, 0]
    return np.asarray(((polygon + after) * cross[:, :, None]).sum(axis=1) / (3 * cross.sum(axis=1))[:, None])
