"""Rigid probe shapes as signed distance fields in the frame ``probe``.

The frame: origin in the middle of the contact face, +z out of the face into the tissue, +x along the face's long side;
every body lies at z <= 0. ``distance`` gives the signed distance d (n,) m, negative inside the probe, its gradient n
(n, 3), a unit vector away from the probe, and its Hessian H (n, 3, 3) 1/m, the curvature of the offset surface.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.errors import InputError, MeshError
from livedeform.common.experiment.surface import check_closed, read_surface
from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features

INNER = 9  # points along each side of a probe's box, among which its innermost is looked for
FLAT, EDGE = np.deg2rad([1.0, 35.0])  # turns of a facetted round, from triangle to triangle; beyond, it is an edge
FRONT = 0.25  # of the diagonal of a probe's box: the part from its face on that a body touches
TINY = 1e-15  # m; below it a direction cannot be had from a difference of points


class Distance(NamedTuple):
    """Signed distance d (n,) m, gradient (n, 3), Hessian (n, 3, 3) 1/m."""

    d: Array
    gradient: Array
    hessian: Array


class Shape(Protocol):
    """A rigid body of the probe; its ``repr`` says all of it, so that what is kept for one is not taken for another."""

    @property
    def bounds(self) -> Array:
        """Lower and upper corner (2, 3) m of a box around the body."""

    @property
    def roundness(self) -> float:
        """The smallest radius of its edges, m; infinite where it has none."""

    def distance(self, points: Array) -> Distance:
        """Signed distance and its derivatives at ``points`` (n, 3) m in the frame ``probe``."""


@dataclass(frozen=True)
class Box:
    """A box ``length`` (x) by ``width`` (y) by ``height`` (from the face to -z), all edges rounded by ``edge_radius``.

    The distance of a rounded box is that of a box smaller by r on all sides, less r (I. Quilez, distance functions).
    """

    length: float
    width: float
    height: float
    edge_radius: float = 0.0

    def __post_init__(self) -> None:
        _check_sizes("box", (self.length, self.width, self.height), self.edge_radius)

    @property
    def bounds(self) -> Array:
        return np.array([[-self.length / 2, -self.width / 2, -self.height], [self.length / 2, self.width / 2, 0.0]])

    @property
    def roundness(self) -> float:
        return self.edge_radius

    def distance(self, points: Array) -> Distance:
        low, high = self.bounds
        middle, q = (low + high) / 2, np.empty((len(points), 3))
        _folded(points, middle, (high - low) / 2 - self.edge_radius, q)
        d, n, H = _rounded_orthant(q)
        _unfolded(points, middle, n, H)
        return Distance(d - self.edge_radius, n, H)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about z: ``radius``, ``height`` from the face towards -z, both rims rounded by ``edge_radius``.

    The distance is that of a rounded rectangle in the half plane (rho, z); turning it about z adds the hoop curvature
    n_rho / rho.
    """

    radius: float
    height: float
    edge_radius: float = 0.0

    def __post_init__(self) -> None:
        _check_sizes("cylinder", (2 * self.radius, self.height), self.edge_radius)

    @property
    def bounds(self) -> Array:
        return np.array([[-self.radius, -self.radius, -self.height], [self.radius, self.radius, 0.0]])

    @property
    def roundness(self) -> float:
        return self.edge_radius

    def distance(self, points: Array) -> Distance:
        r, rho = self.edge_radius, np.hypot(points[:, 0], points[:, 1])
        axial = points[:, 2] + self.height / 2
        q = np.column_stack([rho - (self.radius - r), np.abs(axial) - (self.height / 2 - r)])
        d, n, H = _rounded_orthant(q)
        gradient, hessian = np.empty((len(d), 3)), np.empty((len(d), 3, 3))
        _turned(points, rho, axial, n, H, gradient, hessian)
        return Distance(d - r, gradient, hessian)


@dataclass(frozen=True)
class Sphere:
    """A sphere of ``radius`` whose lowest point (largest z) is the origin: centre at (0, 0, -radius)."""

    radius: float

    def __post_init__(self) -> None:
        _check_sizes("sphere", (2 * self.radius,), 0.0)

    @property
    def bounds(self) -> Array:
        r = self.radius
        return np.array([[-r, -r, -2 * r], [r, r, 0.0]])

    @property
    def roundness(self) -> float:
        return self.radius

    def distance(self, points: Array) -> Distance:
        d, n, H = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        _from_centre(points, np.array([0.0, 0.0, -self.radius]), self.radius, d, n, H)
        return Distance(d, n, H)


