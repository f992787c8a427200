"""Six bodies, each as the kinds of triangle surface that people bring: vertices (n, 3) m and triangles (k, 3).

``coarse``: as few triangles as a CAD program writes (flat faces of two, round ones to 0.1 % of the volume); ``fine``:
regular ones of ``SIDE``; ``subdivided``: the coarse one, every triangle halved along its sides until those are short;
``remeshed``: irregular ones; ``scan``: irregular ones of ``SCAN_SIDE``, every vertex moved by Gaussian noise in all
three directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import Delaunay

Array = NDArray[np.float64]
Triangles = tuple[Array, NDArray[np.int64]]

SIDE, SCAN_SIDE = 0.0025, 0.002  # m
REGULAR, IRREGULAR = 0.02, 0.3  # of a side, by which points within a face are moved along it
TRIANGULATIONS = ("coarse", "fine", "subdivided", "remeshed", "scan 0.2 mm", "scan 0.5 mm")
ROUND = 72  # sides of a coarse circle


@dataclass(frozen=True)
class Shape:
    """``height`` m; ``patches`` makes it of triangles of a side (m), ``coarse`` of few."""

    height: float
    patches: Callable[[float, float, np.random.Generator], list[Triangles]]
    coarse: Callable[[], Triangles]
    halvings: int


def surface(name: str, triangulation: str, seed: int = 0) -> Triangles:
    """The body ``name`` of `SHAPES` in one of the `TRIANGULATIONS`; ``seed``: of noise and irregular triangles."""
    shape, kind, rng = SHAPES[name], triangulation.split()[0], np.random.default_rng(seed)
    if kind == "coarse":
        return shape.coarse()
    if kind == "subdivided":
        vertices, triangles = shape.coarse()
        for _ in range(shape.halvings):
            vertices, triangles = trimesh.remesh.subdivide(vertices, triangles)
        return vertices, triangles
    side = SCAN_SIDE if kind == "scan" else SIDE
    vertices, triangles = _joined(shape.patches(side, REGULAR if kind == "fine" else IRREGULAR, rng))
    if kind == "scan":
        vertices = vertices + rng.normal(scale=1e-3 * float(triangulation.split()[1]), size=vertices.shape)
    return vertices, triangles


def _joined(patches: list[Triangles]) -> Triangles:
    """Patches with equal vertices along their rims as one surface."""
    points = np.concatenate([p for p, _ in patches])
    starts = np.cumsum([0, *(len(p) for p, _ in patches)])
    triangles = np.concatenate([t + s for (_, t), s in zip(patches, starts, strict=False)])
    _, first, number = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[first], number.reshape(-1)[triangles].astype(np.int64)


def _facing(points: Array, triangles: NDArray[np.int64], outward: Callable[[Array], Array]) -> Triangles:
    """Triangles turned to look along ``outward`` (of their middles)."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    inward = (np.cross(b - a, c - a) * outward((a + b + c) / 3.0)).sum(axis=1) < 0.0
    return points, np.where(inward[:, None], triangles[:, ::-1], triangles).astype(np.int64)


def _rectangle(
    corner: Array, u: Array, v: Array, outward: Array, side: float, moved: float, rng: np.random.Generator
) -> Triangles:
    """A flat rectangle from ``corner`` along ``u`` and ``v``; points within it are moved along it at random."""
    n = [max(1, round(float(np.linalg.norm(w)) / side)) for w in (u, v)]
    i, j = (k.ravel() for k in np.meshgrid(*(np.arange(m + 1) for m in n), indexing="ij"))
    inner = (i > 0) & (i < n[0]) & (j > 0) & (j < n[1])
    flat = np.column_stack([i, j]).astype(float)
    flat += inner[:, None] * rng.uniform(-moved, moved, flat.shape)
    points = corner + np.outer(flat[:, 0] / n[0], u) + np.outer(flat[:, 1] / n[1], v)
    return _facing(points, Delaunay(flat).simplices, lambda middle: np.broadcast_to(outward, middle.shape))


def _blocks(cells: list[tuple[int, int, int]], cell: tuple[float, float, float], middle: tuple[float, float]) -> Shape:
    """Blocks beside each other, on z = 0 about the ``middle`` (x, y)."""

    def faces(side: float, moved: float, rng: np.random.Generator) -> list[Triangles]:
        out = []
        for at, axis, sign in product(cells, range(3), (-1, 1)):
            beside = list(at)
            beside[axis] += sign
            if tuple(beside) in cells:
                continue
            corner = np.array(at) * cell - [*middle, 0.0]
            corner[axis] += cell[axis] if sign > 0 else 0.0
            u, v = (np.eye(3)[k] * cell[k] for k in range(3) if k != axis)
            out.append(_rectangle(corner, u, v, sign * np.eye(3)[axis], side, moved, rng))
        return out

    def coarse() -> Triangles:
        return _joined(faces(1.0, 0.0, np.random.default_rng(0)))

    return Shape(cell[2] * (1 + max(c[2] for c in cells)), faces, coarse, 3)


