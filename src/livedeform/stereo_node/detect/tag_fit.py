"""Middles of square tags from lines fitted to their four sides: where the black border meets the white around it.

Corners alone are poor: a corner is one place, blurred, and where the tag is small its neighbours pull it. A side is a
hundred pixels of the same step. Its place in every profile across it is where the step's area puts it,

    t = t_out - sum (I - I_in) dt / (I_out - I_in),

which no symmetric blur moves; the profiles' places give a line, the lines corners, and the corners' diagonals cross at
the picture of the tag's middle (under any perspective).
"""

from __future__ import annotations

import cv2
import numpy as np

from livedeform.common.types import Array
from livedeform.stereo_node.detect.picture import Picture

N_PROFILES = 24
STEP = 0.25  # px along a profile
FROM, TO = 0.15, 0.85  # of a side's length: near the corners two sides blur into each other
HUBER = 2.0  # residual sigmas
LEAST_STEP = 8.0  # grey values
BORDER = 0.55  # of the black border's width: farther in, the code's white squares shine through the blur
NARROWEST, WIDEST = 1.5, 3.5  # px to either side of the edge
SHARED = 2.7  # profiles side by side share pixels: measured, so that chi-square of rendered tags is 1


def tag_middles(picture: Picture, quads: Array, modules: int) -> tuple[Array, Array]:
    """Measure the middles (n, 2) px of tags with corners about ``quads`` (n, 4, 2), ``modules`` black or white squares
    across with their border, and covariances (n, 2, 2) px2; NaN where a side does not show."""
    centres, covariances = np.full((len(quads), 2), np.nan), np.full((len(quads), 2, 2), np.nan)
    for k, quad in enumerate(quads):
        for _ in range(2):  # the second time the profiles are centred
            found = _fit(picture, quad, modules)
            if found is None:
                break
            lines, line_cov = found
            quad = _corners(lines)
        if found is None or not np.isfinite(quad).all():
            continue
        centres[k] = _crossing(quad)
        J = np.empty((2, 8))
        for i in range(8):
            ends = []
            for sign in (1.0, -1.0):
                moved = lines.copy()
                moved[i // 2, 2 + i % 2] += sign * 1e-4
                ends.append(_crossing(_corners(moved)))
            J[:, i] = (ends[0] - ends[1]) / 2e-4
        C = np.zeros((8, 8))
        for i in range(4):
            C[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = line_cov[i]
        covariances[k] = J @ C @ J.T
    return centres, covariances


def _fit(picture: Picture, quad: Array, modules: int) -> tuple[Array, Array] | None:
    """Fit lines (4, 6) to the sides of ``quad`` (4, 2): a place on the side (2), the edge's offset from it along the
    normal and its slope, and the side's direction (2); with the covariances (4, 2, 2) of offset and slope. None where a
    side does not show."""
    lines, covariances = np.empty((4, 6)), np.empty((4, 2, 2))
    sides = np.roll(quad, -1, axis=0) - quad
    length = np.linalg.norm(sides, axis=1)
    half = float(np.clip(BORDER * length.min() / modules, NARROWEST, WIDEST))
    t = np.arange(-half, half + 1e-9, STEP)
    s = np.linspace(FROM, TO, N_PROFILES) - 0.5
    middle = quad.mean(axis=0)
    for i in range(4):
        along = sides[i] / length[i]
        normal = np.array([along[1], -along[0]])
        centre = quad[i] + 0.5 * sides[i]
        if (centre - middle) @ normal < 0:
            normal = -normal
        edge = _edge(picture, centre + s[:, None, None] * sides[i] + t[None, :, None] * normal, t)
        if edge is None:
            return None
        p, covariances[i] = _line(s * length[i], edge)
        if abs(p[0]) > half:
            return None
        lines[i] = *centre, p[0], p[1], *along
    return lines, covariances


def _edge(picture: Picture, places: Array, t: Array) -> Array | None:
    """Return where (n,) px the step from black to white lies on profiles at ``places`` (n, k, 2), from its area.

    ``t`` (k,) px: along a profile. None where there is no step.
    """
    x, y = places[..., 0].astype(np.float32), places[..., 1].astype(np.float32)
    profile = cv2.remap(picture, x, y, cv2.INTER_LINEAR).astype(float)
    n_flat = max(len(t) // 5, 2)
    dark = np.median(profile[:, :n_flat])
    rise = profile[:, -n_flat:].mean(axis=1) - dark
    if np.median(rise) < LEAST_STEP:
        return None
    edge: Array = t[-1] + 0.5 * STEP - (profile - dark).sum(axis=1) * STEP / np.maximum(rise, 0.3 * np.median(rise))
    return edge


def _line(along: Array, edge: Array) -> tuple[Array, Array]:
    """Fit offset and slope (2,) to the edge's places (n,) ``along`` a side, with Huber weights; and their covariance
    (2, 2)."""
    A = np.stack([np.ones(N_PROFILES), along], axis=1)
    weights = np.ones(N_PROFILES)
    for _ in range(6):
        H = A.T @ (weights[:, None] * A)
        p = np.linalg.solve(H, A.T @ (weights * edge))
        r = edge - A @ p
        sigma = 1.4826 * np.median(np.abs(r)) + 1e-3
        weights = np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-9))
    spread = (weights * r**2).sum() / max(weights.sum() - 2, 1)
    return np.asarray(p, float), np.asarray(np.linalg.inv(H) * spread * SHARED, float)


def _corners(lines: Array) -> Array:
    """Return the corners (4, 2): corner i is where side i - 1 meets side i."""
    along = lines[:, 4:6]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    middle = lines[:, :2].mean(axis=0)
    normal = normal * np.where(((lines[:, :2] - middle) * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    points = lines[:, :2] + lines[:, 2:3] * normal
    directions = along + lines[:, 3:4] * normal
    out = np.empty((4, 2))
    for i in range(4):
        a, b = i - 1, i
        det = directions[a, 0] * directions[b, 1] - directions[a, 1] * directions[b, 0]
        d = points[b] - points[a]
        reach = (d[0] * directions[b, 1] - d[1] * directions[b, 0]) / det if abs(det) > 1e-9 else np.nan
        out[i] = points[a] + reach * directions[a]
    return out


def _crossing(quad: Array) -> Array:
    """Return where the diagonals of a quadrilateral (4, 2) meet."""
    a, b, c, d = quad
    u, v, w = c - a, d - b, b - a
    s = (w[0] * v[1] - w[1] * v[0]) / (u[0] * v[1] - u[1] * v[0])
    out: Array = a + s * u
    return out