@dataclass(frozen=True)
class TriangleSolid:
    """A closed triangle surface, ``vertices`` (n, 3) m and outward ``triangles`` (m, 3), in the frame ``probe``.

    Distance to the nearest vertex, edge or face, signed by that feature's angle-weighted pseudo-normal
    (Baerentzen & Aanaes 2005), searched in a tree of boxes. Its edges are as sharp as the file has them.
    """

    vertices: Array
    triangles: np.ndarray

    def __repr__(self) -> str:
        """Return its sizes and a hash of its content: an array's own repr leaves numbers out."""
        content = hashlib.sha256(np.ascontiguousarray(self.vertices, "<f8").tobytes())
        content.update(np.ascontiguousarray(self.triangles, "<i8").tobytes())
        sizes = f"{len(self.vertices)} vertices, {len(self.triangles)} triangles"
        return f"{type(self).__name__}({sizes}, {content.hexdigest()[:32]})"

    @property
    def bounds(self) -> Array:
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def roundness(self) -> float:
        """The smallest radius of the ridges of its front, m: how far triangles on both sides reach over the angle by
        which they turn, as of a facetted round; nothing where they turn by more than a facetted round's do."""
        import trimesh

        mesh = trimesh.Trimesh(self.vertices, self.triangles, process=False)
        ridge = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > FLAT)
        lowest = self.bounds[1, 2] - FRONT * np.linalg.norm(np.ptp(self.bounds, axis=0))
        ridge &= self.vertices[mesh.face_adjacency_edges][..., 2].max(axis=1) > lowest
        if not ridge.any():
            return float("inf")
        pairs, turns = mesh.face_adjacency[ridge], mesh.face_adjacency_angles[ridge]
        if turns.max() > EDGE:
            return 0.0
        length = np.linalg.norm(np.diff(self.vertices[mesh.face_adjacency_edges[ridge]], axis=1)[:, 0], axis=1)
        reach = 2.0 / 3.0 * mesh.area_faces[pairs].sum(axis=1) / length  # of both middles from the edge
        return float(np.min(reach / turns))

    @cached_property
    def _tree(self) -> TriangleTree:
        return TriangleTree.build(self.vertices, self.triangles)

    def distance(self, points: Array) -> Distance:
        closest, pseudo_normal, along, kind = closest_features(self._tree, np.ascontiguousarray(points, dtype=float))
        offset = points - closest
        length = np.linalg.norm(offset, axis=1)
        sign = np.where(np.einsum("ni,ni->n", offset, pseudo_normal) < 0, -1.0, 1.0)
        unit = offset / np.maximum(length, TINY)[:, None] * sign[:, None]
        n = np.where((length > 1e-12)[:, None], unit, pseudo_normal)
        d = sign * length
        round_ = (kind > 0) & (length > 1e-9)  # an edge (1) is curved across, a vertex (2) both ways, a face (0) not
        across = np.eye(3) - outer(n, n) - outer(along, along)
        hessian = np.where(round_, 1.0 / np.where(round_, d, 1.0), 0.0)[:, None, None] * across
        return Distance(d, n, hessian)


def innermost(shape: Shape) -> Array:
    """The point (3,) m of a grid over the shape that is deepest inside it, in the frame ``probe``."""
    low, high = shape.bounds
    at = (np.arange(INNER) + 0.5) / INNER
    grid = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    points = low + grid * (high - low)
    return np.asarray(points[np.argmin(shape.distance(points).d)])


def make_shape(kind: str, size: object, edge_radius: float = 0.0) -> Shape:
    """The shape of an experiment's ``probe.shape: {kind: size}``.

    ``size``: box [length, width, height], cylinder [radius, height], sphere radius, mesh (vertices, triangles) or a
    path (m). ``edge_radius`` rounds boxes and cylinders; a sphere and a mesh have none.
    """
    makers = {"box": _make_box, "cylinder": _make_cylinder, "sphere": _make_sphere, "mesh": _make_mesh}
    if kind not in makers:
        raise InputError(
            f"probe shape '{kind}' is not known", where="probe.shape", remedy=f"use one of {', '.join(makers)}"
        )
    return makers[kind](size, edge_radius)


def _make_box(size, edge_radius: float) -> Shape:
    length, width, height = (float(s) for s in size)
    return Box(length, width, height, edge_radius)


def _make_cylinder(size, edge_radius: float) -> Shape:
    radius, height = (float(s) for s in size)
    return Cylinder(radius, height, edge_radius)


def _make_sphere(size, edge_radius: float) -> Shape:
    return Sphere(float(np.asarray(size, dtype=float).reshape(-1)[0]))


def _make_mesh(size, edge_radius: float) -> Shape:
    """Return a closed mesh as a solid, whichever way its triangles look: inside out it would push from within."""
    from livedeform.fem_node.mesh.repair.shells import outermost
    from livedeform.fem_node.mesh.surface import LARGEST, SMALLEST

    where = "probe.shape.mesh"
    if isinstance(size, str | Path):
        where, surface = str(size), read_surface(Path(size))
        size = surface.vertices, surface.triangles
    vertices, triangles = np.asarray(size[0], dtype=float), np.asarray(size[1], dtype=np.int64)
    check_closed(vertices, triangles, Path(where))
    across = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SMALLEST <= across <= LARGEST:
        raise MeshError(f"the probe is {across:.4g} m across", where=where, remedy="scale the file: it is in metres")
    return TriangleSolid(vertices, outermost(vertices, triangles))


