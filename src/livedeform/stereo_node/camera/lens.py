"""Lens models with derivatives, as compiled loops over points.

A lens is (kind, k, A): ``BROWN`` or ``EQUIDISTANT``, twelve coefficients, and the upper two rows (2, 3) of the camera
matrix. Brown's model has Zhang's order k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 (OpenCV, calib3d; plumb_bob is its first
five, rational_polynomial all); equidistant is Kannala and Brandt's (2006).
"""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array, CameraCalibration

BROWN, EQUIDISTANT = 0, 1
Lens = tuple[int, Array, Array]
MOST_ITERATIONS = 20
FARTHEST = 1e-6  # of the ideal image: a pixel that is met no better is not one that the lens can give
WIDEST_START = 1.5  # rad


def lens_of(camera: CameraCalibration) -> Lens:
    """Return the lens of a camera."""
    k = np.zeros(12)
    k[: camera.dist_coeffs.size] = camera.dist_coeffs
    A = np.ascontiguousarray(camera.camera_matrix[:2], float)
    return (EQUIDISTANT if camera.distortion_model == "equidistant" else BROWN), k, A


@njit(cache=True, error_model="numpy")
def bend(kind, k, x, y):
    """Return where the lens puts the ideal image point (x, y) at depth 1: (u, v), and du/dx, du/dy, dv/dx, dv/dy."""
    if kind == EQUIDISTANT:
        return _bend_equidistant(k, x, y)
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    denominator = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / denominator
    d_radial = (
        k[0] + r2 * (2.0 * k[1] + 3.0 * k[4] * r2) - radial * (k[5] + r2 * (2.0 * k[6] + 3.0 * k[7] * r2))
    ) / denominator
    u = x * radial + 2.0 * k[2] * xy + k[3] * (r2 + 2.0 * xx) + r2 * (k[8] + k[9] * r2)
    v = y * radial + k[2] * (r2 + 2.0 * yy) + 2.0 * k[3] * xy + r2 * (k[10] + k[11] * r2)
    prism_u, prism_v = k[8] + 2.0 * k[9] * r2, k[10] + 2.0 * k[11] * r2  # d/d(r2)
    both = 2.0 * xy * d_radial + 2.0 * k[2] * x + 2.0 * k[3] * y
    u_x = radial + 2.0 * xx * d_radial + 2.0 * k[2] * y + 6.0 * k[3] * x + 2.0 * x * prism_u
    v_y = radial + 2.0 * yy * d_radial + 6.0 * k[2] * y + 2.0 * k[3] * x + 2.0 * y * prism_v
    return u, v, u_x, both + 2.0 * y * prism_u, both + 2.0 * x * prism_v, v_y


@njit(cache=True, error_model="numpy")
def _bend_equidistant(k, x, y):
    r = max(math.hypot(x, y), 1e-12)
    theta = math.atan(r)
    t2 = theta * theta
    bent = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    d_bent = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
    scale = bent / r
    grows = d_bent / (1.0 + r * r) - scale  # r d(scale)/dr
    a, b = x / r, y / r
    return x * scale, y * scale, scale + grows * a * a, grows * a * b, grows * a * b, scale + grows * b * b


@njit(cache=True, error_model="numpy")
def to_pixel(kind, k, A, x, y, z):
    """Return the raw pixel (u, v) of a point in the camera's frame, and du/dx, du/dy, du/dz, dv/dx, dv/dy, dv/dz.

    NaN behind the camera.
    """
    if not z > 1e-9:
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    a, b = x / z, y / z
    u, v, u_a, u_b, v_a, v_b = bend(kind, k, a, b)
    p_a, p_b = A[0, 0] * u_a + A[0, 1] * v_a, A[0, 0] * u_b + A[0, 1] * v_b
    q_a, q_b = A[1, 0] * u_a + A[1, 1] * v_a, A[1, 0] * u_b + A[1, 1] * v_b
    return (
        A[0, 0] * u + A[0, 1] * v + A[0, 2], A[1, 0] * u + A[1, 1] * v + A[1, 2],
        p_a / z, p_b / z, -(p_a * a + p_b * b) / z, q_a / z, q_b / z, -(q_a * a + q_b * b) / z,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def to_ray(kind, k, A, u, v):
    """Return the ideal image point (x, y) at depth 1 of a raw pixel, and dx/du, dx/dv, dy/du, dy/dv, by Newton's
    method.

    NaN for a pixel that the lens cannot give.
    """
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    du, dv = u - A[0, 2], v - A[1, 2]
    to_x, to_y = (A[1, 1] * du - A[0, 1] * dv) / det, (A[0, 0] * dv - A[1, 0] * du) / det
    x, y = to_x, to_y
    if kind == EQUIDISTANT:  # start from the lens without its polynomial
        theta = math.hypot(x, y)
        wider = math.tan(min(theta, WIDEST_START)) / max(theta, 1e-12)
        x, y = x * wider, y * wider
    for _ in range(MOST_ITERATIONS):
        p, q, p_x, p_y, q_x, q_y = bend(kind, k, x, y)
        own = p_x * q_y - p_y * q_x
        step_x = (q_y * (to_x - p) - p_y * (to_y - q)) / own
        step_y = (p_x * (to_y - q) - q_x * (to_x - p)) / own
        x += min(max(step_x, -0.5), 0.5)
        y += min(max(step_y, -0.5), 0.5)
        if not max(abs(step_x), abs(step_y)) > 1e-12:
            break
    p, q, p_x, p_y, q_x, q_y = bend(kind, k, x, y)
    if not max(abs(p - to_x), abs(q - to_y)) <= FARTHEST:
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    u_x, u_y = A[0, 0] * p_x + A[0, 1] * q_x, A[0, 0] * p_y + A[0, 1] * q_y
    v_x, v_y = A[1, 0] * p_x + A[1, 1] * q_x, A[1, 0] * p_y + A[1, 1] * q_y
    own = u_x * v_y - u_y * v_x
    return x, y, v_y / own, -u_y / own, -v_x / own, u_x / own


@njit(cache=True, error_model="numpy")
def to_pixels(kind, k, A, points):
    """Apply ``to_pixel`` to points (n, 3): pixels (n, 2) and derivatives (n, 2, 3)."""
    pixels, J = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    for i in range(len(points)):
        (
            pixels[i, 0], pixels[i, 1], J[i, 0, 0], J[i, 0, 1], J[i, 0, 2], J[i, 1, 0], J[i, 1, 1], J[i, 1, 2],
        ) = to_pixel(kind, k, A, points[i, 0], points[i, 1], points[i, 2])  # fmt: skip
    return pixels, J


@njit(cache=True, error_model="numpy")
def to_rays(kind, k, A, pixels):
    """Apply ``to_ray`` to pixels (n, 2): ideal image points (n, 2) and derivatives (n, 2, 2)."""
    rays, J = np.empty((len(pixels), 2)), np.empty((len(pixels), 2, 2))
    for i in range(len(pixels)):
        rays[i, 0], rays[i, 1], J[i, 0, 0], J[i, 0, 1], J[i, 1, 0], J[i, 1, 1] = to_ray(
            kind, k, A, pixels[i, 0], pixels[i, 1]
        )
    return rays, J
