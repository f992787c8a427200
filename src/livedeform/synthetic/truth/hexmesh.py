"""Structured meshes of 27-node hexahedra: blocks, and hemi-ellipsoids as a core with shells round it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import MeshError
from livedeform.common.types import Array

IntArray = NDArray[np.int64]

# local nodes are numbered 9 i + 3 j + k over the 3 x 3 x 3 lattice; the six sides as 3 x 3 lattices, looking outward
_LATTICE = np.arange(27).reshape(3, 3, 3)
_SIDES = (
    _LATTICE[0].T,
    _LATTICE[2],
    _LATTICE[:, 0],
    _LATTICE[:, 2].T,
    _LATTICE[:, :, 0].T,
    _LATTICE[:, :, 2],
)


@dataclass(frozen=True)
class HexMesh:
    """``nodes`` (n, 3) m; ``hexes`` (m, 27); ``faces`` (k, 9) of the boundary, 3 x 3 lattices whose normal
    (first lattice direction x second) looks outward."""

    nodes: Array
    hexes: IntArray
    faces: IntArray

    @classmethod
    def of(cls, nodes: Array, hexes: IntArray) -> HexMesh:
        """Turn left-handed elements round and find the boundary."""
        origin = nodes[hexes[:, 13]]
        along = [nodes[hexes[:, j]] - origin for j in (22, 16, 14)]
        left = np.einsum("ij,ij->i", np.cross(along[0], along[1]), along[2]) < 0.0
        hexes = hexes.copy()
        hexes[left] = hexes[left][:, _LATTICE[::-1].reshape(-1)]
        faces = np.concatenate([hexes[:, side.reshape(-1)] for side in _SIDES])
        _, first, count = np.unique(faces[:, 4], return_index=True, return_counts=True)  # by the side's middle node
        return cls(nodes, hexes, faces[np.sort(first[count == 1])])


def block(size: Sequence[float], n: Sequence[int], focus: float = 1.0) -> HexMesh:
    """A block of ``size`` (3) m in ``n`` (3) elements, the base's middle at the origin.

    ``focus`` > 1 makes the elements finer towards the middle (x, y) and the top (z) by that factor or so.
    """
    places, hexes = lattice((n[0], n[1], n[2]))
    p = 2.0 * places - 1.0
    a = 1.0 - 1.0 / focus
    p[:, :2] = (1.0 - a) * p[:, :2] + a * np.sign(p[:, :2]) * np.abs(p[:, :2]) ** 1.7
    z = places[:, 2]
    p[:, 2] = (1.0 - a) * z + a * (1.0 - (1.0 - z) ** 1.4)
    return HexMesh.of(p * np.array([size[0] / 2, size[1] / 2, size[2]]), hexes)


def bent_slab(size: Sequence[float], n: Sequence[int], radius: float, focus: float = 1.0) -> HexMesh:
    """A block of ``size`` (3) m in ``n`` (3) elements, its length bent round a vertical axis ``radius`` m off."""
    straight = block(size, n, focus)
    x, y, z = straight.nodes.T
    bent = np.stack([(radius + y) * np.sin(x / radius), (radius + y) * np.cos(x / radius) - radius, z], axis=1)
    return HexMesh(bent, straight.hexes, straight.faces)


def hemi_ellipsoid(semi_axes: Sequence[float], n: int, n_shells: int, focus: float = 1.0) -> HexMesh:
    """The half z >= 0 of an ellipsoid: a core of n x n x n/2 elements in ``n_shells`` shells. Curved elements.

    ``focus`` > 1 makes the elements finer towards the top by that factor or so.
    """
    if n % 2:
        raise MeshError(f"a hemi-ellipsoid needs an even number of elements across, not {n}")
    places, core = lattice((n, n, n // 2))
    a = 1.0 - 1.0 / focus
    middle = 2.0 * places[:, :2] - 1.0
    middle = (1.0 - a) * middle + a * middle * np.abs(middle)
    p = np.column_stack([middle, places[:, 2]])
    direction, nodes = directions(p), rounded(p)
    faces = HexMesh.of(p, core).faces
    faces = faces[~(np.abs(p[faces][:, :, 2]) < 1e-12).all(1)]
    rim = np.unique(faces)
    layers = [nodes]
    for s in range(1, 2 * n_shells + 1):
        t = (s / (2 * n_shells)) ** 0.9
        layers.append((1.0 - t) * nodes[rim] + t * direction[rim])
    hexes = np.concatenate([core, shells(faces, layers_round(len(p), rim, 2 * n_shells))])
    return HexMesh.of(np.concatenate(layers) * np.asarray(semi_axes, float), hexes)


def layers_round(n_core: int, rim: IntArray, n_layers: int) -> list[IntArray]:
    """Return the node (n_core,) that stands for each of a core's nodes, in the core and in ``n_layers`` layers of its
    ``rim`` (k,) that are numbered after it."""
    number = np.zeros(n_core, np.int64)
    number[rim] = np.arange(len(rim))
    return [np.arange(n_core), *(number + n_core + k * len(rim) for k in range(n_layers))]


def shells(faces: IntArray, layers: Sequence[IntArray]) -> IntArray:
    """Return the elements (m, 27) of shells on a core's ``faces`` (k, 9): each has three of the ``layers``, the last of
    which is the next one's first."""
    of_shells = [layers[k : k + 3] for k in range(0, len(layers) - 2, 2)]
    return np.concatenate([np.concatenate([layer[faces] for layer in three], axis=1) for three in of_shells])


