"""A mesh of linear tetrahedra, and where points lie in it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.errors import MeshError
from livedeform.common.experiment.smooth_surface import corner_normals
from livedeform.common.types import Array
from livedeform.fem_node.mesh.facing import facing
from livedeform.fem_node.mesh.triangle_distance import closest_on_triangle

IntArray = NDArray[np.int64]

# the faces of a tetrahedron of positive volume, outward
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@dataclass(frozen=True)
class TetMesh:
    """``nodes`` (n, 3) m and ``tets`` (m, 4) into them, every tetrahedron of positive volume.

    Vertices only: quadratic elements add their own mid-edge nodes. ``TetMesh.oriented`` takes any order.
    """

    nodes: Array
    tets: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", np.ascontiguousarray(self.nodes, dtype=np.float64))
        object.__setattr__(self, "tets", np.ascontiguousarray(self.tets, dtype=np.int64))
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 3 or self.tets.ndim != 2 or self.tets.shape[1] != 4:
            raise MeshError(
                f"a mesh has nodes (n, 3) and tetrahedra (m, 4), not {self.nodes.shape} and {self.tets.shape}"
            )
        if len(self.tets) == 0:
            raise MeshError("the mesh has no tetrahedra")
        if self.tets.min() < 0 or self.tets.max() >= len(self.nodes):
            raise MeshError("a tetrahedron names a node that does not exist")
        bad = int(np.argmin(self.volumes))
        if not self.volumes[bad] > 0.0:
            raise MeshError(
                f"tetrahedron {bad} has the volume {self.volumes[bad]:.3g} m3",
                where=f"at {np.round(self.nodes[self.tets[bad]].mean(0), 5).tolist()}",
                remedy="mesh again, or drop flat tetrahedra and order the others with TetMesh.oriented",
            )

    @classmethod
    def oriented(cls, nodes: Array, tets: IntArray) -> TetMesh:
        """A mesh with negative tetrahedra turned round and unused nodes dropped."""
        tets = np.array(tets, dtype=np.int64)
        negative = tet_volumes(nodes, tets) < 0.0
        tets[negative] = tets[negative][:, [0, 2, 1, 3]]
        used, renumbered = np.unique(tets, return_inverse=True)
        return cls(np.asarray(nodes, float)[used], renumbered.reshape(tets.shape))

    @cached_property
    def volumes(self) -> Array:
        """(m,) m3 of each tetrahedron."""
        return tet_volumes(self.nodes, self.tets)

    @property
    def volume(self) -> float:
        """m3 of the body."""
        return float(self.volumes.sum())

    @cached_property
    def digest(self) -> str:
        """The mesh's content as a hash: nodes to 1 pm (what text files keep of them), tetrahedra in their order."""
        content = hashlib.sha256(np.round(1e12 * self.nodes).astype("<i8").tobytes())
        content.update(self.tets.astype("<i8").tobytes())
        return content.hexdigest()[:16]

    @cached_property
    def _boundary(self) -> tuple[IntArray, IntArray]:
        faces = self.tets[:, FACES].reshape(-1, 3)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        outer = np.sort(first[count == 1])
        return faces[outer], outer // 4

    @property
    def boundary_triangles(self) -> IntArray:
        """(k, 3) nodes of the surface's triangles, outward."""
        return self._boundary[0]

    @property
    def boundary_tets(self) -> IntArray:
        """(k,) the tetrahedron behind each boundary triangle."""
        return self._boundary[1]

    @cached_property
    def corner_normals(self) -> Array:
        """(k, 3, 3) at the corners of the boundary triangles, of the smooth surface that they stand for."""
        return corner_normals(self.nodes, self.boundary_triangles)

    @cached_property
    def facing_triangles(self) -> IntArray:
        """(f,) rows of the boundary triangles that look at one another across a gap: none of most bodies."""
        return facing(self.nodes, self.boundary_triangles)

    @cached_property
    def boundary_nodes(self) -> IntArray:
        """Sorted nodes of the surface."""
        return np.unique(self.boundary_triangles)

    @cached_property
    def edges(self) -> IntArray:
        """(e, 2) every edge once, the lower node first."""
        pairs = self.tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
        return np.unique(np.sort(pairs, axis=1), axis=0)


