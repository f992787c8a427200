"""Triangles that cross others are all found, whatever their sizes and their number, in bounded memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from livedeform.common.errors import MeshError
from livedeform.fem_node.mesh.repair import crossings
from livedeform.fem_node.mesh.repair.crossings import crossing_pairs
from livedeform.fem_node.mesh.surface import repair_surface

Triangles = tuple[np.ndarray, np.ndarray]
RNG = np.random.default_rng(5)
TURN = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()


def together(*pieces: Triangles) -> Triangles:
    starts = np.cumsum([0, *(len(v) for v, _ in pieces)])
    return np.concatenate([v for v, _ in pieces]), np.concatenate(
        [t + s for (_, t), s in zip(pieces, starts, strict=False)]
    )


def ball(subdivisions: int, radius: float = 0.05, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Triangles:
    made = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(made.vertices) @ TURN.T + at, np.asarray(made.faces, np.int64)


def box(size: float, at: tuple[float, float, float]) -> Triangles:
    """Twelve large triangles."""
    made = trimesh.creation.box([size] * 3)
    return np.asarray(made.vertices) @ TURN + at, np.asarray(made.faces, np.int64)


def soup(n: int, n_huge: int) -> Triangles:
    """Loose triangles, ``n_huge`` of them some 25 times as large as the others."""
    corners = RNG.uniform(-0.05, 0.05, (n, 1, 3)) + 0.002 * RNG.standard_normal((n, 3, 3))
    corners[:n_huge] = 0.05 * RNG.standard_normal((n_huge, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def crumpled() -> Triangles:
    v, t = ball(3)
    return v + 0.006 * RNG.standard_normal(v.shape), t


SURFACES = {
    "a ball": lambda: ball(3),
    "two balls that overlap": lambda: together(ball(3), ball(2, at=(0.03, 0.01, 0.0))),
    "a ball and twelve huge triangles": lambda: together(ball(3), box(0.05, (0.04, 0.0, 0.0))),
    "a crumpled ball": crumpled,
    "small triangles alone": lambda: soup(1000, 0),
    "a few huge triangles among small ones": lambda: soup(1000, 20),
    "a sheet across the sweep": lambda: (lambda v, t: (v * [1e-6, 1.0, 0.9], t))(*crumpled()),
}
BALLS = ("a ball", "a ball and twelve huge triangles")  # others of these hold what they hold


def every_crossing(v: np.ndarray, t: np.ndarray) -> set[tuple[int, int]]:
    """Each edge with each triangle: where it meets the plane is solved for; what runs along the plane never does."""
    found, start = set(), v[t]
    way = np.roll(start, -1, axis=1) - start
    for k, (a, b, c) in enumerate(v[t]):
        columns = np.stack([np.broadcast_to(b - a, way.shape), np.broadcast_to(c - a, way.shape), -way], axis=-1)
        sizes = np.linalg.norm(columns, axis=-2).prod(axis=-1)
        meets = (np.abs(np.linalg.det(columns)) > 1e-12 * sizes) & ~np.isin(t, t[k]).any(axis=1)[:, None]
        x, y, along = np.linalg.solve(columns[meets], (start - a)[meets][:, :, None])[:, :, 0].T
        hit = (x > 0) & (y > 0) & (x + y < 1) & (along > 0) & (along < 1)
        found |= {(int(i), k) for i in np.nonzero(meets)[0][hit]}
    return found


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in BALLS)) for n in SURFACES])
def test_the_crossing_pairs_are_those_of_every_edge_with_every_triangle(name: str) -> None:
    v, t = SURFACES[name]()
    found = crossing_pairs(v, t)
    assert len(np.unique(found, axis=0)) == len(found)
    assert set(map(tuple, found.tolist())) == every_crossing(v, t)
    assert (len(found) == 0) == (name == "a ball")


def test_flat_faces_of_a_drawn_body_do_not_cross() -> None:
    """They are flat to round-off, which made crossings of two pairs here."""
    made = trimesh.creation.box((0.04, 0.05, 0.06)).subdivide().subdivide().subdivide()
    v, t = np.asarray(made.vertices), np.asarray(made.faces)
    assert len(crossing_pairs(v @ TURN.T, t)) == 0


def test_pairs_are_the_same_however_many_are_looked_at_together(monkeypatch: pytest.MonkeyPatch) -> None:
    v, t = soup(1000, 20)
    at_once = crossing_pairs(v, t)
    monkeypatch.setattr(crossings, "AT_ONCE", 7)
    np.testing.assert_array_equal(crossing_pairs(v, t), at_once)
    assert len(at_once) > 70  # measured 395: far more than seven are looked at


def hull(n: int) -> Triangles:
    """A ball of ``n`` triangles of many sizes."""
    points = RNG.standard_normal((n // 2 + 2, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1)[:, None]
    return points, ConvexHull(points).simplices.astype(np.int64)


def flat(n: int, n_huge: int) -> Triangles:
    """Small and huge triangles in one plane, of which none crosses any, and no plane tells that."""
    v, t = soup(n, n_huge)
    return v * [1.0, 1.0, 0.0], t


def peak_of(v: np.ndarray, t: np.ndarray) -> int:
    """Bytes that are held at once."""
    crossing_pairs(v, t[:1])  # compiled
    tracemalloc.start()
    assert len(crossing_pairs(v, t)) == 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_is_a_buffer_and_some_numbers_for_each_triangle() -> None:
    """Triangles above the ninetieth percentile were paired with all: 78 MB of 3000, 1174 of 12 000, too much of
    45 000."""
    few, more, many = (peak_of(*hull(n)) for n in (3_000, 12_000, 48_000))
    assert few < 4e6 and more < 8e6 and many < 25e6  # measured 1.8, 4.2 and 16.9 MB
    one, two = peak_of(*flat(3_000, 300)), peak_of(*flat(6_000, 600))  # with four times the pairs
    assert one < 60e6 and two < 1.1 * one  # measured 48.1 and 48.9 MB


@pytest.mark.slow
def test_a_surface_of_more_than_sixty_thousand_triangles_is_checked_too() -> None:
    """Four balls of 20 480 triangles, two of them one another's; too coarse for its elements to be thinned out."""
    places = ((0.0, 0.0, 0.0), (0.0, 0.03, 0.0), (0.05, 0.0, 0.0), (0.1, 0.0, 0.0))
    v, t = together(*(ball(5, 0.02, at) for at in places))
    assert len(t) == 81_920
    with pytest.raises(MeshError, match=r"two closed pieces of the surface overlap, as at \("):
        repair_surface(v, t, 0.004)
