"""The blurred picture of a tag's code at pixels, and where pixels lie on it: the kernels of `fit.py`, by whose text
letters are named."""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit
from livedeform.stereo_node.detect.blob_model import INV_SQRT_2PI, SQRT2

FAR = 6.0  # blurs: an edge that is farther off shows by 1e-9 of the contrast


@njit(cache=True, error_model="numpy")
def place(u, v, shape, inverse):
    """Return the module (X, Y) that is seen at (u, v) px with the homography and bends of ``shape`` (15,), whose
    ``inverse`` (3, 3) is given; the gradients 1/px of X and of Y there, and the perspective's depth."""
    fu, fv, X, Y = u, v, 0.0, 0.0
    for _ in range(3):  # a bend is small
        w = inverse[2, 0] * fu + inverse[2, 1] * fv + inverse[2, 2]
        X = (inverse[0, 0] * fu + inverse[0, 1] * fv + inverse[0, 2]) / w
        Y = (inverse[1, 0] * fu + inverse[1, 1] * fv + inverse[1, 2]) / w
        fu = u - X * X * shape[9] - X * Y * shape[11] - Y * Y * shape[13]
        fv = v - X * X * shape[10] - X * Y * shape[12] - Y * Y * shape[14]
    depth = X * shape[6] + Y * shape[7] + 1.0
    u_X = (shape[0] - fu * shape[6]) / depth + 2.0 * X * shape[9] + Y * shape[11]
    u_Y = (shape[1] - fu * shape[7]) / depth + X * shape[11] + 2.0 * Y * shape[13]
    v_X = (shape[3] - fv * shape[6]) / depth + 2.0 * X * shape[10] + Y * shape[12]
    v_Y = (shape[4] - fv * shape[7]) / depth + X * shape[12] + 2.0 * Y * shape[14]
    det = u_X * v_Y - u_Y * v_X
    return X, Y, v_Y / det, -u_Y / det, -v_X / det, u_X / det, depth


@njit(cache=True, error_model="numpy")
def beyond(at, shape, inverse, half, out):
    """Write by how many blurs (k,) pixels ``at`` (k, 2) px lie beyond the outer edge of a tag, ``half`` modules from
    its middle; infinite where they lie behind the camera."""
    for k in range(len(at)):
        X, Y, X_u, X_v, Y_u, Y_v, depth = place(at[k, 0], at[k, 1], shape, inverse)
        along_X = (abs(X) - half) / (shape[8] * math.sqrt(X_u * X_u + X_v * X_v))
        along_Y = (abs(Y) - half) / (shape[8] * math.sqrt(Y_u * Y_u + Y_v * Y_v))
        out[k] = max(along_X, along_Y) if depth > 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def _profile(X, sigma, m, f):
    """Write f, its derivative by X and by the logarithm of the blur ``sigma`` modules into ``f`` (3, m + 2), of ``m``
    modules in a row and of what is beside them; returns the first and the last that are not zero at ``X`` modules."""
    middle = X + 0.5 * m
    first = min(max(math.ceil(middle - FAR * sigma), 0), m + 1)
    last = max(min(math.floor(middle + FAR * sigma), m), first - 1)
    step, by_X, by_sigma = 1.0, 0.0, 0.0
    for edge in range(first, last + 1):
        z = (middle - edge) / sigma
        density = INV_SQRT_2PI * math.exp(-0.5 * z * z)
        after, by_X_after, by_sigma_after = 0.5 * math.erfc(-z / SQRT2), density / sigma, -density * z
        f[0, edge], f[1, edge], f[2, edge] = step - after, by_X - by_X_after, by_sigma - by_sigma_after
        step, by_X, by_sigma = after, by_X_after, by_sigma_after
    f[0, last + 1], f[1, last + 1], f[2, last + 1] = step, by_X, by_sigma
    return first, last + 1


