"""Structured tetrahedral meshes of simple bodies, for tests, studies and examples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray, TetMesh

# six tetrahedra round the diagonal 0-6 of a hexahedron (Kuhn); neighbours numbered alike fit together
_KUHN = np.array([[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]])
# the quadrilaterals of a hexahedron, outward
_QUADS = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])


def block_mesh(
    size: Sequence[float],
    n: int | Sequence[int],
    origin: Sequence[float] | None = None,
    *,
    growth: Sequence[float] = (1.0, 1.0, 1.0),
) -> TetMesh:
    """A block of ``size`` (3) m in ``n`` cells per side, six tetrahedra each.

    By default the base's middle is at the origin: x in [-a/2, a/2], y in [-b/2, b/2], z in [0, c]. Along an axis each
    cell is ``growth`` times as long as the one before it: above 1 they are finest where the axis starts, below 1 where
    it ends (at the rim of a bonded base the stress is singular, and even cells spend themselves elsewhere).
    """
    counts = _cells(n)
    nodes, hexes = _grid(counts)
    if len(growth) != 3 or min(growth) <= 0.0:
        raise MeshError(f"the growth of cells is three positive numbers, not {growth}")
    for axis, (m, g) in enumerate(zip(counts, growth, strict=True)):
        if g != 1.0:
            nodes[:, axis] = (g ** (m * nodes[:, axis]) - 1.0) / (g**m - 1.0)
    size_ = np.asarray(size, float)
    start = np.array([-size_[0] / 2, -size_[1] / 2, 0.0]) if origin is None else np.asarray(origin, float)
    return TetMesh.oriented(start + nodes * size_, hexes[:, _KUHN].reshape(-1, 4))


def cylinder_mesh(radius: float, height: float, n: int, n_height: int | None = None) -> TetMesh:
    """An upright cylinder on z = 0 about the z axis; ``n`` cells across the core (about n / 2 more to the rim)."""
    nodes, quads = _disc(n)
    n_height = n_height or max(1, round(height / (2.0 * radius) * 1.6 * n))
    layers = np.linspace(0.0, height, n_height + 1)
    points = np.concatenate([np.column_stack([nodes * radius, np.full(len(nodes), z)]) for z in layers])
    step = len(nodes) * np.arange(n_height)[:, None, None]
    hexes = np.concatenate([quads + step, quads + step + len(nodes)], axis=2).reshape(-1, 8)
    return _split(points, hexes)


def ball_mesh(radius: float, n: int) -> TetMesh:
    """A ball about the origin; ``n`` cells across the core cube."""
    nodes, hexes = _ball(_cells(n), half=False)
    return _split(nodes * radius, hexes)


def hemi_ellipsoid_mesh(semi_axes: Sequence[float], n: int) -> TetMesh:
    """The half z >= 0 of an ellipsoid of ``semi_axes`` (3) m, its flat base on z = 0; ``n`` (even) cells across."""
    if n % 2:
        raise MeshError(f"a hemi-ellipsoid needs an even number of cells across, not {n}")
    nodes, hexes = _ball((n, n, n // 2), half=True)
    return _split(nodes * np.asarray(semi_axes, float), hexes)


def _cells(n: int | Sequence[int]) -> tuple[int, int, int]:
    counts = (n, n, n) if isinstance(n, int) else tuple(int(k) for k in n)
    if len(counts) != 3 or min(counts) < 1:
        raise MeshError(f"the number of cells is one or three positive integers, not {n}")
    return counts


def _grid(n: tuple[int, int, int]) -> tuple[Array, IntArray]:
    """Nodes (.., 3) of the unit cube in ``n`` cells per side, and its hexahedra (.., 8)."""
    i, j, k = np.meshgrid(*(np.arange(m + 1) for m in n), indexing="ij")
    nodes = np.stack([i / n[0], j / n[1], k / n[2]], axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(i.shape)
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    hexes = np.stack([number[a : n[0] + a, b : n[1] + b, c : n[2] + c] for a, b, c in corners], axis=-1)
    return nodes, hexes.reshape(-1, 8)


def _rounded(p: Array) -> tuple[Array, Array]:
    """A grid of [-1, 1]^d as a core with bulging faces, and the place on the unit sphere that each node looks at."""
    largest = np.abs(p).max(1)
    wrapped = np.tan(np.pi / 4 * p / np.maximum(largest, 1e-12)[:, None])  # equal angles, not equal lengths
    direction = wrapped / np.maximum(np.linalg.norm(wrapped, axis=1), 1e-12)[:, None]
    core = 0.5 * (0.55 * p + 0.45 * largest[:, None] * direction * 1.25)
    return core, direction


def _ball(n: tuple[int, int, int], *, half: bool) -> tuple[Array, IntArray]:
    """Hexahedra of the unit ball (or its upper half): a bulging core cube, and shells from its faces to the sphere."""
    grid, core_hexes = _grid(n)
    p = 2.0 * grid - 1.0
    if half:
        p[:, 2] = grid[:, 2]
    core, direction = _rounded(p)
    faces = core_hexes[:, _QUADS].reshape(-1, 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    quads = faces[first[count == 1]]
    if half:
        quads = quads[~(p[quads][:, :, 2] == 0.0).all(1)]
    return _with_shells(core, core_hexes, quads, direction, max(1, round(0.45 * n[0])))


def _disc(n: int) -> tuple[Array, IntArray]:
    """Quadrilaterals of the unit disc, built as ``_ball`` is."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    p = np.stack([2.0 * i / n - 1.0, 2.0 * j / n - 1.0], axis=-1).reshape(-1, 2)
    number = np.arange(len(p)).reshape(i.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    core, direction = _rounded(p)
    edges = quads[:, [[0, 1], [1, 2], [2, 3], [3, 0]]].reshape(-1, 2)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return _with_shells(core, quads, edges[first[count == 1]], direction, max(1, round(0.45 * n)))


def _with_shells(
    core: Array, cells: IntArray, outer: IntArray, direction: Array, n_shells: int
) -> tuple[Array, IntArray]:
    """Add ``n_shells`` layers of cells between the core's ``outer`` faces and the unit sphere."""
    rim = np.unique(outer)
    number = np.zeros(len(core), np.int64)
    number[rim] = np.arange(len(rim))
    nodes, blocks = [core], [cells]
    below = outer
    for s in range(1, n_shells + 1):
        t = s / n_shells
        nodes.append((1.0 - t) * core[rim] + t * direction[rim])
        above = number[outer] + len(core) + (s - 1) * len(rim)
        joined = np.concatenate([below, above] if cells.shape[1] == 8 else [below, above[:, ::-1]], axis=1)
        blocks.append(joined)
        below = above
    return np.concatenate(nodes), np.concatenate(blocks)


def _split(nodes: Array, hexes: IntArray) -> TetMesh:
    """Twelve tetrahedra per hexahedron, from its centre to its faces, each cut by the diagonal at its lowest node.

    The diagonal depends on the face alone, so neighbours fit together however they are numbered.
    """
    centres = nodes[hexes].mean(1)
    quads = hexes[:, _QUADS].reshape(-1, 4)
    lowest = quads.argmin(1)
    turned = np.take_along_axis(quads, (lowest[:, None] + np.arange(4)) % 4, axis=1)
    triangles = turned[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    centre = len(nodes) + np.repeat(np.arange(len(hexes)), 12)
    return TetMesh.oriented(np.concatenate([nodes, centres]), np.column_stack([triangles, centre]))
