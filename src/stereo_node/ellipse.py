"""The picture of a disc's centre is not the centre of its picture: the disc's tilt from both outlines, and the
correction.

A disc of radius a and unit normal n at X is the set X + S^(1/2) (ball's projection), S = a^2 (I - n n^T). To first
order its outline in a picture is p^T E^-1 p = 1 with E = J S J^T, J = d pixel / d X; two pictures give six numbers
for the three in m = a n. The exact centre of the outline in ideal coordinates is the pole of the line at infinity
(dual conic of the circle; Hartley & Zisserman 8.3; Heikkila 2000):

    centre ~ X X_z - a^2 (e_z - n n_z).
"""

from __future__ import annotations

import numpy as np

from livedeform_common.frames import apply
from livedeform_common.types import Array, CameraCalibration
from stereo_node.camera import StereoRig, distort, project

OUTLINE_SIGMA = 0.012  # of E relative to its size: half a percent of the radius
N_OUTLINE = 8


def neighbour_normals(points: Array, toward: Array, n_neighbours: int = 6) -> Array:
    """(n, 3) unit normals of planes through every point's neighbours, on the side of ``toward`` (3,).

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
    start: Array | None = None,
    prior_sigma: float = 0.35,
    n_iterations: int = 8,
) -> Array:
    """m = radius x normal (n, 3) m in the left frame of discs at ``points`` (n, 3), from their outlines in both
    pictures.

    ``left_shapes``, ``right_shapes`` (n, 2, 2) 1/px as ``Blobs.shapes``; ``prior`` (n, 3) unit normals, known to
    ``prior_sigma`` rad. Without ``start`` the prior and its mirror image about the line of sight are tried, and the
    better one is kept.
    """
    _, _, J_left, J_right = rig.project(points)
    J = np.stack([J_left, J_right], axis=1)  # (n, 2 cameras, 2, 3)
    E = np.linalg.inv(np.stack([left_shapes @ left_shapes, right_shapes @ right_shapes], axis=1))
    size = np.trace(E, axis1=2, axis2=3)[:, :, None]
    if start is not None:
        return _fit(J, E, size, prior, start, prior_sigma, n_iterations)[0]
    focal = np.sqrt((J_left**2).sum(axis=(1, 2)) / 2)
    radius = np.sqrt(np.linalg.eigvalsh(E[:, 0])[:, 1]) / focal
    ray = points / np.linalg.norm(points, axis=1)[:, None]
    mirrored = 2 * (prior * ray).sum(axis=1)[:, None] * ray - prior
    best, best_cost = _fit(J, E, size, prior, prior * radius[:, None], prior_sigma, n_iterations)
    other, other_cost = _fit(J, E, size, prior, mirrored * radius[:, None], prior_sigma, n_iterations)
    return np.where((other_cost < best_cost)[:, None], other, best)


def _fit(
    J: Array, E: Array, size: Array, prior: Array, m: Array, prior_sigma: float, n_iterations: int
) -> tuple[Array, Array]:
    """Damped Gauss-Newton on the six outline numbers and the prior; returns m (n, 3) and the cost (n,)."""
    eye = np.eye(3)
    rows, cols = np.array([0, 0, 1]), np.array([0, 1, 1])

    def residual(m: Array) -> tuple[Array, Array]:
        length = np.linalg.norm(m, axis=1)[:, None]
        S = (m * m).sum(axis=1)[:, None, None] * eye - m[:, :, None] * m[:, None, :]
        out = (E - J @ S[:, None] @ np.swapaxes(J, 2, 3))[:, :, rows, cols] / (OUTLINE_SIGMA * size)
        from_prior = (prior - m / length) / prior_sigma
        return np.concatenate([out.reshape(len(m), 6), from_prior], axis=1), length

    r, length = residual(m)
    cost = (r**2).sum(axis=1)
    damping = np.full(len(m), 1e-3)
    for _ in range(n_iterations):
        D = np.empty((len(m), 9, 3))
        for k in range(3):
            dS = (
                2 * m[:, k, None, None] * eye
                - eye[k][None, :, None] * m[:, None, :]
                - m[:, :, None] * eye[k][None, None]
            )
            dE = J @ dS[:, None] @ np.swapaxes(J, 2, 3)
            D[:, :6, k] = (dE[:, :, rows, cols] / (OUTLINE_SIGMA * size)).reshape(len(m), 6)
        n = m / length
        D[:, 6:] = (eye - n[:, :, None] * n[:, None, :]) / (length[:, :, None] * prior_sigma)
        H = np.swapaxes(D, 1, 2) @ D
        H = H + damping[:, None, None] * (H * eye) + 1e-9 * H.trace(axis1=1, axis2=2)[:, None, None] * eye
        trial = m + np.linalg.solve(H, np.swapaxes(D, 1, 2) @ r[:, :, None])[:, :, 0]
        new_r, new_length = residual(trial)
        new_cost = (new_r**2).sum(axis=1)
        better = new_cost < cost
        m = np.where(better[:, None], trial, m)
        r = np.where(better[:, None], new_r, r)
        length = np.where(better[:, None], new_length, length)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10)
    return m, cost


def centre_bias(rig: StereoRig, points: Array, discs: Array) -> tuple[Array, Array]:
    """Outline's centre minus the centre's picture (n, 2) px, left and right, for discs ``discs`` = radius x normal
    (n, 3).
    """
    T = rig.T_right_left
    left = _bias(rig.left, points, discs)
    right = _bias(rig.right, apply(T, points), discs @ T[:3, :3].T)
    return left, right


def _bias(camera: CameraCalibration, points: Array, discs: Array) -> Array:
    """The centre in ideal coordinates is exact; the lens then moves it as it moves the mean of the outline."""
    a2 = (discs**2).sum(axis=1)[:, None]
    e_z = np.array([0.0, 0.0, 1.0])
    centre = points * points[:, 2:] - (a2 * e_z - discs * discs[:, 2:])
    ideal = centre[:, :2] / centre[:, 2:]
    true_px, _ = project(camera, points)
    # the outline in ideal coordinates, as an ellipse around its centre: columns of the root of J S J^T
    z = points[:, 2]
    d_ideal = np.zeros((len(points), 2, 3))
    d_ideal[:, 0, 0] = d_ideal[:, 1, 1] = 1 / z
    d_ideal[:, :, 2] = -points[:, :2] / z[:, None] ** 2
    S = a2[:, :, None] * np.eye(3) - discs[:, :, None] * discs[:, None, :]
    values, axes = np.linalg.eigh(d_ideal @ S @ np.swapaxes(d_ideal, 1, 2))
    root = axes * np.sqrt(np.maximum(values, 0))[:, None, :]
    angle = 2 * np.pi * np.arange(N_OUTLINE) / N_OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)])  # (2, k)
    outline = ideal[:, None, :] + np.swapaxes(root @ circle, 1, 2)
    bent, _ = distort(camera, outline.reshape(-1, 2))
    mean = bent.reshape(len(points), N_OUTLINE, 2).mean(axis=1)
    return mean @ camera.camera_matrix[:2, :2].T + camera.camera_matrix[:2, 2] - true_px
