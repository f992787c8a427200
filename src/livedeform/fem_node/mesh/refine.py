"""Smaller elements where they are wanted, on a mesh that is there."""

from __future__ import annotations

import logging

import numpy as np

from livedeform.common.experiment.smooth_surface import bulge
from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray, TetMesh


def refined(mesh: TetMesh, tets: IntArray) -> TetMesh:
    """The mesh with the elements ``tets`` (k,) halved at their longest edges, and those beside them as far as it takes
    for faces to fit (scikit-fem's bisection; Arnold, Mukherjee & Pouly 2000). New vertices are the middles of edges,
    on the surface of a round body those of its arcs."""
    from skfem import MeshTet  # slow to import, and needed by the closed loop only

    logging.getLogger("skfem").setLevel(logging.ERROR)  # it tells how it lays out its arrays
    old = MeshTet(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.tets.T))
    new = old.refined(np.asarray(tets))
    nodes, cells = np.ascontiguousarray(new.p.T), np.ascontiguousarray(new.t.T.astype(np.int64))
    sides = nodes[cells[:, 1:]] - nodes[cells[:, :1]]
    turned = np.linalg.det(sides) < 0.0
    cells[turned, :2] = cells[turned, 1::-1]
    return TetMesh(_rounded(mesh, TetMesh(nodes, cells)), cells)


def _rounded(old: TetMesh, new: TetMesh) -> Array:
    """The ``new`` mesh's vertices (n, 3) m, those that are new and on a smooth part of the surface moved out of the
    ``old`` one's flat triangles."""
    from trimesh.triangles import points_to_barycentric

    nodes, triangles = new.nodes.copy(), new.boundary_triangles
    unit = new.corner_normals
    surface = np.unique(triangles)
    added = surface[surface >= len(old.nodes)]
    flat = np.full(len(nodes), True)  # of a vertex: all its triangles are on the same side of all edges
    first = np.zeros((len(nodes), 3))
    first[triangles.ravel()] = unit.reshape(-1, 3)
    np.logical_and.at(
        flat, triangles.ravel(), np.einsum("ki,ki->k", unit.reshape(-1, 3), first[triangles.ravel()]) > 0.999
    )
    added = added[flat[added]]
    if not len(added):
        return nodes
    corners = old.nodes[old.boundary_triangles]
    at = np.concatenate([_nearest(corners, nodes[part]) for part in np.array_split(added, len(added) // 64 + 1)])
    b = points_to_barycentric(corners[at], nodes[added])
    normals = old.corner_normals[at]
    out = [bulge(c[None], n[None], w[None])[0, 0] for c, n, w in zip(corners[at], normals, b, strict=True)]
    nodes[added] += np.array(out)
    return nodes


def _nearest(corners: Array, points: Array) -> IntArray:
    """Return which of the triangles ``corners`` (k, 3, 3) is nearest to each of the ``points`` (n, 3)."""
    from trimesh.triangles import closest_point

    k, n = len(corners), len(points)
    nearest = closest_point(np.tile(corners, (n, 1, 1)), np.repeat(points, k, axis=0))
    away = np.linalg.norm(nearest - np.repeat(points, k, axis=0), axis=1)
    return np.asarray(away.reshape(n, k).argmin(axis=1))
