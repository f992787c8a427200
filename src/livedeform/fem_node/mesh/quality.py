"""Measure how good a tetrahedral mesh is, and how close to the surface that it was made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.mesh.repair.record import Repair
from livedeform.fem_node.mesh.tet_mesh import IntArray, TetMesh
from livedeform.fem_node.mesh.thickness import Thickness, thinnest_part

DOUBLED = 1e-3  # of an edge: nodes of two bodies that are nearer are the same place, to what text files keep of it
# the two corners on each edge of a tetrahedron, and the two that are not
_EDGES = ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1))


@dataclass(frozen=True)
class MeshReport:
    """Size, shape and fidelity of a mesh; lengths in m, volumes in m3, angles in degrees.

    ``quality`` is 3 x inscribed / circumscribed radius (1: regular, 0: flat). ``surface_distance_*`` is between the
    mesh's boundary and the surface, both ways, at nodes and middles of triangles; NaN where there is no surface.
    ``farthest`` (x, y, z) m is where they are ``surface_distance_max`` apart; ``digest`` names the mesh by its content;
    ``thickness`` is that of its thinnest part; ``record`` says what was done to the surface before meshing;
    ``regions`` names the material regions of a mesh file that has any.
    """

    n_nodes: int
    n_tets: int
    n_inverted: int
    n_bodies: int
    volume: float
    surface_volume: float
    edge_length_median: float
    dihedral_min_deg: float
    dihedral_max_deg: float
    quality_min: float
    quality_mean: float
    surface_distance_rms: float
    surface_distance_max: float
    farthest: tuple[float, float, float]
    digest: str
    thickness: Thickness
    record: tuple[Repair, ...] = ()
    regions: tuple[str, ...] = ()

    @property
    def repairs(self) -> tuple[str, ...]:
        """The record in words."""
        return tuple(str(repair) for repair in self.record)

    def lines(self) -> list[str]:
        """The report in words, lengths in mm."""
        lines = [
            f"{self.n_nodes} nodes, {self.n_tets} tetrahedra, {self.n_inverted} inverted, {self.n_bodies} body(ies), "
            f"hash {self.digest}",
            f"edge {1e3 * self.edge_length_median:.2f} mm (median), volume {1e6 * self.volume:.2f} cm3",
            f"dihedral angles {self.dihedral_min_deg:.1f} to {self.dihedral_max_deg:.1f} degrees, "
            f"quality {self.quality_min:.2f} (least), {self.quality_mean:.2f} (mean)",
        ]
        if np.isfinite(self.surface_distance_max):
            lines.append(
                f"against the surface: {1e3 * self.surface_distance_rms:.3f} mm rms, "
                f"{1e3 * self.surface_distance_max:.3f} mm at most, "
                f"volume {100 * (self.volume / self.surface_volume - 1):+.2f} %"
            )
        return lines + [f"repaired: {repair}" for repair in self.repairs]


def check_mesh(
    mesh: TetMesh, surface: tuple[Array, IntArray] | None = None, record: Sequence[Repair] = ()
) -> MeshReport:
    """Measure ``mesh``, against ``surface`` (vertices (n, 3), triangles (k, 3)) if there is one."""
    angles = dihedral_angles(mesh)
    quality = radius_ratios(mesh)
    edges = np.linalg.norm(mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]], axis=1)
    rms = largest = surface_volume = np.nan
    farthest = np.full(3, np.nan)
    if surface is not None:
        places, distances = surface_distances((mesh.nodes, mesh.boundary_triangles), surface)
        rms, largest = float(np.sqrt(np.mean(distances**2))), float(distances.max())
        farthest = places[int(distances.argmax())]
        surface_volume = enclosed_volume(*surface)
    return MeshReport(
        n_nodes=len(mesh.nodes),
        n_tets=len(mesh.tets),
        n_inverted=int((mesh.volumes <= 0.0).sum()),
        n_bodies=int(bodies(mesh).max()) + 1,
        volume=mesh.volume,
        surface_volume=surface_volume,
        edge_length_median=float(np.median(edges)),
        dihedral_min_deg=float(angles.min()),
        dihedral_max_deg=float(angles.max()),
        quality_min=float(quality.min()),
        quality_mean=float(quality.mean()),
        surface_distance_rms=rms,
        surface_distance_max=largest,
        farthest=(float(farthest[0]), float(farthest[1]), float(farthest[2])),
        digest=mesh.digest,
        thickness=thinnest_part(mesh.nodes, mesh.boundary_triangles),
        record=tuple(record),
    )


def dihedral_angles(mesh: TetMesh) -> Array:
    """(m, 6) degrees between the faces that meet at each edge."""
    X = mesh.nodes[mesh.tets]
    angles = []
    for i, j, k, l in _EDGES:
        edge = X[:, j] - X[:, i]
        edge = edge / np.linalg.norm(edge, axis=1, keepdims=True)
        a, b = (
            side - (side * edge).sum(1, keepdims=True) * edge for side in (X[:, k] - X[:, i], X[:, l] - X[:, i])
        )  # the parts of both faces across the edge
        cosine = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return np.stack(angles, axis=1)


def radius_ratios(mesh: TetMesh) -> Array:
    """(m,) 3 r / R of each tetrahedron: r = 3 V / area; R = |a^2 (b x c) + b^2 (c x a) + c^2 (a x b)| / 12 V."""
    X = mesh.nodes[mesh.tets]
    a, b, c = (X[:, i] - X[:, 0] for i in (1, 2, 3))
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    area = 0.5 * sum(np.linalg.norm(n, axis=1) for n in (bc, ca, ab, bc + ca + ab))
    squares = [(v * v).sum(1, keepdims=True) for v in (a, b, c)]
    circumscribed = np.linalg.norm(squares[0] * bc + squares[1] * ca + squares[2] * ab, axis=1) / (12.0 * mesh.volumes)
    return np.asarray(9.0 * mesh.volumes / area / circumscribed)


def enclosed_volume(vertices: Array, triangles: IntArray) -> float:
    """m3 inside a closed surface (positive when its triangles look outward)."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", np.cross(a, b), c) / 6.0)


