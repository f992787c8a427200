"""The flat faces of a drawing, each cut into triangles in one way: a body gives one mesh, however its file cuts it up.

Triangles that lie in one plane are one face, with the corners of its outline for vertices; what lies between two
corners on a straight edge, or within a face, is left out. Nothing moves by more than `FLAT` of an element. Curved and
scanned surfaces have no such faces, and stay as they are.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from livedeform.common.types import Array
from livedeform.fem_node.mesh.quality import enclosed_volume
from livedeform.fem_node.mesh.repair.ears import cut
from livedeform.fem_node.mesh.tet_mesh import IntArray

FLAT = 2e-5  # of an element: vertices this close to a plane or a line lie on it; single precision is 100 times finer
LARGEST_OUTLINE = 1000  # corners; a face with more stays as it is
GRID = 1e-9  # m: decisions are made on this grid, so that round-off does not turn them

Chains = dict[tuple[int, int], list[int]]


class _UnclearError(Exception):
    """An outline that touches itself."""


def redrawn(vertices: Array, triangles: IntArray, element_size: float) -> tuple[Array, IntArray]:
    """Cut the flat faces of a closed surface (vertices (n, 3) m, triangles (k, 3) outward) anew, by their outlines
    alone; the surface as it is where that cannot be."""
    tolerance = FLAT * element_size
    v = GRID * np.round(vertices / GRID)
    face = _faces(v, triangles, tolerance)
    if int(face.max()) + 1 == len(triangles):
        return vertices, triangles
    try:
        new = _cut_anew(v, triangles, face, tolerance)
    except _UnclearError:
        return vertices, triangles
    if not _same_body(v, triangles, new, tolerance):
        return vertices, triangles
    used, numbers = np.unique(new, return_inverse=True)
    return vertices[used], numbers.reshape(-1, 3).astype(np.int64)


def _faces(v: Array, t: IntArray, tolerance: float) -> IntArray:
    """Return the number (k,) of the flat face that each triangle belongs to, rising from 0."""
    normal = _normals(v, t)
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    a, b, apex_a, apex_b = _neighbours(t)
    off_a = np.abs(((v[apex_b] - v[t[a, 0]]) * unit[a]).sum(axis=1))
    off_b = np.abs(((v[apex_a] - v[t[b, 0]]) * unit[b]).sum(axis=1))
    flat = (np.maximum(off_a, off_b) < tolerance) & ((unit[a] * unit[b]).sum(axis=1) > 0.0)
    graph = coo_array((np.ones(int(flat.sum())), (a[flat], b[flat])), shape=(len(t), len(t)))
    label = np.asarray(connected_components(graph, directed=False)[1], np.int64)
    alone = ~_plane(v, t, label, normal, tolerance)[label]
    label[alone] = label.max() + 1 + np.arange(int(alone.sum()))
    return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _plane(v: Array, t: IntArray, label: IntArray, normal: Array, tolerance: float) -> np.ndarray:
    """Return whether each face (m,) lies in one plane: neighbours that do are not enough, on a gently curved one."""
    m = int(label.max()) + 1
    total = np.stack([np.bincount(label, normal[:, i], m) for i in range(3)], axis=1)
    total = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    height = (v[t] * total[label][:, None]).sum(axis=2)
    low, high = np.full(m, np.inf), np.full(m, -np.inf)
    np.minimum.at(low, label, height.min(axis=1))
    np.maximum.at(high, label, height.max(axis=1))
    return np.asarray(high - low < 2.0 * tolerance)


def _neighbours(t: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the pairs of triangles (e,), (e,) with a common edge, and the corners (e,), (e,) that are not on it."""
    edges = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    apex = np.roll(t, -2, axis=1).reshape(-1)
    _, inverse, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    two = order[count[inverse[order]] == 2].reshape(-1, 2)
    return two[:, 0] // 3, two[:, 1] // 3, apex[two[:, 0]], apex[two[:, 1]]


def _cut_anew(v: Array, t: IntArray, face: IntArray, tolerance: float) -> IntArray:
    """Triangles (k, 3): those of faces of one triangle as they are, and others by their outlines' corners."""
    directed = np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2)
    of = np.repeat(face, 3)
    beside = {(int(i), int(j)): int(f) for (i, j), f in zip(directed, of, strict=True)}
    if len(beside) < len(directed):
        raise _UnclearError
    border = [(i, j, f) for (i, j), f in beside.items() if beside.get((j, i), -1) != f]
    dropped = _straight(v, border, tolerance)
    outline: dict[int, dict[int, int]] = defaultdict(dict)
    for i, j, f in border:
        if i in outline[f]:
            raise _UnclearError
        outline[f][i] = j
    normal, size = _normals(v, t), np.bincount(face)
    new = [t[size[face] == 1]]
    for f in np.flatnonzero(size > 1).tolist():
        loops = [[i for i in loop if i not in dropped] for loop in _loops(outline[f])]
        if sum(len(loop) for loop in loops) > LARGEST_OUTLINE or min(len(loop) for loop in loops) < 3:
            raise _UnclearError
        new.append(_triangles(v, loops, normal[face == f].sum(axis=0)))
    return _in_order(np.concatenate(new))


