"""Move the boundary of a mesh so that it lies as far outside of its surface as inside.

Flat triangles between points of a curved surface are chords: they lie inside of it, and a mesh of large elements lacks
some tenths of a per cent of a dome's volume, and of its weight. Smaller elements would mend that at many times the
price. Here the nodes of the boundary are moved instead, as little as possible (least squares; LSMR of Fong & Saunders
2011), so that each triangle is on the surface on average. What lies on the surface already, as a flat base, stays in
its plane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsmr

from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray, TetMesh
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features

PASSES = 2  # a second one takes what turned triangles leave of the first
DAMPING = 0.3  # of a triangle's own row: neighbours share what they lack, no node goes far
STAYS = 10.0  # weight, over that of a triangle, of what is to stay in its plane
ON_SURFACE = 1e-3  # of what the worst triangle lacks: less is none
# barycentric places (10, 3), the middles of a grid on a triangle; they overestimate a bulge's mean by some 4 %
PLACES = np.array([(i, j, 9 - i - j) for i in (0, 3, 6, 9) for j in range(0, 10 - i, 3)]) / 13.5 + 1.0 / 9.0


def balanced(mesh: TetMesh, vertices: Array, triangles: IntArray) -> TetMesh:
    """Return the mesh with its boundary moved onto the closed surface (vertices (n, 3) m, triangles (k, 3)) on average,
    triangle by triangle. Its elements may be flatter than before."""
    tree = TriangleTree.without_normals(vertices[triangles])
    for _ in range(PASSES):
        mesh = replace(mesh, nodes=mesh.nodes + _moves(mesh, tree))
    return mesh


def _moves(mesh: TetMesh, tree: TriangleTree) -> Array:
    """Return how far each node (n, 3) m is to go."""
    faces = mesh.boundary_triangles
    corners = mesh.nodes[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal /= area[:, None]
    points = np.einsum("qi,tic->tqc", PLACES, corners)
    nearest = closest_features(tree, np.ascontiguousarray(points.reshape(-1, 3)))[0].reshape(points.shape)
    lacks = ((nearest - points) * normal[:, None]).sum(axis=2)
    there = np.abs(lacks).max(axis=1) <= ON_SURFACE * np.abs(lacks).max()
    weight = np.sqrt(area / area.mean())
    rows = [weight[:, None, None] * np.repeat(normal[:, None] / 3.0, 3, axis=1)]
    rows += [np.where(np.arange(3)[:, None] == i, STAYS * normal[there][:, None], 0.0) for i in range(3)]
    touched = np.concatenate([faces, *[faces[there]] * 3])
    values = np.concatenate(rows)
    n = len(values)
    matrix = coo_array(
        (values.ravel(), (np.repeat(np.arange(n), 9), (3 * touched[:, :, None] + np.arange(3)).ravel())),
        shape=(n, 3 * len(mesh.nodes)),
    )
    wanted = np.zeros(n)
    wanted[: len(faces)] = weight * lacks.mean(axis=1)
    return np.asarray(lsmr(matrix.tocsr(), wanted, damp=DAMPING, atol=1e-10, btol=1e-10)[0]).reshape(-1, 3)