class Location(NamedTuple):
    """Places of points in the mesh: ``tet`` (n,), ``barycentric`` (n, 4) in it, ``offset`` (n, 3) m from there to the
    point.

    The offset is zero for a point of the body. A point outside sits on the nearest point of the surface, ``tet`` is
    the tetrahedron behind it, and the offset (in the reference configuration) turns with the surface.
    """

    tet: IntArray
    barycentric: Array
    offset: Array


def tet_volumes(nodes: Array, tets: IntArray) -> Array:
    """(m,) signed volumes, m3."""
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0)


def locate(mesh: TetMesh, points: Array) -> Location:
    """Find each of ``points`` (n, 3) m in ``mesh``; those outside are put on the nearest point of the surface."""
    points = np.atleast_2d(np.asarray(points, float))
    origin = mesh.nodes[mesh.tets[:, 0]]
    edges = np.swapaxes(mesh.nodes[mesh.tets[:, 1:]] - origin[:, None], 1, 2)
    inverse: Array = np.asarray(np.linalg.inv(edges), np.float64)
    tet = np.empty(len(points), np.int64)
    _deepest(np.ascontiguousarray(points), origin, inverse, tet)
    barycentric = np.empty((len(points), 4))
    barycentric[:, 1:] = np.einsum("nij,nj->ni", inverse[tet], points - origin[tet])
    barycentric[:, 0] = 1.0 - barycentric[:, 1:].sum(1)
    offset = np.zeros((len(points), 3))
    outside = np.flatnonzero(barycentric.min(1) < -1e-9)
    triangle, on_surface = _nearest_on_triangles(points[outside], mesh.nodes[mesh.boundary_triangles])
    tet[outside] = mesh.boundary_tets[triangle]
    local = np.einsum("nij,nj->ni", inverse[tet[outside]], on_surface - origin[tet[outside]])
    barycentric[outside] = np.column_stack([1.0 - local.sum(axis=1), local])
    offset[outside] = points[outside] - on_surface
    return Location(tet, barycentric, offset)


@njit(cache=True)
def _deepest(points: Array, origin: Array, inverse: Array, tet: IntArray) -> None:
    """Finds the tetrahedron in which each point's least barycentric coordinate is largest."""
    for i in range(len(points)):
        best = -np.inf
        for m in range(len(origin)):
            least = rest = 1.0
            for j in range(3):
                local = 0.0
                for k in range(3):
                    local += inverse[m, j, k] * (points[i, k] - origin[m, k])
                least, rest = min(least, local), rest - local
                if least <= best:
                    break
            least = min(least, rest)
            if least > best:
                best, tet[i] = least, m


def _nearest_on_triangles(points: Array, corners: Array) -> tuple[IntArray, Array]:
    """Find the nearest of the triangles ``corners`` (k, 3, 3) to ``points`` (n, 3): (n,), and the nearest points on
    them (n, 3)."""
    triangle, nearest = np.empty(len(points), np.int64), np.empty((len(points), 3))
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    _nearest(np.ascontiguousarray(points), np.ascontiguousarray(corners), centres, radii, triangle, nearest)
    return triangle, nearest


@njit(cache=True)
def _nearest(points: Array, corners: Array, centres: Array, radii: Array, triangle: IntArray, nearest: Array) -> None:
    for i in range(len(points)):
        best = np.inf
        for k in range(len(corners)):
            reach, square = best + radii[k], 0.0
            for j in range(3):
                square += (points[i, j] - centres[k, j]) ** 2
            if square >= reach * reach:
                continue
            at, _ = closest_on_triangle(points[i], corners[k, 0], corners[k, 1], corners[k, 2])
            away = 0.0
            for j in range(3):
                away += (points[i, j] - at[j]) ** 2
            away = np.sqrt(away)
            if away < best:
                best, triangle[i] = away, k
                nearest[i] = at


def join(*meshes: TetMesh) -> TetMesh:
    """Several meshes as one that holds them as separate bodies: coincident nodes are not merged."""
    starts = np.cumsum([0, *(len(mesh.nodes) for mesh in meshes)])
    nodes = np.concatenate([mesh.nodes for mesh in meshes])
    return TetMesh(nodes, np.concatenate([mesh.tets + start for mesh, start in zip(meshes, starts, strict=False)]))