def _disc(n_rings: int, n_around: int, moved: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 2) of the unit disc, ``n_around`` on its rim, and triangles."""
    points = [np.zeros((1, 2))]
    for k in range(1, n_rings + 1):
        n = n_around if k == n_rings else max(6, round(n_around * k / n_rings))
        shift = np.zeros((n, 2)) if k == n_rings else rng.uniform(-moved, moved, (n, 2))
        radius, angle = (k + shift[:, 0]) / n_rings, (np.arange(n) + shift[:, 1]) * 2.0 * np.pi / n
        points.append(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
    flat = np.concatenate(points)
    return flat, Delaunay(flat).simplices


def _base(radii: tuple[float, float], height: float, up: float, n: tuple[int, int], moved: float,
          rng: np.random.Generator) -> Triangles:  # fmt: skip
    flat, triangles = _disc(*n, moved, rng)
    points = np.column_stack([flat * radii, np.full(len(flat), height)])
    return _facing(points, triangles, lambda middle: np.broadcast_to([0.0, 0.0, up], middle.shape))


def _cylinder(radius: float, height: float) -> Shape:
    def patches(side: float, moved: float, rng: np.random.Generator) -> list[Triangles]:
        n_around, n_up = round(2.0 * np.pi * radius / side / 4) * 4, round(height / side)
        n = (round(radius / side), n_around)
        ends = [_base((radius, radius), z, up, n, moved, rng) for z, up in ((0.0, -1.0), (height, 1.0))]
        i, j = (k.ravel() for k in np.meshgrid(np.arange(n_around), np.arange(n_up + 1), indexing="ij"))
        inner = (j > 0) & (j < n_up)
        flat = np.column_stack([i, j]) + inner[:, None] * rng.uniform(-moved, moved, (len(i), 2))
        angle = 2.0 * np.pi * flat[:, 0] / n_around
        wall = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height * flat[:, 1] / n_up])
        a, right = np.arange(len(i)), (np.arange(len(i)) + n_up + 1) % len(i)
        a, right = a[j < n_up], right[j < n_up]
        triangles = np.concatenate([np.column_stack([a, right, right + 1]), np.column_stack([a, right + 1, a + 1])])
        return [*ends, (wall, triangles)]

    def coarse() -> Triangles:
        made = trimesh.creation.cylinder(radius, height, sections=ROUND)
        return np.add(made.vertices, [0.0, 0.0, 0.5 * height]), np.asarray(made.faces, np.int64)

    return Shape(height, patches, coarse, 2)


def _dome(axes: tuple[float, float, float]) -> Shape:
    """The upper half of an ellipsoid on its flat base."""

    def patches(side: float, moved: float, rng: np.random.Generator) -> list[Triangles]:
        n_around = round(2.0 * np.pi * max(axes) / side / 4) * 4
        n = (round(max(axes) / side), n_around)
        up = (round(0.5 * np.pi * max(axes) / side), n_around)
        flat, triangles = _disc(*up, moved, rng)
        radius = np.linalg.norm(flat, axis=1)
        ring = flat * (np.sin(0.5 * np.pi * np.minimum(radius, 1.0)) / np.maximum(radius, 1e-12))[:, None]
        top = np.column_stack([ring, np.cos(0.5 * np.pi * np.minimum(radius, 1.0))]) * axes
        top[np.abs(top[:, 2]) < 1e-9, 2] = 0.0
        return [_base(axes[:2], 0.0, -1.0, n, moved, rng), _facing(top, triangles, lambda middle: middle)]

    return Shape(axes[2], patches, lambda: _coarse_dome(axes), 1)


def _coarse_dome(axes: tuple[float, float, float]) -> Triangles:
    """Rings every 5 degrees, a fan at the top and one below."""
    n, rings = ROUND, ROUND // 4
    around, up = np.arange(n) * 2 * np.pi / n, np.arange(rings) * np.pi / 2 / rings
    ring = np.column_stack([np.cos(around), np.sin(around)])
    points = [np.column_stack([np.cos(a) * ring, np.full(n, np.sin(a))]) for a in up]
    vertices = np.concatenate([*points, [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]]) * axes
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = [
        part + n * k
        for k in range(rings - 1)
        for part in (np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n]))
    ]
    last = n * (rings - 1)
    top, low = np.full(n, n * rings), np.full(n, n * rings + 1)
    fans = [np.column_stack([i + last, j + last, top]), np.column_stack([j, i, low])]
    return vertices, np.concatenate([*sides, *fans])


SHAPES = {
    "box": _blocks([(0, 0, 0)], (0.05, 0.05, 0.07), (0.025, 0.025)),
    "cylinder": _cylinder(0.025, 0.06),
    "L": _blocks([(0, 0, 0), (1, 0, 0), (0, 0, 1)], (0.03, 0.04, 0.025), (0.015, 0.02)),
    "dome": _dome((0.045, 0.03, 0.035)),
    "slab": _blocks([(0, 0, 0)], (0.09, 0.07, 0.02), (0.045, 0.035)),
    "breast": _dome((0.05, 0.05, 0.045)),
}