def directions(p: Array) -> Array:
    """Return places (n, 3) of the cube of half edge 1 as they are on a ball of radius 1 that it is wrapped round."""
    wrapped = np.tan(np.pi / 4 * p / np.maximum(np.abs(p).max(1), 1e-12)[:, None])
    return np.asarray(wrapped / np.maximum(np.linalg.norm(wrapped, axis=1), 1e-12)[:, None])


def rounded(p: Array) -> Array:
    """Return the places (n, 3) of the cube of half edge 1 as the rounded core of a ball of radius 1."""
    return np.asarray(0.3 * p + 0.27 * np.abs(p).max(1)[:, None] * directions(p))


def lattice(n: tuple[int, int, int]) -> tuple[Array, IntArray]:
    """Return the nodes of the unit cube at half-element steps, and its elements (.., 27)."""
    counts = [2 * k + 1 for k in n]
    i, j, k = np.meshgrid(*(np.arange(c) for c in counts), indexing="ij")
    nodes = np.stack([i / (2 * n[0]), j / (2 * n[1]), k / (2 * n[2])], axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(counts)
    corners = [
        number[a : a + 2 * n[0] - 1 : 2, b : b + 2 * n[1] - 1 : 2, c : c + 2 * n[2] - 1 : 2].reshape(-1)
        for a in range(3)
        for b in range(3)
        for c in range(3)
    ]
    return nodes, np.stack(corners, axis=1)


def surface_triangles(mesh: HexMesh, n: int) -> tuple[Array, IntArray, IntArray]:
    """The boundary cut into 2 n^2 triangles per face.

    Returns weights (p, 9) and faces (p,) with point p = weights[p] @ nodes[mesh.faces[faces[p]]], welded, and the
    triangles (k, 3), outward.
    """
    s = np.linspace(-1.0, 1.0, n + 1)
    local = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = face_shape(local)
    points = np.einsum("pa,fad->fpd", weights, mesh.nodes[mesh.faces]).reshape(-1, 3)
    scale = 1e-6 * float(np.ptp(mesh.nodes, axis=0).max())
    _, first, inverse = np.unique(
        np.round(points / scale).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    grid = np.arange(len(local)).reshape(n + 1, n + 1)
    a, b, c, d = (x.reshape(-1) for x in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    own = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    triangles = (own[None] + len(local) * np.arange(len(mesh.faces))[:, None, None]).reshape(-1, 3)
    triangles = inverse.reshape(-1)[triangles]
    face = np.repeat(np.arange(len(mesh.faces)), len(local))
    return np.tile(weights, (len(mesh.faces), 1))[first], face[first], triangles


def point_normals(points: Array, triangles: IntArray) -> Array:
    """Return the outward unit normals (n, 3) of a surface at its ``points`` (n, 3), the mean of its triangles there."""
    p = points[triangles]
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    out = np.zeros_like(points)
    for i in range(3):
        np.add.at(out, triangles[:, i], face)
    normals: Array = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-15)
    return normals


def lagrange(s: Array) -> tuple[Array, Array]:
    """The three quadratic Lagrange polynomials on -1, 0, 1 at ``s`` (q,): values and derivatives (q, 3)."""
    values = np.stack([0.5 * s * (s - 1.0), 1.0 - s * s, 0.5 * s * (s + 1.0)], axis=-1)
    return values, np.stack([s - 0.5, -2.0 * s, s + 0.5], axis=-1)


def face_shape(local: Array) -> Array:
    """Shape functions (q, 9) of a face at ``local`` (q, 2)."""
    a, b = lagrange(local[:, 0])[0], lagrange(local[:, 1])[0]
    shape: Array = np.einsum("qi,qj->qij", a, b).reshape(-1, 9)
    return shape


def face_gradient(local: Array) -> Array:
    """Their derivatives (q, 2, 9)."""
    (a, da), (b, db) = lagrange(local[:, 0]), lagrange(local[:, 1])
    along = np.einsum("qi,qj->qij", da, b).reshape(-1, 9)
    across = np.einsum("qi,qj->qij", a, db).reshape(-1, 9)
    return np.stack([along, across], axis=1)


def hex_shape(local: Array) -> tuple[Array, Array]:
    """Shape functions (q, 27) of an element at ``local`` (q, 3) and their derivatives (q, 3, 27)."""
    (a, da), (b, db), (c, dc) = (lagrange(local[:, i]) for i in range(3))
    product = [np.einsum("qi,qj,qk->qijk", *f).reshape(-1, 27) for f in ((a, b, c), (da, b, c), (a, db, c), (a, b, dc))]
    return product[0], np.stack(product[1:], axis=1)


def gauss(n: int, d: int, pieces: int = 1) -> tuple[Array, Array]:
    """Points (k, d) on [-1, 1]^d and weights: ``n`` of Gauss in each of so many equal ``pieces`` of each side."""
    x, w = np.polynomial.legendre.leggauss(n)
    middles = (2.0 * np.arange(pieces) + 1.0) / pieces - 1.0
    x, w = (middles[:, None] + x / pieces).reshape(-1), np.tile(w / pieces, pieces)
    points = np.stack(np.meshgrid(*([x] * d), indexing="ij"), axis=-1).reshape(-1, d)
    weights = np.prod(np.stack(np.meshgrid(*([w] * d), indexing="ij"), axis=-1), axis=-1).reshape(-1)
    return points, weights
