"""A scan's noise: measured where the surface is smooth, and smoothed away without its edges and flats.

Noise is what a quadric through a vertex's neighbours leaves over, in its neighbourhood's quieter part: a body's edges
and corners are few there, or many but far apart, and a flat or a smoothly curved face leaves nothing. So the faces of a
drawing have none, however many triangles they are cut into.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from livedeform.common.types import Array
from livedeform.fem_node.mesh.quality import enclosed_volume
from livedeform.fem_node.mesh.tet_mesh import IntArray

SMALLEST = 1.0 / 80.0  # of an element: less noise than that stays, the mesher's envelope is twice as wide
COARSE = 2.0  # elements: wider spaced vertices draw a body, and sample no noise
NEARBY = 64  # vertices around one whose noise is its own
QUIETER = 0.25  # share of those that are taken to lie beside the body's edges
OF_QUARTILE = 0.86  # the lower quartile of a chi of about 13 degrees of freedom, by its root mean square
SPREAD = 3.0  # of the noise, over which smoothing fades out at the rim of a noisy part, in vertices' distances
WIDTHS = (0.5, 0.5, 0.45, 0.45, 0.4, 0.4, *(10 * (0.35,)))  # between unit normals: a turn of 20 degrees is one face's
UPDATES = 10  # of the vertices, to lie in their faces


class Denoised(NamedTuple):
    """``vertices`` (n, 3) m; ``noise`` m: standard deviation per direction where it was smoothed, 0 if nowhere;
    ``share`` of the vertices that were."""

    vertices: Array
    noise: float
    share: float


def denoise(vertices: Array, triangles: IntArray, element_size: float) -> Denoised:
    """Smooth a closed surface where its noise is one that elements of ``element_size`` m would show."""
    sigma = local_noise(vertices, triangles, element_size)
    noisy = sigma > SMALLEST * element_size
    if not noisy.any():
        return Denoised(vertices, 0.0, 0.0)
    smooth = bilateral(vertices, triangles)
    weight = _faded(noisy, triangles)
    moved = vertices + weight[:, None] * (smooth - vertices)
    moved = _with_volume(moved, triangles, weight, enclosed_volume(vertices, triangles))
    return Denoised(moved, float(np.median(sigma[noisy])), float(np.mean(noisy)))


def local_noise(vertices: Array, triangles: IntArray, element_size: float) -> Array:
    """(n,) m: the standard deviation of each vertex's surroundings, 0 where that cannot be told from the body."""
    residual, reach = _residuals(vertices, triangles)
    residual[_one_sided(vertices, triangles) | (reach > COARSE * element_size)] = 0.0
    n = min(NEARBY, len(vertices))
    nearby = cKDTree(vertices).query(vertices, k=n)[1].reshape(len(vertices), n)
    quieter = np.quantile(residual[nearby], QUIETER, axis=1) / OF_QUARTILE
    return np.asarray(np.median(quieter[nearby], axis=1))


def _residuals(v: Array, t: IntArray) -> tuple[Array, Array]:
    """(n,) m: what the best quadric over two rings of neighbours leaves per degree of freedom, and the rings' reach."""
    n = len(v)
    ring = _vertex_ring(t, n)
    two = csr_array(ring @ ring)
    count = np.diff(two.indptr)
    at, to = np.repeat(np.arange(n), count), two.indices
    normal = _vertex_normals(v, t)
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normal, helper)
    first /= np.maximum(np.linalg.norm(first, axis=1), 1e-30)[:, None]
    d = v[to] - v[at]
    x, y, z = ((d * axis[at]).sum(axis=1) for axis in (first, np.cross(normal, first), normal))
    reach = np.sqrt(np.bincount(at, x * x + y * y, n) / count)
    x, y = x / reach[at], y / reach[at]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    A, b = np.empty((n, 6, 6)), np.empty((n, 6))
    for i in range(6):
        b[:, i] = np.bincount(at, terms[:, i] * z, n)
        for j in range(6):
            A[:, i, j] = np.bincount(at, terms[:, i] * terms[:, j], n)
    A += 1e-9 * count[:, None, None] * np.eye(6)
    quadric = np.linalg.solve(A, b[..., None])[..., 0]
    left = z - (terms * quadric[at]).sum(axis=1)
    return np.sqrt(np.bincount(at, left * left, n) / np.maximum(count - 6, 1)), reach