def _triangles(v: Array, loops: list[list[int]], normal: Array) -> IntArray:
    """Triangles (k, 3) of the flat face with the outlines ``loops``, seen along its largest axis: no round-off."""
    axis = int(np.argmax(np.round(np.abs(normal) / np.linalg.norm(normal), 6)))
    plane = [(axis + 1) % 3, (axis + 2) % 3][:: 1 if normal[axis] > 0.0 else -1]
    cut_up = cut(v[:, plane], loops)
    if cut_up is None:
        raise _UnclearError
    return cut_up


def _loops(following: dict[int, int]) -> list[list[int]]:
    """The closed walks of an outline, each from its least vertex, in the order of those."""
    left, loops = dict(following), []
    while left:
        start = here = min(left)
        loop = [start]
        while (here := left.pop(here, start)) != start:
            loop.append(here)
        loops.append(loop)
    return loops


def _straight(v: Array, border: list[tuple[int, int, int]], tolerance: float) -> set[int]:
    """Return the vertices that lie between two corners on a straight edge of two faces."""
    beside: dict[int, set[int]] = defaultdict(set)
    for i, j, _ in border:
        beside[i].add(j)
        beside[j].add(i)
    passed = {i for i, others in beside.items() if len(others) == 2}
    dropped: set[int] = set()
    done: set[int] = set()
    for start in sorted(beside):
        if start in passed:
            continue
        for first in sorted(beside[start]):
            chain = _chain(start, first, beside, passed)
            if not done.intersection(chain[1:-1]):
                done.update(chain[1:-1])
                dropped |= set(chain) - _kept(v, chain, tolerance)
    for start in sorted(passed - done):  # outlines without a corner that three faces share
        if start not in done:
            chain = _chain(start, min(beside[start]), beside, passed - {start})
            done.update(chain)
            dropped |= _dropped_of_ring(v, chain, tolerance)
    return dropped


def _dropped_of_ring(v: Array, chain: list[int], tolerance: float) -> set[int]:
    """Return the needless vertices of a closed ``chain`` (its first vertex is its last): halved at its extremes."""
    ring = chain[:-1]
    far = int(np.argmax(np.round(((v[ring] - v[ring[0]]) ** 2).sum(axis=1), 15)))
    halves = (ring[: far + 1], [*ring[far:], ring[0]])
    return set(ring) - _kept(v, halves[0], tolerance) - _kept(v, halves[1], tolerance)


def _chain(start: int, first: int, beside: dict[int, set[int]], passed: set[int]) -> list[int]:
    """Return the border's vertices from ``start`` by way of ``first`` to the next that is not ``passed``."""
    chain = [start, first]
    while chain[-1] in passed and chain[-1] != start:
        (after,) = beside[chain[-1]] - {chain[-2]} or {start}
        chain.append(after)
    return chain


def _kept(v: Array, chain: list[int], tolerance: float) -> set[int]:
    """Return the vertices of a ``chain`` that it needs to stay within ``tolerance`` m (Douglas & Peucker 1973)."""
    kept, parts = {chain[0], chain[-1]}, [(0, len(chain) - 1)]
    while parts:
        low, high = parts.pop()
        if high - low < 2:
            continue
        start, along = v[chain[low]], v[chain[high]] - v[chain[low]]
        length = float(np.linalg.norm(along))
        rest = v[chain[low + 1 : high]] - start
        off = np.linalg.norm(np.cross(rest, along / length), axis=1) if length else np.linalg.norm(rest, axis=1)
        if off.max() > tolerance:
            middle = low + 1 + int(off.argmax())
            kept.add(chain[middle])
            parts += [(low, middle), (middle, high)]
    return kept


def _same_body(v: Array, old: IntArray, new: IntArray, tolerance: float) -> bool:
    """Tell whether ``new`` triangles close the same surface as the ``old``: its area, its volume, and no rim."""
    directed = np.stack([new, np.roll(new, -1, axis=1)], axis=2).reshape(-1, 2)
    closed = {(int(i), int(j)) for i, j in directed}
    if len(closed) < len(directed) or any((j, i) not in closed for i, j in closed):
        return False
    area, other = (0.5 * float(np.linalg.norm(_normals(v, t), axis=1).sum()) for t in (old, new))
    change = abs(enclosed_volume(v, old) - enclosed_volume(v, new))
    return abs(area - other) < 1e-5 * area and change < 2.0 * tolerance * area


def _normals(v: Array, t: IntArray) -> Array:
    """(k, 3) outward, of twice the area's length."""
    return np.asarray(np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]]))


def _in_order(t: IntArray) -> IntArray:
    """The same triangles, each from its least vertex, in the order of their vertices."""
    first = t.argmin(axis=1)
    turned = np.take_along_axis(t, (first[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])]
