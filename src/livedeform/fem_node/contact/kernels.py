"""The contact's compiled sums: which facets are near the probe, where their contact points are, and what these bear."""

import numpy as np

from livedeform.common.compiled import njit


@njit(cache=True)
def near_box(at_rest, u, surface, T, bounds, reach, y, near):
    """Places ``y`` (n, 3) by T (4, 4) of the ``surface`` nodes (n,), which are displaced by ``u``, and whether they are
    within ``reach`` of the box."""
    for n in range(len(y)):
        square = 0.0
        for i in range(3):
            y[n, i] = T[i, 3]
            for j in range(3):
                y[n, i] += T[i, j] * (at_rest[n, j] + u[surface[n], j])
            away = max(bounds[0, i] - y[n, i], y[n, i] - bounds[1, i], 0.0)
            square += away * away
        near[n] = square < reach * reach


@njit(cache=True)
def any_of(nodes, corners, facets):
    """Finds whether any of each facet's ``corners`` (m, b) is among the ``nodes`` (n,)."""
    for m in range(len(corners)):
        facets[m] = False
        for b in range(corners.shape[1]):
            if nodes[corners[m, b]]:
                facets[m] = True
                break


@njit(cache=True)
def points_of(facets, corners, y, values, bulge, T, points):
    """Interpolates the places ``y`` (n, 3) of the ``corners`` to the ``points`` (m q, 3) of the facets (m,), which
    stand outside them by the ``bulge`` (k, q, 3); T (4, 4) is of the frame in which ``y`` is."""
    n_values, n_corners = values.shape
    for m in range(len(facets)):
        for k in range(n_values):
            for i in range(3):
                at = 0.0
                for j in range(3):
                    at += bulge[facets[m], k, j] * T[j, i]
                for b in range(n_corners):
                    at += values[k, b] * y[corners[facets[m], b], i]
                points[m * n_values + k, i] = at


@njit(cache=True)
def sum_forces(values, w, R, n, pressure, rubbing, vectors):
    """Adds the tractions at the points, of weights ``w`` (m q,) and with the axes ``R`` of the probe, to the facets'
    ``vectors`` (m, 3 b)."""
    n_values, n_corners = values.shape
    along = np.empty(3)
    for k in range(len(w)):
        if pressure[k] == 0.0 and len(rubbing) == 0:
            continue
        for i in range(3):
            along[i] = -pressure[k] * n[k, i]
            if len(rubbing):
                along[i] -= rubbing[k, i]
        m, point = divmod(k, n_values)
        for i in range(3):
            force = w[k] * (R[i, 0] * along[0] + R[i, 1] * along[1] + R[i, 2] * along[2])
            for a in range(n_corners):
                vectors[m, 3 * a + i] += values[point, a] * force


@njit(cache=True)
def sum_stiffness(values, w, R, n, stiffness, curved, H, rubbing, blocks):
    """Adds the stiffness eps n n^T - p H + that of rubbing, p being ``curved``, to the facets' ``blocks``."""
    n_values, n_corners = values.shape
    D, RD = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(w)):
        if stiffness[k] == 0.0 and curved[k] == 0.0 and (len(rubbing) == 0 or not np.any(rubbing[k] != 0.0)):
            continue
        for i in range(3):
            for j in range(3):
                D[i, j] = stiffness[k] * n[k, i] * n[k, j] - curved[k] * H[k, i, j]
                if len(rubbing):
                    D[i, j] += rubbing[k, i, j]
        for i in range(3):
            for j in range(3):
                RD[i, j] = w[k] * (R[i, 0] * D[0, j] + R[i, 1] * D[1, j] + R[i, 2] * D[2, j])
        for i in range(3):
            for j in range(3):
                D[i, j] = RD[i, 0] * R[j, 0] + RD[i, 1] * R[j, 1] + RD[i, 2] * R[j, 2]
        m, point = divmod(k, n_values)
        for a in range(n_corners):
            for b in range(n_corners):
                factor = values[point, a] * values[point, b]
                for i in range(3):
                    for j in range(3):
                        blocks[m, 3 * a + i, 3 * b + j] += factor * D[i, j]


@njit(cache=True)
def may_act(y, facets, multiplier, limit, attached, bounds, acts):
    """Finds whether any point ``y`` (m q, 3) of each facet is within the box, has a multiplier or a friction limit, or
    is attached."""
    q = len(y) // len(facets)
    for m in range(len(facets)):
        acts[m] = False
        for k in range(q):
            row = facets[m] * q + k
            inside = True
            for i in range(3):
                z = y[m * q + k, i]
                inside = inside and bounds[0, i] <= z and z <= bounds[1, i]
            if inside or multiplier[row] != 0.0 or limit[row] != 0.0 or attached[row]:
                acts[m] = True
                break
