"""Least squares with weights that fall off where a pixel does not fit, compiled."""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit

ROBUST = 4.0  # residual sigmas, beyond which a pixel's weight falls off


@njit(cache=True, error_model="numpy")
def fit_robustly(J, grey, tight, x, C):
    """Solve ``J`` (k, n) x = ``grey`` (k,), where x is known to be about what is in ``x`` (n,) with the inverse
    variances ``tight`` (n,); returns the residuals' variance and writes x and its covariance ``C`` (n, n), not numbers
    where it has none."""
    n = len(x)
    known, weight, variance = x.copy(), np.ones(len(grey)), 1.0
    weighted, norm = np.empty(J.T.shape), np.empty(n)
    for _ in range(3):
        for k in range(len(grey)):
            for i in range(n):
                weighted[i, k] = weight[k] * J[k, i]
        N, b = np.dot(weighted, J), np.dot(weighted, grey)
        for i in range(n):
            N[i, i] += variance * tight[i]
            b[i] += variance * tight[i] * known[i]
            norm[i] = math.sqrt(max(N[i, i], 1e-12))
        for i in range(n):
            for j in range(i + 1):
                N[i, j] /= norm[i] * norm[j]
            N[i, i] += 1e-10
        _invert(N, C)
        for i in range(n):
            x[i] = 0.0
            for j in range(n):
                C[i, j] /= norm[i] * norm[j]
                x[i] += C[i, j] * b[j]
        variance = _weigh(J, grey, x, weight)
    for i in range(n):
        for j in range(n):
            C[i, j] *= variance
    return variance


@njit(cache=True, error_model="numpy")
def _invert(N, out):
    """Write the inverse (n, n) of the symmetric ``N`` (n, n), of which the lower half is read and overwritten, by
    Cholesky's factor L and its inverse."""
    n = len(N)
    for j in range(n):
        for i in range(j, n):
            left = N[i, j]
            for k in range(j):
                left -= N[i, k] * N[j, k]
            N[i, j] = math.sqrt(left) if i == j else left / N[j, j]
    for j in range(n):
        for i in range(j, n):
            left = 1.0 if i == j else 0.0
            for k in range(j, i):
                left -= N[i, k] * out[j, k]
            out[j, i] = left / N[i, i]  # L^-T, above
    for i in range(n):
        for j in range(i, n):
            total = 0.0
            for k in range(j, n):
                total += out[i, k] * out[j, k]
            out[i, j] = out[j, i] = total


@njit(cache=True, error_model="numpy")
def _weigh(J, grey, x, weight):
    """Return the variance of what is left of ``grey`` (k,) by the ``weight`` (k,), and write that anew."""
    left, square, total = np.empty(len(grey)), 0.0, 0.0
    for k in range(len(grey)):
        fit = 0.0
        for i in range(len(x)):
            fit += J[k, i] * x[i]
        left[k] = grey[k] - fit
        square += weight[k] * left[k] ** 2
        total += weight[k]
    variance = square / max(total - len(x), 1.0)
    for k in range(len(grey)):
        weight[k] = 1.0 / max(abs(left[k]) / (ROBUST * math.sqrt(variance) + 1e-9), 1.0) ** 2
    return variance
