"""The contact face of a rigid probe in quadratic hexahedra, for solvers that know no rigid shapes but meshed ones."""

from __future__ import annotations

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray
from livedeform.synthetic.truth.probe import TruthProbe

THICK = 0.003  # m, of the shell that is meshed
STEEPEST = np.radians(75.0)  # of a rounded edge; a soft body does not follow it further
CAP = np.radians(42.0)  # of a ball, from its lowest point along either side
FLAT, ARC, BALL = 5, 4, 8  # elements along half a flat face, along a rounded edge, and along half a ball


def probe_mesh(shape: TruthProbe) -> tuple[HexMesh, IntArray]:
    """Return a mesh in the probe's frame, m, and the faces (k, 9) of its lower side, which meets the body."""
    if shape.kind == "cylinder":
        surface, quads = _round(shape.size[0], shape.radius)
    elif shape.kind == "sphere":
        arc = CAP * np.linspace(-1.0, 1.0, 4 * BALL + 1)
        surface, quads = _patch([(0.0, a) for a in arc], [(0.0, a) for a in arc], shape.size[0])
    else:
        _edge_needed(shape)
        x, y = (_profile(shape.size[i] / 2 - shape.radius) for i in (0, 1))
        surface, quads = _patch(x, y, shape.radius)
    n = len(surface)
    inward = np.array([0.0, 0.0, -THICK / 2])
    nodes = np.vstack([surface + k * inward for k in range(3)])
    mesh = HexMesh.of(nodes, np.stack([quads, quads + n, quads + 2 * n], axis=2).reshape(len(quads), 27))
    return mesh, mesh.faces[(mesh.faces < n).all(1)]


def _edge_needed(shape: TruthProbe) -> None:
    if shape.radius <= 0.0:
        raise InputError("a sharp edge cannot be meshed", where="probe.edge_radius", remedy="round it by 3 mm or more")


def _profile(half: float) -> list[tuple[float, float]]:
    """Return along one side the places m of the edge's centres and the angles of the normals, at half elements."""
    arc = STEEPEST * np.arange(1, 2 * ARC + 1) / (2 * ARC)
    flat = [(float(p), 0.0) for p in np.linspace(-half, half, 4 * FLAT + 1)]
    return [*((-half, -float(a)) for a in arc[::-1]), *flat, *((half, float(a)) for a in arc)]


def _patch(x: list[tuple[float, float]], y: list[tuple[float, float]], radius: float) -> tuple[Array, IntArray]:
    """Return points (n, 3) m and quads (k, 9) of a rectangle rounded by ``radius``: of no size, a piece of a ball."""
    px, py = np.meshgrid([p for p, _ in x], [p for p, _ in y], indexing="ij")
    tx, ty = np.meshgrid(np.tan([a for _, a in x]), np.tan([a for _, a in y]), indexing="ij")
    normal = np.stack([tx, ty, np.ones_like(tx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    points = np.stack([px, py, np.full_like(px, -radius)], axis=-1) + radius * normal
    return points.reshape(-1, 3), _quads(np.arange(px.size).reshape(px.shape))


def _quads(number: IntArray) -> IntArray:
    """Return the 3 x 3 lattices (k, 9) of a grid of numbers."""
    rows, columns = number.shape
    corners = [number[a : rows - 2 + a : 2, b : columns - 2 + b : 2].reshape(-1) for a in range(3) for b in range(3)]
    return np.stack(corners, axis=1)


def _round(radius: float, edge: float) -> tuple[Array, IntArray]:
    """Return points (n, 3) m and quads (k, 9) of a disc with a rounded rim: a square core in rings."""
    _edge_needed(TruthProbe("cylinder", (radius,), edge))
    side = 2 * FLAT + 1
    p = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, side)], indexing="ij"), axis=-1).reshape(-1, 2)
    largest = np.abs(p).max(1, keepdims=True)
    direction = np.tan(np.pi / 4 * p / np.maximum(largest, 1e-12))
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    flat = radius - edge
    core = 0.5 * flat * (0.6 * p + 0.4 * largest * direction)
    number = np.arange(side * side).reshape(side, side)
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    layers, heights = [core], [np.zeros(len(core))]
    for t in np.arange(1, 2 * FLAT + 1) / (2 * FLAT):
        layers.append((1.0 - t) * core[rim] + t * flat * direction[rim])
        heights.append(np.zeros(len(rim)))
    for a in STEEPEST * np.arange(1, 2 * ARC + 1) / (2 * ARC):
        layers.append((flat + edge * np.sin(a)) * direction[rim])
        heights.append(np.full(len(rim), edge * (np.cos(a) - 1.0)))
    rings = [rim, *(len(core) + k * len(rim) + np.arange(len(rim)) for k in range(len(layers) - 1))]
    closed = np.stack([np.append(r, r[0]) for r in rings])
    points = np.column_stack([np.vstack(layers), np.concatenate(heights)])
    return points, np.concatenate([_quads(number), _quads(closed)])
