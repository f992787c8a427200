"""Elements on tetrahedra: nodes, shape functions, and quadrature points.

The elements differ in how they keep the volume (Hughes 2000, ch. 4; Boffi, Brezzi & Fortin 2013, ch. 8):

=========  ===========================================================================================================
p2p0       quadratic displacement, volume ratio averaged over the element (constant pressure, condensed): no locking
p2p1       quadratic displacement, continuous linear pressure (Taylor & Hood 1973): no locking, a saddle point
p2         quadratic displacement alone: locks mildly
p1         linear displacement alone: locks badly at nu -> 1/2; only for comparison
=========  ===========================================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.element import quadrature
from livedeform.fem_node.mesh.tet_mesh import TetMesh

ElementKind = Literal["p2p0", "p2p1", "p2", "p1"]
Indices = NDArray[np.int64]

TET_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])  # VTK's order of the mid-edge nodes
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [0, 2]])


def shape_values(barycentric: Array, *, quadratic: bool) -> Array:
    """N (q, a) at barycentric coordinates (q, d + 1), d = 2 or 3. Quadratic: L(2L - 1) at vertices, 4 L L' at
    mid-edges."""
    L = np.atleast_2d(barycentric)
    if not quadratic:
        return L.copy()
    edges = TET_EDGES if L.shape[1] == 4 else TRIANGLE_EDGES
    return np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[:, edges[:, 0]] * L[:, edges[:, 1]]], axis=1)


def shape_derivatives(barycentric: Array, *, quadratic: bool) -> Array:
    """dN_a/dL_k (q, a, d + 1) at barycentric coordinates (q, d + 1)."""
    L = np.atleast_2d(barycentric)
    q, n = L.shape
    vertex = np.broadcast_to(np.eye(n), (q, n, n))
    if not quadratic:
        return vertex.copy()
    edges = TET_EDGES if n == 4 else TRIANGLE_EDGES
    edge = np.zeros((q, len(edges), n))
    rows = np.arange(len(edges))
    edge[:, rows, edges[:, 0]] = 4.0 * L[:, edges[:, 1]]
    edge[:, rows, edges[:, 1]] = 4.0 * L[:, edges[:, 0]]
    return np.concatenate([vertex * (4.0 * L - 1.0)[:, :, None], edge], axis=1)


def number_edges(cells: Indices, edges: Indices, n_vertices: int) -> tuple[Indices, Indices]:
    """Mid-edge node numbers (e, k) from ``n_vertices`` on, and the vertex pairs (n_edges, 2), sorted."""
    pairs = np.sort(cells[:, edges].reshape(-1, 2), axis=1)
    keys = pairs[:, 0] * n_vertices + pairs[:, 1]
    unique, inverse = np.unique(keys, return_inverse=True)
    pairs = np.stack([unique // n_vertices, unique % n_vertices], axis=1)
    return inverse.reshape(len(cells), -1) + n_vertices, pairs


class Workspace(NamedTuple):
    """Deformation gradient F, stress P and volume gradient c (e, q, 3, 3), volume ratio theta and energy psi (e q,)."""

    F: Array
    P: Array
    c: Array
    theta: Array
    psi: Array


@dataclass(frozen=True)
class Space:
    """A mesh with an element on it, in the scanned configuration.

    ``nodes`` (n, 3) m, vertices first, then mid-edges; ``cells`` (e, a) and ``facets`` (k, b), outward, index nodes;
    ``frames`` (e, q, 3, 3) dxi/dX 1/m and ``weights`` (e, q) m3 of the quadrature points; ``values`` (q, a) N and
    ``slopes`` (q, a, 3) dN/dxi there, the same in all elements; ``edges`` the vertex pairs of the mid-edge nodes.
    """

    mesh: TetMesh
    kind: ElementKind
    nodes: Array
    cells: Indices
    facets: Indices
    edges: Indices
    values: Array
    slopes: Array
    frames: Array
    weights: Array
    barycentric: Array

    @property
    def quadratic(self) -> bool:
        """Return whether the displacement is quadratic."""
        return self.kind != "p1"

    @property
    def n_nodes(self) -> int:
        """Displacement nodes."""
        return len(self.nodes)

    @property
    def n_pressure(self) -> int:
        """Pressure unknowns (vertices of P2-P1, otherwise none)."""
        return len(self.mesh.nodes) if self.kind == "p2p1" else 0

    @property
    def n_dof(self) -> int:
        """Length of the vector of unknowns: 3 per node, then the pressures."""
        return 3 * self.n_nodes + self.n_pressure

    @cached_property
    def typical_size(self) -> float:
        """Mean edge length of the tetrahedra, m."""
        corners = self.mesh.nodes[self.mesh.tets[:, TET_EDGES]]
        return float(np.linalg.norm(corners[:, :, 0] - corners[:, :, 1], axis=2).mean())

    @cached_property
    def points(self) -> Array:
        """Quadrature points (e, q, 3) m."""
        return np.asarray(np.einsum("qa,eai->eqi", self.values, self.nodes[self.cells]))

    @cached_property
    def workspace(self) -> Workspace:
        """Arrays that items on this space write over (one thread at a time)."""
        e, q = self.weights.shape
        return Workspace(
            np.empty((e, q, 3, 3)), np.empty((e, q, 3, 3)), np.empty((e, q, 3, 3)), np.empty(e * q), np.empty(e * q)
        )

    @cached_property
    def facet_centres(self) -> Array:
        """Centroids of the boundary facets (k, 3) m."""
        return np.asarray(self.nodes[self.facets[:, :3]].mean(axis=1))

    def facet_rule(self, degree: int, facets: Indices | None = None) -> tuple[Array, Array, Array]:
        """Shape values (q, b), weights (k, q) m2 and outward unit normals (k, 3) on the (flat, scanned) facets."""
        corners = self.nodes[(self.facets if facets is None else facets)[:, :3]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice_area = np.linalg.norm(normal, axis=1)
        barycentric, weights = quadrature.triangle(degree)
        values = shape_values(barycentric, quadratic=self.quadratic)
        return values, 0.5 * twice_area[:, None] * weights, normal / twice_area[:, None]

    def interpolate(self, u: Array, tets: Indices, barycentric: Array) -> Array:
        """A nodal field ``u`` (n, 3) at points (m, 3) given by tetrahedron (m,) and barycentric coordinates (m, 4)."""
        values = shape_values(barycentric, quadratic=self.quadratic)
        return np.asarray(np.einsum("ma,mai->mi", values, u[self.cells[tets]]))


def make_space(mesh: TetMesh, kind: ElementKind = "p2p0", *, degree: int | None = None) -> Space:
    """Puts an element on a mesh; ``degree`` of the quadrature (default: 2 for quadratic elements, 1 for linear)."""
    if kind not in get_args(ElementKind):
        raise InputError(f"unknown element '{kind}'", remedy=f"use one of {', '.join(get_args(ElementKind))}")
    quadratic = kind != "p1"
    cells, nodes, facets = mesh.tets, mesh.nodes, mesh.boundary_triangles
    edges = np.zeros((0, 2), np.int64)
    if quadratic:
        middles, edges = number_edges(cells, TET_EDGES, len(nodes))
        facets = np.concatenate([facets, _facet_middles(facets, edges, len(nodes))], axis=1)
        cells = np.concatenate([cells, middles], axis=1)
        nodes = np.concatenate([nodes, nodes[edges].mean(axis=1)])
    barycentric, weights = quadrature.tetrahedron(degree or (2 if quadratic else 1))
    corners = mesh.nodes[mesh.tets]
    jacobian = corners[:, 1:] - corners[:, :1]  # rows dX/dL_k, k = 1..3
    frames = np.linalg.inv(jacobian).transpose(0, 2, 1)  # rows dL_k/dX
    dN = shape_derivatives(barycentric, quadratic=quadratic)
    return Space(
        mesh=mesh,
        kind=kind,
        nodes=nodes,
        cells=np.ascontiguousarray(cells),
        facets=np.ascontiguousarray(facets),
        edges=edges,
        values=shape_values(barycentric, quadratic=quadratic),
        slopes=np.ascontiguousarray(dN[:, :, 1:] - dN[:, :, :1]),  # L_0 = 1 - xi_1 - xi_2 - xi_3
        frames=np.repeat(frames[:, None], len(weights), axis=1),
        weights=np.linalg.det(jacobian)[:, None] / 6.0 * weights,
        barycentric=barycentric,
    )


def _facet_middles(triangles: Indices, edges: Indices, n_vertices: int) -> Indices:
    """Mid-edge node numbers (k, 3) of boundary triangles, in the order of `TRIANGLE_EDGES`."""
    keys = edges[:, 0] * n_vertices + edges[:, 1]  # sorted by construction
    pairs = np.sort(triangles[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1)
    found = np.searchsorted(keys, pairs[:, 0] * n_vertices + pairs[:, 1])
    return (found + n_vertices).reshape(len(triangles), 3)
