"""Closed triangle surfaces: reading them, and how far from and how deep inside them a point lies. Metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from livedeform.common.errors import MeshError
from livedeform.common.types import Array

METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3}
LOOSE = 0.5  # of the edges; of an open scan only those at its rims belong to one triangle


@dataclass(frozen=True)
class Surface:
    """A closed surface with outward orientation: ``vertices`` (n, 3) m, ``triangles`` (k, 3) rows of ``vertices``."""

    vertices: Array
    triangles: NDArray[np.int64]

    @property
    def corners(self) -> Array:
        """(k, 3, 3) m: triangle, corner, coordinate."""
        return self.vertices[self.triangles]

    @property
    def lower(self) -> Array:
        return np.asarray(self.vertices.min(axis=0))

    @property
    def upper(self) -> Array:
        return np.asarray(self.vertices.max(axis=0))

    @property
    def diagonal(self) -> float:
        """Return the diagonal of the box around it, m."""
        return float(np.linalg.norm(self.upper - self.lower))

    @property
    def volume(self) -> float:
        """Enclosed volume in m3, V = sum a . (b x c) / 6 over the triangles (divergence theorem)."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def distance(self, points: Array) -> Array:
        """Distance (n,) m of ``points`` (n, 3) from the nearest point of the surface, >= 0 on both sides."""
        from trimesh.triangles import closest_point

        corners = self.corners
        centres = corners.mean(axis=1)
        radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
        distances = np.empty(len(points))
        for i, point in enumerate(points):
            to_centre = np.linalg.norm(centres - point, axis=1)
            near = to_centre - radii <= to_centre.min()  # no other triangle can be nearer
            nearest = closest_point(corners[near], np.broadcast_to(point, (int(near.sum()), 3)))
            distances[i] = np.linalg.norm(nearest - point, axis=1).min()
        return distances

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Inside (n,): winding number > 1/2, from the triangles' solid angles (Van Oosterom & Strackee 1983)."""
        inside = np.empty(len(points), bool)
        for i, point in enumerate(points):
            a, b, c = np.moveaxis(self.corners - point, 1, 0)
            la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
            numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
            denominator = (
                la * lb * lc
                + np.einsum("ij,ij->i", a, b) * lc
                + np.einsum("ij,ij->i", b, c) * la
                + np.einsum("ij,ij->i", c, a) * lb
            )
            inside[i] = np.arctan2(numerator, denominator).sum() / (2.0 * np.pi) > 0.5
        return inside

    def meets_box(self, lower: Array, upper: Array) -> bool:
        """Return whether a triangle reaches into the box between two corners (3,) m: no axis parts them (Akenine-Moller
        2001)."""
        middle, half, corners = (lower + upper) / 2.0, (0.5 + 1e-9) * (upper - lower), self.corners
        corners = corners[((corners.min(axis=1) <= upper) & (corners.max(axis=1) >= lower)).all(axis=1)] - middle
        edges = np.roll(corners, -1, axis=1) - corners
        across = np.cross(edges[:, :, None], np.eye(3)).reshape(-1, 9, 3)
        axes = np.concatenate([np.cross(edges[:, 0], edges[:, 1])[:, None], across], axis=1)
        along, reach = np.einsum("kcj,kaj->kac", corners, axes), np.abs(axes) @ half
        return bool(((along.min(axis=2) <= reach) & (along.max(axis=2) >= -reach)).all(axis=1).any())


def read_surface(path: Path, unit: str = "m") -> Surface:
    """The closed surface in an STL, OBJ or PLY file, scaled to metres; ``MeshError`` if it is not closed.

    Triangles that point inwards are turned: closed is what meshing needs, orientation can be mended without a guess.
    """
    import trimesh

    try:
        loaded = trimesh.load_mesh(str(path), process=True)
    except Exception as error:  # trimesh's loaders raise whatever their parsers raise
        raise MeshError(
            f"cannot be read as a surface ({error})", where=str(path), remedy="write it as STL, OBJ or PLY"
        ) from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise MeshError("holds no triangles", where=str(path), remedy="export the surface as triangles, whole")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    loaded.update_faces(loaded.nondegenerate_faces())
    check_closed(np.asarray(loaded.vertices), np.asarray(loaded.faces), path)
    if not loaded.is_winding_consistent or loaded.volume < 0:
        trimesh.repair.fix_normals(loaded, multibody=True)
    vertices = np.asarray(loaded.vertices, float) * METRES_PER_UNIT[unit]
    return Surface(vertices, np.asarray(loaded.faces, np.int64))


