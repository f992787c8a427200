"""How far the model is from its own limit of fine elements: the error that no parameter of it can take away.

The deepest moment of each press is solved on a second mesh of the same body, with elements `COARSER` times as large as
far as the mesher can: by their difference, two meshes of one size tell the part of the error that is theirs alone times
1.4, and a coarser one tells at least half of the finer one's whole error (Richardson 1911; Roache 1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from closed_loop.catalogue import Candidate
from closed_loop.evidence import Observation
from closed_loop.fem import Body
from closed_loop.forward import Run, dictionary_columns
from closed_loop.workers import simulate, worker
from fem_node import mesh_cache
from fem_node.mesh import tetrahedralise
from fem_node.tet_mesh import TetMesh
from livedeform_common.errors import MeshError
from livedeform_common.types import Array

COARSER = 2.5  # the mesher gives elements larger by 1.0 to 1.3: the surface holds them back
LARGEST = 2.0  # times as many vertices as the body's own mesh: a finer one tells as much, but takes its time
MOST_PRESSES = 4
PATTERNS = 2
# rms length of an error vector over that of the motion, per unit of `noise.Errors.relative`: three axes of an error of
# each marker, and three of a field that is linear over the body
PER_UNIT = 2.7


@dataclass(frozen=True)
class Accuracy:
    """``relative``, ``local`` (m,), ``absolute`` m and ``force_relative`` as `noise.Errors` has them, from ``n``
    moments; ``offset`` (3,) m, in the probe's frame: how far beside itself the probe seems to press."""

    relative: float
    local: Array
    absolute: float
    force_relative: float
    n: int
    offset: Array


def accuracy(body: Body, observations: Sequence[Observation], offset: Candidate | None = None) -> Accuracy | None:
    """The declared model's; None where the body cannot be meshed more coarsely, or nothing converges."""
    coarse = coarser(body.setting.mesh)
    pressed = [o.take(np.isin(np.arange(o.n_moments), deepest(o))) for o in observations]
    columns = [] if offset is None else dictionary_columns([offset])
    if coarse is None:
        return None
    with worker(Body(replace(body.setting, mesh=coarse))) as second:
        asked = [second.submit(simulate, [], few, ()) for few in pressed]
        fine = [body.simulate([], few, columns) for few in pressed]
        return compared(pressed, fine, [a.result() for a in asked])


def compared(pressed: Sequence[Observation], fine: Sequence[Run], other: Sequence[Run]) -> Accuracy | None:
    """The error that the difference of two meshes' runs tells; ``fine`` with the columns of the probe's offset."""
    rest2 = force2 = load2 = 0.0
    n_markers = pressed[0].points.shape[1]
    offset2, error2, motion2 = np.zeros(3), np.zeros(n_markers), np.zeros(n_markers)
    n_rest = n = 0
    for few, one, two in zip(pressed, fine, other, strict=True):
        good = np.asarray(np.isfinite(one.points + two.points).all(axis=(1, 2)))
        if not good[0]:
            continue
        d = two.points - one.points
        rest2, n_rest = rest2 + float((d[0] ** 2).sum()), n_rest + d[0].size
        for k in np.flatnonzero(good)[1:]:
            seen = np.isfinite(few.points[k]).all(axis=1)
            error2 += np.where(seen, ((d[k] - d[0]) ** 2).sum(axis=1), 0.0)
            motion2 += np.where(seen, ((one.points[k] - one.points[0]) ** 2).sum(axis=1), 0.0)
            n += 1
            if one.d_points.shape[-1]:
                like = np.linalg.lstsq(
                    one.d_points[k][seen].reshape(-1, 3), (d[k] - d[0])[seen].reshape(-1), rcond=None
                )
                offset2 += like[0] ** 2
            if one.forces is not None and two.forces is not None:
                force2 += float(((two.forces[k] - one.forces[k]) ** 2).sum())
                load2 += float((one.forces[k] ** 2).sum())
    if n_rest == 0:
        return None
    relative = float(np.sqrt(error2.sum() / motion2.sum())) / PER_UNIT if motion2.any() else 0.0
    local = np.sqrt(np.divide(error2 / 3.0, motion2, out=np.zeros_like(error2), where=motion2 > 1e-10))
    force = float(np.sqrt(force2 / load2)) if load2 > 0.0 else 0.0
    more = upper(n)
    rest = float(np.sqrt(rest2 / n_rest))
    return Accuracy(more * relative, more * local, rest, more * force, n, more * np.sqrt(offset2 / max(n, 1)))


def upper(n: int) -> float:
    """Upper 90 % bound of an rms over its estimate from ``n`` presses, each with about `PATTERNS`
    independent errors."""
    freedom = PATTERNS * max(n, 1)
    return float(np.sqrt(freedom / chi2.ppf(0.1, freedom)))


def deepest(o: Observation) -> np.ndarray:
    """The first moment, and of each block in which markers move the one at which they are furthest away."""
    d = np.linalg.norm(o.points - o.points[0], axis=2)
    size = np.array([float(np.sqrt(np.nanmean(row**2))) if np.isfinite(row).any() else 0.0 for row in d])
    rows = [np.flatnonzero(o.blocks == b) for b in np.unique(o.blocks)]
    best = [int(r[np.argmax(size[r])]) for r in rows]
    best = sorted(best, key=lambda i: -size[i])[:MOST_PRESSES]
    return np.unique([0, *(i for i in best if size[i] > 0.2 * size.max())])


def coarser(mesh: TetMesh) -> TetMesh | None:
    """The same body with elements `COARSER` times as large; kept by content as every mesh that is made."""
    edges: Array = mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]]
    size = COARSER * float(np.median(np.linalg.norm(edges, axis=1)))
    used, triangles = np.unique(mesh.boundary_triangles, return_inverse=True)
    vertices, triangles = mesh.nodes[used], triangles.reshape(-1, 3)
    folder = mesh_cache.default_cache_dir()
    key = mesh_cache.content_key(vertices, triangles, {"accuracy": size})
    kept = mesh_cache.load(folder, key)
    if kept is not None:
        return kept[0]
    try:
        coarse = tetrahedralise(vertices, triangles, size, repair=False)
    except MeshError:
        return None
    if len(coarse.nodes) > LARGEST * len(mesh.nodes):
        return None
    mesh_cache.save(folder, key, coarse, ())
    return coarse
