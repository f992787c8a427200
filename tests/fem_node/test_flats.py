"""A drawing's flat faces: one body has one set of triangles, and one mesh, however its file cuts it up."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from triangulations import SHAPES, Shape, _blocks, _joined, surface

from livedeform.fem_node.mesh.generate import meshed
from livedeform.fem_node.mesh.quality import enclosed_volume, surface_distances
from livedeform.fem_node.mesh.repair.ears import cut
from livedeform.fem_node.mesh.repair.flats import GRID, redrawn
from livedeform.fem_node.mesh.surface import merge_vertices

Triangles = tuple[np.ndarray, np.ndarray]


def same(one: Triangles, other: Triangles) -> bool:
    """Whether two surfaces are the same vertices, to the mesher's grid, and triangles."""
    return (
        one[1].shape == other[1].shape
        and bool((one[1] == other[1]).all())
        and bool(np.abs(one[0] - other[0]).max() <= 1.01 * GRID)
    )


@pytest.mark.parametrize("name", ["box", "L", "slab"])
def test_a_body_of_flats_is_its_corners_however_it_is_cut_up(name: str) -> None:
    coarse = redrawn(*merge_vertices(*surface(name, "coarse")), 0.008)
    for triangulation in ("fine", "subdivided", "remeshed"):
        given = merge_vertices(*surface(name, triangulation))
        new = redrawn(*given, 0.008)
        assert same(new, coarse)
        assert len(new[1]) == (20 if name == "L" else 12)
        assert enclosed_volume(*new) == pytest.approx(enclosed_volume(*given), rel=1e-9)


@pytest.mark.parametrize("name", ["cylinder", "dome", "breast"])
def test_a_round_body_that_was_subdivided_is_the_coarse_one(name: str) -> None:
    coarse, halved = (
        redrawn(*merge_vertices(*surface(name, triangulation)), 0.008) for triangulation in ("coarse", "subdivided")
    )
    assert same(coarse, halved)


@pytest.mark.parametrize("seed", range(4))
def test_turned_and_single_precision_flats_are_flat(seed: int) -> None:
    """As an STL has them, anywhere in space."""
    R = Rotation.random(random_state=seed).as_matrix()
    turned = [
        np.float32(vertices @ R.T + [0.1, -0.05, 0.2]).astype(float)
        for vertices, _ in (surface("L", k) for k in ("coarse", "remeshed"))
    ]
    faces = [surface("L", k)[1] for k in ("coarse", "remeshed")]
    one, other = (redrawn(*merge_vertices(v, t), 0.008) for v, t in zip(turned, faces, strict=True))
    assert len(one[1]) == len(other[1]) == 20
    np.testing.assert_allclose(one[0], other[0], atol=2e-8)


def ring() -> Shape:
    """Eight blocks about an empty middle: a frame, whose top and bottom have a hole."""
    cells = [(i, j, 0) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return _blocks(cells, (0.02, 0.02, 0.02), (0.03, 0.03))


def test_faces_with_holes() -> None:
    shape = ring()
    rng = np.random.default_rng(0)
    fine = merge_vertices(*_joined(shape.patches(0.0025, 0.3, rng)))
    coarse = merge_vertices(*shape.coarse())
    one, other = redrawn(*fine, 0.008), redrawn(*coarse, 0.008)
    assert same(one, other) and len(one[0]) == 16
    assert enclosed_volume(*one) == pytest.approx(8 * 0.02**3, rel=1e-9)
    tube = trimesh.creation.annulus(0.01, 0.025, 0.03, sections=64)
    halved = trimesh.remesh.subdivide(*trimesh.remesh.subdivide(tube.vertices, tube.faces))
    one, other = (redrawn(*merge_vertices(np.array(v), np.array(t)), 0.008) for v, t in (
        (tube.vertices, tube.faces), halved))  # fmt: skip
    assert same(one, other)
    assert surface_distances(one, (np.array(tube.vertices), np.array(tube.faces)))[1].max() < 2e-9


@pytest.mark.parametrize("triangulation", ["scan 0.2 mm", "scan 0.5 mm"])
def test_a_scan_has_no_flats(triangulation: str) -> None:
    """But a few pairs of triangles that are flat by chance."""
    given = merge_vertices(*surface("box", triangulation))
    vertices, triangles = redrawn(*given, 0.008)
    assert np.abs(vertices - given[0]).max() <= GRID
    others = {frozenset(t) for t in given[1].tolist()} ^ {frozenset(t) for t in triangles.tolist()}
    assert len(others) < 0.005 * len(triangles)


@pytest.mark.parametrize("name", SHAPES)
def test_nothing_moves(name: str) -> None:
    given = merge_vertices(*surface(name, "fine"))
    new = redrawn(*given, 0.008)
    assert surface_distances(new, given)[1].max() < 2e-5 * 0.008


def test_a_gently_curved_surface_is_no_flat() -> None:
    """Neighbours are within the tolerance of one plane, the whole is not."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    flat = np.array(ball.vertices) * [1.0, 1.0, 3e-4]
    flat[:, 2] += 0.02 * (flat[:, 2] > 0.0)
    new = redrawn(flat, np.array(ball.faces), 0.008)
    assert surface_distances(new, (flat, np.array(ball.faces)))[1].max() < 2e-5 * 0.008


def test_an_outline_that_crosses_itself_is_not_cut() -> None:
    bow = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    assert cut(bow, [[0, 1, 2, 3]]) is None


@pytest.mark.parametrize("seed", range(5))
def test_ears_fill_a_star_with_holes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    star = rng.uniform(1.5, 3.0, 40)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    holes = [0.3 * np.column_stack([np.cos(-angle[::8]), np.sin(-angle[::8])]) + middle for middle in
             ([0.7, 0.2], [-0.6, 0.4], [0.0, -0.8])]  # fmt: skip
    points = np.concatenate([star, *holes])
    loops = [list(range(40)), *(list(range(40 + 5 * k, 45 + 5 * k)) for k in range(3))]
    triangles = cut(points, loops)
    assert triangles is not None and len(triangles) == 55 + 2 * 3 - 2
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    areas = 0.5 * (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    x, y = points.T
    whole = sum(0.5 * np.sum(x[k] * np.roll(y[k], -1) - y[k] * np.roll(x[k], -1)) for k in map(np.array, loops))
    assert areas.min() > 0.0 and areas.sum() == pytest.approx(whole)


def test_one_body_has_one_mesh(tmp_path: Path) -> None:
    digests = {
        meshed(*merge_vertices(*surface("L", triangulation)), 0.012, tmp_path)[1].digest
        for triangulation in ("coarse", "fine", "subdivided", "remeshed")
    }
    assert len(digests) == 1