@njit(cache=True, error_model="numpy")
def blurred_code(at, shape, inverse, code, out):
    """Write P, its gradient (2) 1/px, its derivative by the blur 1/px, X, Y and the perspective's depth into ``out``
    (7, k), at pixels ``at`` (k, 2) px of a tag with the modules ``code`` (m + 2, m + 2), with a row of white around."""
    m, s = len(code) - 2, shape[8]
    f, g = np.zeros((3, m + 2)), np.zeros((3, m + 2))
    for k in range(len(at)):
        X, Y, X_u, X_v, Y_u, Y_v, depth = place(at[k, 0], at[k, 1], shape, inverse)
        wide, high = s * math.sqrt(X_u * X_u + X_v * X_v), s * math.sqrt(Y_u * Y_u + Y_v * Y_v)
        if not math.isfinite(X + Y + wide + high):
            out[:, k] = np.nan
            continue
        left, right = _profile(X, wide, m, f)
        top, bottom = _profile(Y, high, m, g)
        P = P_X = P_Y = P_XY = by_blur = 0.0
        for i in range(top, bottom + 1):
            row = row_X = row_blur = 0.0
            for j in range(left, right + 1):
                row += code[i, j] * f[0, j]
                row_X += code[i, j] * f[1, j]
                row_blur += code[i, j] * f[2, j]
            P += row * g[0, i]
            P_X += row_X * g[0, i]
            P_Y += row * g[1, i]
            P_XY += row_X * g[1, i]
            by_blur += row_blur * g[0, i] + row * g[2, i]
        out[0, k] = P + s * s * (X_u * Y_u + X_v * Y_v) * P_XY
        out[1, k], out[2, k] = P_X * X_u + P_Y * Y_u, P_X * X_v + P_Y * Y_v
        out[3, k], out[4, k], out[5, k], out[6, k] = by_blur / s, X, Y, depth


@njit(cache=True, error_model="numpy")
def derivatives(at, told, light, s, J):
    """Write the derivatives of the greys by the homography's numbers, the blur and the bends (15), and by the planes of
    white and black and the light's curves (9), into ``J`` (k, 24): at pixels ``at`` (k, 2) px, of which `blurred_code`
    ``told`` (7, k), in a ``light`` (9,) and with a blur of ``s`` px."""
    for k in range(len(at)):
        u, v, P, X, Y = at[k, 0], at[k, 1], told[0, k], told[4, k], told[5, k]
        contrast = light[0] - light[3] + u * (light[1] - light[4]) + v * (light[2] - light[5])
        # what moves a module to another place lets the pixel see a place that lies the other way
        by_u, by_v = -contrast * told[1, k], -contrast * told[2, k]
        H_u, H_v = by_u / told[6, k], by_v / told[6, k]
        farther = H_u * u + H_v * v
        J[k, 0], J[k, 1], J[k, 2] = H_u * X, H_u * Y, H_u
        J[k, 3], J[k, 4], J[k, 5] = H_v * X, H_v * Y, H_v
        J[k, 6], J[k, 7], J[k, 8] = -farther * X, -farther * Y, contrast * told[3, k]
        J[k, 9], J[k, 11], J[k, 13] = X * X * by_u, X * Y * by_u, Y * Y * by_u
        J[k, 10], J[k, 12], J[k, 14] = X * X * by_v, X * Y * by_v, Y * Y * by_v
        to_u, to_v = s * s * told[1, k], s * s * told[2, k]
        J[k, 15], J[k, 16], J[k, 17] = P, P * u + to_u, P * v + to_v
        J[k, 18], J[k, 19], J[k, 20] = 1.0 - P, (1.0 - P) * u - to_u, (1.0 - P) * v - to_v
        level = (P * light[0] + (1.0 - P) * light[3]) / max(abs(light[0]), 1.0)
        J[k, 21], J[k, 22], J[k, 23] = level * u * u, level * u * v, level * v * v
