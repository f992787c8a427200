"""Smaller elements where they are wanted, on a mesh that is there."""

from __future__ import annotations

import logging

import numpy as np

from fem_node.tet_mesh import IntArray, TetMesh


def refined(mesh: TetMesh, tets: IntArray) -> TetMesh:
    """The mesh with the elements ``tets`` (k,) halved at their longest edges, and those beside them as far as it takes
    for faces to fit (scikit-fem's bisection; Arnold, Mukherjee & Pouly 2000). The body stays the same: new vertices are
    the middles of edges."""
    from skfem import MeshTet  # slow to import, and needed by the closed loop only

    logging.getLogger("skfem").setLevel(logging.ERROR)  # it tells how it lays out its arrays
    old = MeshTet(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.tets.T))
    new = old.refined(np.asarray(tets))
    nodes, cells = np.ascontiguousarray(new.p.T), np.ascontiguousarray(new.t.T.astype(np.int64))
    sides = nodes[cells[:, 1:]] - nodes[cells[:, :1]]
    turned = np.linalg.det(sides) < 0.0
    cells[turned, :2] = cells[turned, 1::-1]
    return TetMesh(nodes, cells)
