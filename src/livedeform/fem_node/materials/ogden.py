"""Ogden: W = sum_p 2 mu_p / alpha_p^2 (l1^a + l2^a + l3^a - 3) + K/2 (J - 1)^2, l = J^-1/3 principal stretches (after
Ogden 1972).

``mu`` and ``alpha`` are lists; sum(mu) is rescaled to the shear modulus of E and nu, so that effects on the modulus
act on all. No mu_p is negative; alpha_p may be. Constants of Ogden's own formula, W = sum_p mu_p / alpha_p (...), are
given as mu_p alpha_p / 2.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.element.simd import side_by_side
from livedeform.fem_node.materials.base import Material
from livedeform.fem_node.physics.record import MaterialSpec

_CLOSE = 1e-6  # relative distance of two principal stretches below which the difference quotient becomes a derivative


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu; the terms' weights from ``mu``, their exponents from ``alpha`` (default: one term,
    2)."""
    alpha = np.atleast_1d(np.asarray(spec.extra.get("alpha", [2.0]), float))
    weights = np.atleast_1d(np.asarray(spec.extra.get("mu", np.ones(len(alpha))), float))
    mu = spec.shear_modulus * weights / weights.sum()

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        _response(F, factor, mu, alpha, psi, P, A)

    return Material("ogden", spec.shear_modulus, spec.bulk_modulus, response)


def _response(F: Array, factor: Array, mu: Array, alpha: Array, psi: Array, P: Array, A: Array | None) -> None:
    """Compute with F = V diag(l) W^T: P = V diag(g) W^T, g = dW/dl; A from g' and difference quotients (Holzapfel 2000,
    6.180)."""
    V, l, Wt = np.linalg.svd(F)
    J = l.prod(axis=1)
    bar = l / np.cbrt(J)[:, None]
    powers = bar[:, :, None] ** alpha  # (n, 3, p)
    psi[:] = factor * ((2.0 * mu / alpha**2) * (powers.sum(axis=1) - 3.0)).sum(axis=1)
    psi[np.linalg.det(F) <= 0.0] = np.inf
    beta = ((2.0 * mu / alpha) * (powers - powers.mean(axis=1, keepdims=True))).sum(axis=2) * factor[:, None]  # l_i g_i
    g = beta / l
    P[:] = np.einsum("nia,na,naJ->niJ", V, g, Wt)
    if A is None:
        return
    # d beta_i / d ln l_j = sum_p 2 mu (delta_ij s_i - (s_i + s_j)/3 + mean(s)/3)
    mean = powers.mean(axis=1)
    B = -(powers[:, :, None] + powers[:, None, :]) / 3.0 + mean[:, None, None] / 3.0
    B[:, range(3), range(3)] += powers
    B = (B * (2.0 * mu)).sum(axis=3) * factor[:, None, None]
    H = B / (l[:, :, None] * l[:, None, :])  # dg_i/dl_j = B_ij / (l_i l_j) - delta_ij beta_i / l_i^2
    H[:, range(3), range(3)] -= beta / l**2
    modes = np.einsum("nia,naJ->naiJ", V, Wt).reshape(len(F), 3, 9)
    tangent = np.einsum("nam,nab,nbk->nmk", modes, H, modes)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        # equal stretches: (g_a - g_b)/(l_a - l_b) -> dg_a/dl_a - dg_a/dl_b
        difference, total = l[:, a] - l[:, b], l[:, a] + l[:, b]
        close = np.abs(difference) < _CLOSE * total
        quotient = (g[:, a] - g[:, b]) / np.where(close, 1.0, difference)
        quotient = np.where(close, 0.5 * (H[:, a, a] + H[:, b, b]) - H[:, a, b], quotient)
        for sign, factor_ab in ((1.0, quotient), (-1.0, (g[:, a] + g[:, b]) / total)):
            mode = np.einsum("ni,nJ->niJ", V[:, :, a], Wt[:, b]) + sign * np.einsum("ni,nJ->niJ", V[:, :, b], Wt[:, a])
            mode = mode.reshape(-1, 9)
            tangent += 0.5 * factor_ab[:, None, None] * mode[:, :, None] * mode[:, None, :]
    A[:] = side_by_side(tangent, A.shape[1])