def surface_distances(one: tuple[Array, IntArray], other: tuple[Array, IntArray]) -> tuple[Array, Array]:
    """Places (n, 3) m of two surfaces (vertices, triangles), nodes and middles of triangles, and how far (n,) m each is
    from the other surface."""
    places, distances = [], []
    for (points, own), (vertices, triangles) in ((one, other), (other, one)):
        places.append(np.concatenate([points[np.unique(own)], points[own].mean(1)]))
        distances.append(_distances(places[-1], vertices, triangles))
    return np.concatenate(places), np.concatenate(distances)


def _distances(probes: Array, vertices: Array, triangles: IntArray) -> Array:
    """Distances (n,) m from ``probes`` (n, 3) to a surface."""
    corners = np.ascontiguousarray(vertices[triangles])
    middles = corners.mean(1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(1)
    bounds = cKDTree(middles).query(probes)[0]  # no triangle is farther than its middle
    return np.asarray(np.sqrt(_squared_distances(probes, bounds, corners, middles, reach)))


@njit(cache=True)
def _squared_distances(points: Array, bounds: Array, corners: Array, middles: Array, reach: Array) -> Array:
    """The least squared distance of each point to the triangles; triangles out of reach are skipped."""
    out = np.empty(len(points))
    for i in range(len(points)):
        bound = bounds[i] * (1.0 + 1e-9)
        best = bound * bound
        for k in range(len(corners)):
            d0 = points[i, 0] - middles[k, 0]
            d1 = points[i, 1] - middles[k, 1]
            d2 = points[i, 2] - middles[k, 2]
            if d0 * d0 + d1 * d1 + d2 * d2 > (bound + reach[k]) ** 2:
                continue
            squared = _squared_distance(points[i], corners[k])
            if squared < best:
                best, bound = squared, np.sqrt(squared)
        out[i] = best
    return out


@njit(cache=True)
def _squared_distance(point: Array, corner: Array) -> float:
    """Return the squared distance of one point (3,) to one triangle (3, 3): of the foot of the perpendicular if it lies
    in the triangle, else of the closest of the three edges' points."""
    a, b, c = corner[0], corner[1], corner[2]
    ab, ac, ap = b - a, c - a, point - a
    d00, d01, d11 = np.dot(ab, ab), np.dot(ab, ac), np.dot(ac, ac)
    d20, d21 = np.dot(ap, ab), np.dot(ap, ac)
    denominator = d00 * d11 - d01 * d01
    if denominator > 0.0:
        v, w = (d11 * d20 - d01 * d21) / denominator, (d00 * d21 - d01 * d20) / denominator
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            gap = ap - v * ab - w * ac
            return float(np.dot(gap, gap))
    best = np.inf
    for i in range(3):
        start, edge = corner[i], corner[(i + 1) % 3] - corner[i]
        length = max(np.dot(edge, edge), 1e-300)
        t = min(max(np.dot(point - start, edge) / length, 0.0), 1.0)
        gap = point - start - t * edge
        best = min(best, np.dot(gap, gap))
    return best


def bodies(mesh: TetMesh) -> IntArray:
    """Return the number (n,) of the body that each node belongs to: what elements connect is one."""
    n = len(mesh.nodes)
    graph = coo_array((np.ones(len(mesh.edges), np.int8), (mesh.edges[:, 0], mesh.edges[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def doubled_nodes(mesh: TetMesh) -> IntArray:
    """Return the boundary's nodes (k,) where another body has one too: nothing holds the two together there."""
    body, nodes = bodies(mesh), mesh.boundary_nodes
    if not body.any():
        return np.empty(0, np.int64)
    edges = np.linalg.norm(mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]], axis=1)
    near = cKDTree(mesh.nodes[nodes]).query_pairs(DOUBLED * float(np.median(edges)), output_type="ndarray")
    pairs = nodes[near]
    return np.unique(pairs[body[pairs[:, 0]] != body[pairs[:, 1]]])
