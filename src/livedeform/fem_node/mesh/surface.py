"""Triangle surfaces as they come from scanners: read, checked, repaired where that is safe, refused where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from livedeform.common.errors import MeshError
from livedeform.common.experiment.surface import refuse_loose
from livedeform.common.types import Array
from livedeform.fem_node.mesh.quality import surface_distances
from livedeform.fem_node.mesh.repair.crossings import crossing_pairs
from livedeform.fem_node.mesh.repair.denoise import denoise
from livedeform.fem_node.mesh.repair.flats import redrawn
from livedeform.fem_node.mesh.repair.record import Repair, moving
from livedeform.fem_node.mesh.repair.shells import refuse_crossing_pieces, turned_alike, turned_outward, without_specks
from livedeform.fem_node.mesh.tet_mesh import IntArray

METRES = {"m": 1.0, "mm": 1e-3}
SMALLEST, LARGEST = 0.005, 3.0  # m: a phantom's bounding box lies between; outside, the unit is wrong by 1000
HEAVY = 6  # triangles are merged when their edges are shorter than the element size / HEAVY
HOLE = 1.0  # a hole up to this many element sizes across is filled
NOISIEST = 0.25  # of an element: more noise than that is refused


@dataclass(frozen=True)
class Surface:
    """A closed surface: ``vertices`` (n, 3) m, ``triangles`` (k, 3) outward; ``record`` of what was repaired."""

    vertices: Array
    triangles: IntArray
    record: tuple[Repair, ...] = ()

    @property
    def repairs(self) -> tuple[str, ...]:
        """The record in words."""
        return tuple(str(repair) for repair in self.record)


def read_surface(path: Path, unit: Literal["m", "mm"] = "m") -> tuple[Array, IntArray]:
    """Vertices (n, 3) m, merged, and triangles (k, 3) of an STL, OBJ or PLY file; it may still have holes."""
    path = Path(path)
    if not path.is_file():
        raise MeshError(
            "there is no such file", where=str(path), remedy="phantom.surface names a closed stl, obj or ply"
        )
    try:
        loaded = trimesh.load_mesh(path, process=False)
    except Exception as error:  # whatever a parser throws at a damaged file is one thing to the user
        raise MeshError(
            f"it cannot be read as a surface ({error})", where=str(path), remedy="write it again"
        ) from error
    vertices: Array = np.asarray(loaded.vertices, np.float64)
    triangles = np.asarray(loaded.faces, np.int64)
    if len(triangles) < 4:
        raise MeshError(f"it has {len(triangles)} triangles", where=str(path), remedy="give a closed triangle surface")
    if not np.isfinite(vertices).all():
        raise MeshError("it has vertices that are not numbers", where=str(path), remedy="export the surface again")
    vertices = vertices * METRES[unit]
    check_size(vertices, path, unit)
    return merge_vertices(vertices, triangles)


def check_size(points: Array, path: Path, unit: str) -> None:
    """Refuse a body of an implausible size: the unit is wrong."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not SMALLEST <= diagonal <= LARGEST:
        other = "mm" if unit == "m" else "m"
        raise MeshError(
            f"the body is {diagonal:.4g} m across with unit: {unit}",
            where=str(path),
            remedy=f"set phantom.unit to {other}, or scale the file",
        )