def _one_sided(v: Array, t: IntArray) -> np.ndarray:
    """Return which vertices (n,) have edges that all turn the same way: those of a drawn body, hardly ever those of
    noise."""
    import trimesh

    mesh = trimesh.Trimesh(v, t, process=False)
    bent = mesh.face_adjacency_angles > 1e-3
    convex, edges = mesh.face_adjacency_convex[bent], mesh.face_adjacency_edges[bent]
    out, inward = np.zeros(len(v), bool), np.zeros(len(v), bool)
    out[edges[convex].ravel()] = True
    inward[edges[~convex].ravel()] = True
    return out ^ inward


def bilateral(vertices: Array, triangles: IntArray) -> Array:
    """(n, 3) m: faces turned towards the mean of the neighbours that look alike (bilateral normal filter, Zheng et al.
    2011), vertices moved into their faces (Sun et al. 2007): noise goes, edges between flats stay."""
    v, t = vertices, triangles
    around = csr_array(
        (np.ones(t.size), (np.repeat(np.arange(len(t)), 3), t.ravel())), shape=(len(t), len(v)), dtype=float
    )
    beside = csr_array(around @ around.T)
    at, to = np.repeat(np.arange(len(t)), np.diff(beside.indptr)), beside.indices
    area, normal = _faces(v, t)
    middle = v[t].mean(axis=1)
    d = np.linalg.norm(middle[at] - middle[to], axis=1)
    near = area[to] * np.exp(-0.5 * (d / d[d > 0.0].mean()) ** 2)
    for width in WIDTHS:
        alike = near * np.exp(-0.5 * ((normal[at] - normal[to]) ** 2).sum(axis=1) / width**2)
        mean = np.stack([np.bincount(at, alike * normal[to, i], len(t)) for i in range(3)], axis=1)
        normal = mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-30)[:, None]
    faces = np.bincount(t.ravel(), minlength=len(v))[:, None]
    for _ in range(UPDATES):
        corners = v[t]
        off = ((corners.mean(axis=1)[:, None] - corners) * normal[:, None]).sum(axis=2)
        v = v + _at_vertices(off[..., None] * normal[:, None], t, len(v)) / faces
    return v


def _faded(noisy: np.ndarray, t: IntArray) -> Array:
    """(n,) 1 where it is noisy, falling to 0 over a few rings of neighbours."""
    ring, weight = _vertex_ring(t, len(noisy)), noisy.astype(float)
    for _ in range(int(SPREAD)):
        beside = np.asarray(ring @ weight) / np.maximum(np.diff(ring.indptr), 1)
        weight = np.where(noisy, 1.0, 0.5 * beside)
    return weight


def _with_volume(v: Array, t: IntArray, weight: Array, volume: float) -> Array:
    """Vertices moved along their normals, by their ``weight``, so that the body has its ``volume`` m3: independent
    noise of zero mean leaves the expected volume of a triangle surface as it is, and smoothing does not."""
    area, _ = _faces(v, t)
    per_vertex = np.bincount(t.ravel(), np.repeat(area / 3.0, 3), len(v))
    height = (volume - enclosed_volume(v, t)) / max(float(per_vertex @ weight), 1e-30)
    return v + (height * weight)[:, None] * _vertex_normals(v, t)


def _faces(v: Array, t: IntArray) -> tuple[Array, Array]:
    """Areas (k,) m2 and unit normals (k, 3)."""
    cross = np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])
    length = np.linalg.norm(cross, axis=1)
    return 0.5 * length, cross / np.maximum(length, 1e-30)[:, None]


def _vertex_normals(v: Array, t: IntArray) -> Array:
    """(n, 3) unit, weighted by area."""
    area, normal = _faces(v, t)
    total = _at_vertices(np.repeat((area[:, None] * normal)[:, None], 3, axis=1), t, len(v))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None])


def _at_vertices(values: Array, t: IntArray, n: int) -> Array:
    """Sum the ``values`` (k, 3, 3) of faces' corners at the vertices (n, 3)."""
    return np.stack([np.bincount(t.ravel(), values[..., i].ravel(), n) for i in range(3)], axis=1)


def _vertex_ring(t: IntArray, n: int) -> csr_array:
    """(n, n) 1 between vertices that share an edge."""
    pairs = np.concatenate([t, t[:, [1, 2, 0]]], axis=None).reshape(2, -1)
    both = np.concatenate([pairs, pairs[::-1]], axis=1)
    ring = csr_array((np.ones(both.shape[1]), (both[0], both[1])), shape=(n, n))
    ring.sum_duplicates()
    ring.data[:] = 1.0
    return ring
