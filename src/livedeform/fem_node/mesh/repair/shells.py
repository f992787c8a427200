"""The closed pieces of a surface: loose specks dropped, triangles turned outward, cavities told from bodies."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from livedeform.common.errors import MeshError
from livedeform.common.experiment.surface import Surface as ClosedSurface
from livedeform.common.types import Array
from livedeform.fem_node.mesh.quality import enclosed_volume
from livedeform.fem_node.mesh.repair.record import Repair
from livedeform.fem_node.mesh.tet_mesh import IntArray

STRAY = 0.02  # a piece with less than this share of the largest one's area is small
UNSEEN = 0.5  # of an element: a cavity that is less across is not kept
AT_ONCE = 4_000_000  # distances between points


def without_specks(v: Array, t: IntArray, repairs: list[Repair], element_size: float = 0.0) -> IntArray:
    """Return the triangles (k, 3) of a surface (vertices (n, 3) m, neighbours look the same way) without small pieces
    that hang together with nothing: open ones, those outside of the body, and what is much less than an element
    (``element_size`` m) within it.

    Small is told by the area: a drawn body, or a cavity, may have 12 triangles beside a scan's thousands. Other closed
    shells within the body stay, however small beside it: each is a cavity's wall, or to be refused.
    """
    _, labels = np.unique(_pieces(v, t), return_inverse=True)
    cross = np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])
    areas = np.bincount(labels, 0.5 * np.linalg.norm(cross, axis=1))
    small = areas < STRAY * areas.max()
    if not small.any():
        return t
    shells = np.split(t[np.argsort(labels, kind="stable")], np.cumsum(np.bincount(labels))[:-1])
    large = [shells[k] for k in np.flatnonzero(~small)]
    volumes = np.array([enclosed_volume(v - v.mean(axis=0), shell) for shell in large])  # they may still have holes
    specks: list[IntArray] = []
    filled: list[IntArray] = []
    keep = ~small
    for k in np.flatnonzero(small):
        around = _around(v, [*large, shells[k]], volumes, len(large)) if _is_closed(shells[k]) else []
        if len(around) % 2 == 0:
            specks.append(shells[k])
        elif _across(v, [shells[k]]) >= UNSEEN * element_size:
            keep[k] = True
        else:
            of_body = volumes[min(around, key=lambda j: abs(volumes[j]))]
            (filled if enclosed_volume(v, shells[k]) * of_body < 0.0 else specks).append(shells[k])
    if specks:
        repairs.append(Repair(f"{len(specks)} loose specks up to {1e3 * _across(v, specks):.1f} mm across dropped"))
    if filled:
        what = "a cavity" if len(filled) == 1 else f"{len(filled)} cavities up to"
        repairs.append(Repair(f"{what} {1e3 * _across(v, filled):.1f} mm across filled in: under half an element"))
    return np.asarray(t[keep[labels]])


def _is_closed(shell: IntArray) -> bool:
    """Tell whether each edge belongs to an even number of triangles."""
    edges = np.sort(np.concatenate([shell[:, [0, 1]], shell[:, [1, 2]], shell[:, [2, 0]]]), axis=1)
    return not (np.unique(edges, axis=0, return_counts=True)[1] % 2).any()


def _across(v: Array, shells: list[IntArray]) -> float:
    """Return how far (m) two points of one of the shells are apart at most."""
    points = [v[np.unique(shell)] for shell in shells]
    boxes = [float(np.linalg.norm(np.ptp(own, axis=0))) for own in points]
    largest = 0.0
    for k in np.argsort(boxes)[::-1]:
        if boxes[k] <= largest:
            break
        rows = max(AT_ONCE // len(points[k]), 1)
        some = (points[k][first : first + rows] for first in range(0, len(points[k]), rows))
        largest = max(largest, *(float(cdist(part, points[k]).max()) for part in some))
    return largest


def turned_outward(v: Array, t: IntArray, where: str, repairs: list[Repair]) -> IntArray:
    """Return the triangles (k, 3) of a closed surface (vertices (n, 3) m) so that bodies look outward and cavities
    inward. ``MeshError`` for a shell within a body that looks as the body does: it may be either."""
    labels = _pieces(v, t)
    shells = [t[labels == piece] for piece in np.unique(labels)]
    volumes = np.array([enclosed_volume(v, shell) for shell in shells])
    around = [_around(v, shells, volumes, k) for k in range(len(shells))]
    bodies = [k for k in range(len(shells)) if len(around[k]) % 2 == 0]
    inside_out = [k for k in bodies if volumes[k] < 0.0]
    if inside_out:
        which = "the surface was" if len(bodies) == 1 else f"{len(inside_out)} of {len(bodies)} pieces were"
        repairs.append(Repair(f"{which} inside out"))
    if len(bodies) > 1:
        sizes = ", ".join(f"{1e6 * abs(volumes[k]):.3g}" for k in bodies)
        repairs.append(Repair(f"{len(bodies)} separate pieces of {sizes} cm3 are meshed together"))
    for k in set(range(len(shells))) - set(bodies):
        body = max((j for j in around[k] if j in bodies), key=lambda j: len(around[j]))
        repairs.append(_cavity(v, shells[k], volumes[k], volumes[body], where))
        inside_out += [k] if volumes[body] < 0.0 else []
    return np.concatenate([s[:, ::-1] if k in inside_out else s for k, s in enumerate(shells)]) if inside_out else t


def outermost(v: Array, t: IntArray) -> IntArray:
    """Return the triangles (k, 3) of the outermost shells of a closed surface (vertices (n, 3) m), turned to look
    outward: of a rigid body nothing that lies within is ever touched."""
    t = turned_alike(v, t, [])
    labels = _pieces(v, t)
    shells = [t[labels == piece] for piece in np.unique(labels)]
    volumes = np.array([enclosed_volume(v, shell) for shell in shells])
    outer = [k for k in range(len(shells)) if not _around(v, shells, volumes, k)]
    return np.concatenate([shells[k] if volumes[k] > 0.0 else shells[k][:, ::-1] for k in outer])


def _cavity(v: Array, shell: IntArray, volume: float, of_body: float, where: str) -> Repair:
    """Name a shell within a body as the cavity that it is; ``volume`` and ``of_body``: signed, m3, as they look."""
    place = ", ".join(f"{c:.1f}" for c in np.round(1e3 * v[shell].mean(axis=(0, 1)), 1) + 0.0)  # + 0.0: no -0.0
    if volume * of_body > 0.0:
        raise MeshError(
            f"a closed shell of {1e6 * abs(volume):.3g} cm3 at ({place}) mm lies within the body and looks outward, "
            "as a body of its own would",
            where=where,
            remedy="remove it (what it holds is the body's), or turn it inward if it is a cavity's wall",
        )
    return Repair(f"a cavity of {1e6 * abs(volume):.3g} cm3 at ({place}) mm stays empty")


def refuse_crossing_pieces(v: Array, t: IntArray, crossings: IntArray, where: str) -> None:
    """``MeshError`` where triangles of two pieces are among the pairs ``crossings`` (p, 2): the walls within would be
    left out."""
    labels = _pieces(v, t)
    apart = crossings[labels[crossings[:, 0]] != labels[crossings[:, 1]]]
    if len(apart):
        place = ", ".join(f"{c:.1f}" for c in np.round(1e3 * v[t[apart[0, 1]]].mean(axis=0), 1) + 0.0)
        raise MeshError(
            f"two closed pieces of the surface overlap, as at ({place}) mm",
            where=where,
            remedy="join them into one outer surface (a union), or move them apart",
        )


def _around(v: Array, shells: list[IntArray], volumes: Array, k: int) -> list[int]:
    """Return which shells hold shell ``k``: those whose box does, and which its outermost vertices are inside of."""
    own, around = v[shells[k]].reshape(-1, 3), []
    outermost = own[np.concatenate([own.argmin(axis=0), own.argmax(axis=0)])]
    for j, shell in enumerate(shells):
        box = v[shell].reshape(-1, 3)
        if j == k or not ((box.min(axis=0) < own.min(axis=0)) & (box.max(axis=0) > own.max(axis=0))).all():
            continue
        outward = shell if volumes[j] > 0.0 else shell[:, ::-1]
        holds = ClosedSurface(v, outward).contains
        if all(holds(vertex)[0] for vertex in outermost[:, None]):
            around.append(j)
    return around


def turned_alike(v: Array, t: IntArray, repairs: list[Repair]) -> IntArray:
    """Return the triangles (k, 3) of a surface (vertices (n, 3) m), neighbours turned to look the same way."""
    if trimesh.Trimesh(v, t, process=False).is_winding_consistent:
        return t
    repairs.append(Repair("triangles turned to look the same way"))
    return _consistent_winding(t)


def _consistent_winding(t: IntArray) -> IntArray:
    """Turn triangles so that neighbours run along their common edge in opposite directions (breadth first)."""
    edges = np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2)
    owner: dict[tuple[int, int], list[tuple[int, bool]]] = {}
    for e, (i, j) in enumerate(edges.tolist()):
        owner.setdefault((min(i, j), max(i, j)), []).append((e // 3, i < j))
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in t]
    for pair in owner.values():
        if len(pair) == 2:
            (a, forward), (b, other) = pair
            neighbours[a].append((b, forward == other))
            neighbours[b].append((a, forward == other))
    turn = np.full(len(t), -1)
    for seed in range(len(t)):
        if turn[seed] >= 0:
            continue
        turn[seed], queue = 0, [seed]
        while queue:
            a = queue.pop()
            for b, differs in neighbours[a]:
                if turn[b] < 0:
                    turn[b] = turn[a] ^ int(differs)
                    queue.append(b)
    return np.where(turn[:, None] == 1, t[:, ::-1], t)


def _pieces(v: Array, t: IntArray) -> IntArray:
    """Return the number (k,) of the piece that each triangle belongs to."""
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(len(v), len(v)))
    return np.asarray(connected_components(graph, directed=False)[1][t[:, 0]], np.int64)