def _rounded_orthant(q: Array) -> tuple[Array, Array, Array]:
    """Distance, gradient and Hessian of max-norm-inside, Euclid-outside: d = |max(q, 0)| + min(max_i q_i, 0).

    ``q`` (n, k) m: how far a point is beyond each of k planes that meet at right angles.
    """
    n_points, k = q.shape
    d, gradient, hessian = np.empty(n_points), np.zeros((n_points, k)), np.zeros((n_points, k, k))
    _orthant(np.ascontiguousarray(q), d, gradient, hessian)
    return d, gradient, hessian


@njit(cache=True)
def _orthant(q, d, gradient, hessian):
    n_points, k = q.shape
    for n in range(n_points):
        furthest, beyond, square = 0, 0, 0.0
        for i in range(k):
            if q[n, i] > q[n, furthest]:
                furthest = i
            if q[n, i] > 0.0:
                beyond += 1
                square += q[n, i] * q[n, i]
        if beyond == 0:
            d[n] = q[n, furthest]
            gradient[n, furthest] = 1.0
            continue
        d[n] = np.sqrt(square)
        for i in range(k):
            if q[n, i] > 0.0:
                gradient[n, i] = q[n, i] / d[n]
        if beyond == 1:
            continue
        for i in range(k):
            for j in range(k):
                unit = 1.0 if i == j and q[n, i] > 0.0 else 0.0
                hessian[n, i, j] = (unit - gradient[n, i] * gradient[n, j]) / d[n]


@njit(cache=True)
def _folded(points, middle, half, q):
    """Finds how far the ``points`` (k, 3) are beyond the three planes at ``half`` of a box on their side of its
    ``middle``, ``q`` (k, 3)."""
    for k in range(len(points)):
        for i in range(3):
            q[k, i] = abs(points[k, i] - middle[i]) - half[i]


@njit(cache=True)
def _unfolded(points, middle, n, H):
    """Turns gradients ``n`` (k, 3) and Hessians ``H`` (k, 3, 3) back to the side on which the ``points`` are."""
    for k in range(len(points)):
        for i in range(3):
            if points[k, i] < middle[i]:
                n[k, i] = -n[k, i]
                for j in range(3):
                    if j != i:
                        H[k, i, j], H[k, j, i] = -H[k, i, j], -H[k, j, i]


@njit(cache=True)
def _from_centre(points, centre, radius, d, n, H):
    """Finds distance, gradient and Hessian of a sphere's field at the ``points`` (k, 3)."""
    for k in range(len(points)):
        square = 0.0
        for i in range(3):
            square += (points[k, i] - centre[i]) ** 2
        length = max(np.sqrt(square), TINY)
        d[k] = length - radius
        for i in range(3):
            n[k, i] = (points[k, i] - centre[i]) / length
        for i in range(3):
            for j in range(3):
                H[k, i, j] = ((1.0 if i == j else 0.0) - n[k, i] * n[k, j]) / length


@njit(cache=True)
def _turned(points, rho, axial, n, H, gradient, hessian):
    """Turns gradients ``n`` (k, 2) and Hessians ``H`` (k, 2, 2) in the half plane (rho, |axial|) about z."""
    for k in range(len(rho)):
        safe = max(rho[k], TINY)
        out = (points[k, 0] / safe, points[k, 1] / safe, 0.0)
        round_ = (-out[1], out[0], 0.0)
        up = (0.0, 0.0, -1.0 if axial[k] < 0 else 1.0)
        hoop = n[k, 0] / safe if rho[k] > 1e-9 else 0.0
        for i in range(3):
            gradient[k, i] = n[k, 0] * out[i] + n[k, 1] * up[i]
            for j in range(3):
                hessian[k, i, j] = (
                    H[k, 0, 0] * out[i] * out[j]
                    + H[k, 0, 1] * (out[i] * up[j] + up[i] * out[j])
                    + H[k, 1, 1] * up[i] * up[j]
                    + hoop * round_[i] * round_[j]
                )


def outer(a: Array, b: Array) -> Array:
    """Return the products a b^T (n, 3, 3) of vectors (n, 3)."""
    return a[:, :, None] * b[:, None, :]


def _check_sizes(kind: str, sizes: tuple[float, ...], edge_radius: float) -> None:
    if min(sizes) <= 0:
        raise InputError(f"a {kind}'s sizes must be positive, not {sizes}", where="probe.shape", remedy="correct them")
    if not 0 <= edge_radius < min(sizes) / 2:
        raise InputError(
            f"edge radius {edge_radius:g} m does not fit a {kind} of {min(sizes):g} m",
            where="probe.edge_radius",
            remedy="use less than half the smallest side",
        )