def read_mesh_boundary(path: Path, unit: str = "m") -> Surface:
    """The boundary of a tetrahedral mesh in any format of meshio's, scaled to metres."""
    import meshio

    try:
        mesh = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio ends the program on an unknown format
        raise MeshError(
            f"cannot be read as a mesh ({error})", where=str(path), remedy="write it as VTK (.vtu, .vtk) or gmsh (.msh)"
        ) from error
    blocks = [block.data for block in mesh.cells if block.type in ("tetra", "tetra10")]
    if not blocks:
        found = ", ".join(sorted({block.type for block in mesh.cells})) or "nothing"
        raise MeshError(
            f"holds no tetrahedra ({found})", where=str(path), remedy="name triangles as phantom.surface instead"
        )
    tets = np.vstack([block[:, :4] for block in blocks])
    points = np.asarray(mesh.points, float) * METRES_PER_UNIT[unit]
    return Surface(points, _boundary(points, tets))


def _boundary(points: Array, tets: NDArray[np.int64]) -> NDArray[np.int64]:
    """The faces (k, 3) that belong to one tetrahedron only, oriented outward."""
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    tets = np.where(np.linalg.det(edges)[:, None] < 0, tets[:, [0, 2, 1, 3]], tets)
    faces = np.vstack([tets[:, [1, 2, 3]], tets[:, [0, 3, 2]], tets[:, [0, 1, 3]], tets[:, [0, 2, 1]]])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[first[count == 1]], np.int64)


def check_closed(vertices: Array, triangles: NDArray[np.int64], path: Path) -> None:
    """Every edge of a closed surface belongs to an even number of triangles; if not, ``MeshError`` with the count, and
    with the place of the largest hole in the file's unit (``vertices`` (n, 3))."""
    refuse_loose(triangles, str(path))
    edges, count = _edges_of(triangles)
    is_open = count % 2 == 1
    if is_open.any():
        holes, (x, y, z) = _holes(vertices, edges[is_open])
        where = "the hole" if holes == 1 else f"the largest of {holes} holes"
        raise MeshError(
            f"the surface is not closed: {is_open.sum()} of {len(count)} edges lie on a hole's border; {where} is "
            f"about ({x:.4g}, {y:.4g}, {z:.4g}) in the file",
            where=str(path),
            remedy="close the holes, for example with MeshLab's 'Close Holes'",
        )


def _holes(vertices: Array, edges: NDArray[np.int64]) -> tuple[int, Array]:
    """Return how many holes have the border ``edges`` (e, 2), and the middle (3,) of the one with the most of them."""
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices), len(vertices)))
    of_vertex = connected_components(graph, directed=False)[1][edges[:, 0]]
    numbers, counts = np.unique(of_vertex, return_counts=True)
    border = vertices[edges[of_vertex == numbers[counts.argmax()]]]
    return len(numbers), np.asarray(border.reshape(-1, 3).mean(axis=0))


def refuse_loose(triangles: NDArray[np.int64], where: str) -> None:
    """``MeshError`` for triangles (k, 3) most of which hang together with no other: they have no holes to close."""
    _, count = _edges_of(triangles)
    loose = int((count == 1).sum())
    if loose > LOOSE * len(count):
        raise MeshError(
            f"the triangles do not hang together: {loose} of {len(count)} edges belong to one alone",
            where=where,
            remedy="join corners that lie close to one another, for example with MeshLab's 'Merge Close Vertices'",
        )


def _edges_of(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges (e, 2), by the numbers of their ends, and how many triangles (e,) each belongs to."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    n = int(triangles.max()) + 1
    codes, counts = np.unique(edges @ [n, 1], return_counts=True)
    return np.column_stack([codes // n, codes % n]), np.asarray(counts, np.int64)
