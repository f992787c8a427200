"""Compiled assembly of the truth's elements: quadratic hexahedra with a discontinuous linear pressure.

Energy per element (perturbed Lagrangian; Simo & Taylor 1991), with I1 isochoric, and p in span{1, xi, eta, zeta}:

    int mu/2b (exp(b (I1 - 3)) - 1) + fibre/4 mu (I4 - 1)^2 + p (J - 1) - p^2 / 2K

p is eliminated inside the element: p = psi . M^-1 b, M = int psi psi^T / K, b = int psi (J - 1), which leaves a
tangent in the displacements alone: K = K_iso + K_p + B^T M^-1 B, B = int psi J F^-T : grad.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array


@njit(cache=True, fastmath=True, error_model="numpy")
def assemble(
    x,
    hexes,
    G,
    w,
    psi,
    mu,
    K,
    stiffening,
    fibre,
    direction,
    branch,
    history,
    position,
    data,
    force,
    S_out,
    with_tangent,
):
    """Add the elements to ``data`` (CSR values) and ``force`` (n, 3); returns the smallest J.

    ``x`` (n, 3) current places; ``G`` (m, q, 3, 27) gradients and ``w`` (m, q) volumes of the stress-free state;
    ``mu``, ``K`` (m, q);
    ``branch`` 1 + sum of the viscous factors; ``history`` (m, q, 3, 3) viscous second Piola stress from the past;
    ``position`` (m, 27, 27, 3): where row 3a + i of the node pair starts in ``data``; ``S_out`` (m, q, 3, 3): the
    isochoric elastic second Piola stress, for the viscous history.
    """
    smallest = 1e300
    n_q = w.shape[1]
    Ke = np.empty((81, 81))
    Bv = np.empty((4, 81))
    X = np.empty((81, 9))
    Fq = np.empty((n_q, 3, 3))
    Jq = np.empty(n_q)
    A = np.empty((9, 9))
    H = np.empty((3, 3))
    P = np.empty((3, 3))
    D = np.empty((3, 3))
    fe = np.empty(81)
    for e in range(len(hexes)):
        M = np.zeros((4, 4))
        b = np.zeros(4)
        for q in range(n_q):
            g = G[e, q]
            for i in range(3):
                for j in range(3):
                    s = g_dot(x, hexes[e], g, i, j)
                    Fq[q, i, j] = s
            F = Fq[q]
            J = (
                F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
                - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
                + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
            )
            Jq[q] = J
            smallest = min(smallest, J)
            for a in range(4):
                b[a] += psi[q, a] * (J - 1.0) * w[e, q]
                for c in range(4):
                    M[a, c] += psi[q, a] * psi[q, c] * w[e, q] / K[e, q]
        if smallest <= 0.0:
            return smallest
        Minv = np.linalg.inv(M)
        coefficient = Minv @ b
        Ke[:] = 0.0
        Bv[:] = 0.0
        fe[:] = 0.0
        for q in range(n_q):
            F, J, g, weight = Fq[q], Jq[q], G[e, q], w[e, q]
            p = 0.0
            for a in range(4):
                p += psi[q, a] * coefficient[a]
            # H = F^-T
            for i in range(3):
                for j in range(3):
                    i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                    H[i, j] = (F[i1, j1] * F[i2, j2] - F[i1, j2] * F[i2, j1]) / J
            I1 = 0.0
            for i in range(3):
                for j in range(3):
                    I1 += F[i, j] * F[i, j]
            Jm = J ** (-2.0 / 3.0)
            excess = Jm * I1 - 3.0
            growth = np.exp(min(stiffening * excess, 30.0))
            W1 = 0.5 * mu[e, q] * growth
            W11 = W1 * stiffening
            scale = branch
            for i in range(3):
                for j in range(3):
                    D[i, j] = F[i, j] - I1 / 3.0 * H[i, j]
                    P[i, j] = 2.0 * W1 * Jm * D[i, j]
            fibre_stress = 0.0
            Fa0 = F[0, 0] * direction[0] + F[0, 1] * direction[1] + F[0, 2] * direction[2]
            Fa1 = F[1, 0] * direction[0] + F[1, 1] * direction[1] + F[1, 2] * direction[2]
            Fa2 = F[2, 0] * direction[0] + F[2, 1] * direction[1] + F[2, 2] * direction[2]
            Fa = (Fa0, Fa1, Fa2)
            if fibre > 0.0:  # full I4: the body is nearly incompressible
                fibre_stress = fibre * mu[e, q] * (Fa0 * Fa0 + Fa1 * Fa1 + Fa2 * Fa2 - 1.0)
                for i in range(3):
                    for j in range(3):
                        P[i, j] += fibre_stress * Fa[i] * direction[j]
            for i in range(3):  # S = F^-1 P
                for j in range(3):
                    S_out[e, q, i, j] = H[0, i] * P[0, j] + H[1, i] * P[1, j] + H[2, i] * P[2, j]
            for i in range(3):
                for j in range(3):
                    viscous = 0.0
                    for k in range(3):
                        viscous += F[i, k] * history[e, q, k, j]
                    P[i, j] = scale * P[i, j] + viscous + p * J * H[i, j]
            for i in range(3):
                for a in range(27):
                    fe[27 * i + a] += weight * (P[i, 0] * g[0, a] + P[i, 1] * g[1, a] + P[i, 2] * g[2, a])
            if not with_tangent:
                continue
            c1 = 2.0 * W1 * Jm * scale
            c2 = 4.0 * W11 * Jm * Jm * scale
            for i in range(3):
                for k in range(3):
                    for j in range(3):
                        for l in range(3):
                            t = c2 * D[i, k] * D[j, l]
                            t += c1 * (
                                -2.0 / 3.0 * (H[i, k] * F[j, l] + F[i, k] * H[j, l])
                                + 2.0 / 9.0 * I1 * H[i, k] * H[j, l]
                                + I1 / 3.0 * H[i, l] * H[j, k]
                            )
                            t += p * J * (H[i, k] * H[j, l] - H[i, l] * H[j, k])
                            if i == j:
                                t += history[e, q, k, l]
                                if k == l:
                                    t += c1
                            if fibre > 0.0:
                                t += scale * 2.0 * fibre * mu[e, q] * Fa[i] * direction[k] * Fa[j] * direction[l]
                                if i == j:
                                    t += scale * fibre_stress * direction[k] * direction[l]
                            A[3 * i + k, 3 * j + l] = weight * t
            for i in range(3):
                for a in range(27):
                    for c in range(9):
                        X[27 * i + a, c] = g[0, a] * A[3 * i, c] + g[1, a] * A[3 * i + 1, c] + g[2, a] * A[3 * i + 2, c]
                    bv = weight * J * (H[i, 0] * g[0, a] + H[i, 1] * g[1, a] + H[i, 2] * g[2, a])
                    for c in range(4):
                        Bv[c, 27 * i + a] += psi[q, c] * bv
            for r in range(81):
                for j in range(3):
                    x0, x1, x2 = X[r, 3 * j], X[r, 3 * j + 1], X[r, 3 * j + 2]
                    row = Ke[r, 27 * j : 27 * j + 27]
                    for c in range(27):
                        row[c] += x0 * g[0, c] + x1 * g[1, c] + x2 * g[2, c]
        for a in range(27):
            for i in range(3):
                force[hexes[e, a], i] += fe[27 * i + a]
        if with_tangent:
            MB = Minv @ Bv
            for r in range(81):
                for c in range(4):
                    s = Bv[c, r]
                    for k in range(81):
                        Ke[r, k] += s * MB[c, k]
            for a in range(27):
                for i in range(3):
                    for c in range(27):
                        at = position[e, a, c, i]
                        for j in range(3):
                            data[at + j] += Ke[27 * i + a, 27 * j + c]
    return smallest


@njit(cache=True, fastmath=True, inline="always")
def g_dot(x, nodes, g, i, j):
    """sum_a x[nodes_a, i] g[j, a]."""
    s = 0.0
    for a in range(27):
        s += x[nodes[a], i] * g[j, a]
    return s


@njit(cache=True)
def scatter_faces(blocks, faces, position, data) -> None:
    """Add face matrices ``blocks`` (f, 9, 3, 9, 3) to ``data``; ``position`` (f, 9, 9, 3)."""
    for f in range(len(faces)):
        for a in range(9):
            for c in range(9):
                for i in range(3):
                    at = position[f, a, c, i]
                    for j in range(3):
                        data[at + j] += blocks[f, a, i, c, j]


def gradients(nodes: Array, hexes, local_gradient: Array) -> tuple[Array, Array]:
    """Gradients (m, q, 3, 27) of the shape functions in the reference state, and det (m, q) of the mapping."""
    mapping = np.einsum("qla,mad->mqdl", local_gradient, nodes[hexes])
    inverse = np.linalg.inv(mapping)
    return np.ascontiguousarray(np.einsum("mqld,qla->mqda", inverse, local_gradient)), np.linalg.det(mapping)