def merge_vertices(vertices: Array, triangles: IntArray) -> tuple[Array, IntArray]:
    """Join vertices closer than 1e-7 of the size; drop triangles that vanish, and vertices that nobody uses."""
    step = 1e-7 * float(np.ptp(vertices, axis=0).max())
    _, first, number = np.unique(
        np.round((vertices - vertices.min(0)) / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return _clean(vertices[first], number.reshape(-1)[triangles])


def _clean(vertices: Array, triangles: IntArray) -> tuple[Array, IntArray]:
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    triangles = triangles[np.sort(first)]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def closed_surface(vertices: Array, triangles: IntArray, element_size: float, where: str = "") -> Surface:
    """The body that a surface (vertices (n, 3) m, triangles (k, 3)) means: loose specks dropped, holes up to an element
    across filled, pieces turned outward; ``MeshError`` with the reason where that would need guessing."""
    repairs: list[Repair] = []
    refuse_loose(triangles, where)
    triangles = without_specks(vertices, turned_alike(vertices, triangles, repairs), repairs, element_size)
    vertices, triangles = _fill_holes(*_clean(vertices, triangles), HOLE * element_size, where, repairs)
    triangles = turned_outward(vertices, triangles, where, repairs)
    return Surface(vertices, triangles, tuple(repairs))


def repair_surface(vertices: Array, triangles: IntArray, element_size: float, where: str = "") -> Surface:
    """A `closed_surface`, reasonably light and free of noise, with all that was done to it in the ``record``.

    Measured noise is smoothed, heavy scans are thinned out; what the mesher mends itself (self-intersections) is
    counted. A drawing's flat faces are cut into triangles by their outlines, which moves nothing.
    """
    surface = closed_surface(vertices, triangles, element_size, where)
    vertices, triangles, repairs = surface.vertices, surface.triangles, list(surface.record)
    vertices = _smooth_noise(vertices, triangles, element_size, where, repairs)
    vertices, triangles = redrawn(vertices, triangles, element_size)
    vertices, triangles = _thin_out(vertices, triangles, element_size / HEAVY, repairs)
    crossings = crossing_pairs(vertices, triangles)
    refuse_crossing_pieces(vertices, triangles, crossings, where)
    if len(crossings):
        n = len(np.unique(crossings[:, 1]))
        repairs.append(Repair(f"{n} triangles cross others: the mesher takes the outer hull of them"))
    return Surface(vertices, triangles, tuple(repairs))


def boundary_loops(t: IntArray) -> list[list[int]]:
    """The open rims of a surface, each a closed walk over its vertices, against the triangles' direction."""
    directed = np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2)
    _, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    following: dict[int, list[int]] = {}
    for i, j in directed[count[inverse.reshape(-1)] == 1].tolist():
        following.setdefault(j, []).append(i)
    loops = []
    while following:
        start = next(iter(following))
        loop, here = [start], start
        while True:
            there = following[here].pop()
            if not following[here]:
                del following[here]
            if there == start or there not in following:
                break
            loop.append(there)
            here = there
        loops.append(loop)
    return loops


def _fill_holes(v: Array, t: IntArray, largest: float, where: str, repairs: list[Repair]) -> tuple[Array, IntArray]:
    for loop in boundary_loops(t):
        rim = v[loop]
        middle = rim.mean(0)
        across = 2.0 * float(np.linalg.norm(rim - middle, axis=1).max())
        if across > largest:
            raise MeshError(
                f"the surface is open: a hole {1e3 * across:.1f} mm across at {np.round(middle, 4).tolist()}",
                where=where,
                remedy="close it (cap the base) in the scanner's software; smaller holes than one element are filled",
            )
        new = len(v)
        v = np.vstack([v, middle])
        fan = np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), new)])
        t = np.vstack([t, fan])
        repairs.append(Repair(f"a hole {1e3 * across:.2f} mm across filled at {np.round(middle, 4).tolist()}"))
    return v, t


def _smooth_noise(v: Array, t: IntArray, element_size: float, where: str, repairs: list[Repair]) -> Array:
    """Smooth what is measured to be noise (`denoise`); refused where that is a large part of an element."""
    found = denoise(v, t, element_size)
    if found.noise == 0.0:
        return v
    if found.noise > NOISIEST * element_size:
        raise MeshError(
            f"the surface is too noisy: {1e3 * found.noise:.2f} mm, a large part of an element",
            where=where,
            remedy="smooth the scan, average several, or use larger elements",
        )
    moved = np.linalg.norm(found.vertices - v, axis=1)
    what = f"noise smoothed, measured as {1e3 * found.noise:.3f} mm on {100 * found.share:.0f} % of the surface"
    repairs.append(moving(what, v, moved))
    return found.vertices


def _thin_out(v: Array, t: IntArray, edge: float, repairs: list[Repair]) -> tuple[Array, IntArray]:
    """Merge vertices per cell of a grid of width ``edge`` where the surface is much finer than the mesh will be."""
    lengths = np.linalg.norm(v[t] - v[np.roll(t, -1, axis=1)], axis=2)
    if float(np.median(lengths)) > 0.6 * edge:
        return v, t
    thin_v, thin_t = _cluster(v, t, edge)
    if len(thin_t) > 0.7 * len(t):
        return v, t
    places, distances = surface_distances((v, t), (thin_v, thin_t))
    repairs.append(moving(f"thinned out from {len(t)} to {len(thin_t)} triangles", places, distances))
    return thin_v, thin_t


def _cluster(v: Array, t: IntArray, width: float) -> tuple[Array, IntArray]:
    """Vertex clustering; each cell keeps the point closest to the planes of its triangles (Lindstrom, SIGGRAPH 2000).

    The point minimises x^T A x - 2 b^T x with A = sum n n^T, b = sum n n^T p over the triangles (weighted by area), so
    edges and corners stay; along directions that the planes leave open it is the mean of the cell's vertices.
    """
    cell = np.floor((v - v.min(0)) / width).astype(np.int64)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    number = number.reshape(-1)
    n = int(number.max()) + 1
    mean = np.stack([np.bincount(number, v[:, i], n) for i in range(3)], 1) / np.bincount(number, minlength=n)[:, None]
    normal = np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])
    outer = normal[:, :, None] * normal[:, None, :]
    plane = (normal * v[t[:, 0]]).sum(1)
    A, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for corner in range(3):
        here = number[t[:, corner]]
        np.add.at(A, here, outer)
        np.add.at(b, here, normal * (plane - (normal * mean[here]).sum(1))[:, None])
    values, vectors = np.linalg.eigh(A)
    keep = values > 1e-2 * values[:, -1:]  # weaker planes than that are noise of the scan
    inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)
    shift = np.einsum("nij,nj,nkj,nk->ni", vectors, inverse, vectors, b)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    shift *= np.minimum(1.0, 0.5 * width / np.maximum(length, 1e-300))
    return _clean(mean + shift, number[t])
