"""Distances from and containment in closed surfaces, against shapes whose answers are known."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from livedeform.common.errors import MeshError
from livedeform.common.experiment.surface import Surface, read_surface


def ball(radius: float = 0.05) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def box() -> Surface:
    mesh = trimesh.creation.box((0.2, 0.1, 0.1))
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_distance_from_a_box_of_twelve_large_triangles(rng):
    points = rng.uniform(-0.3, 0.3, (200, 3))
    half = np.array([0.1, 0.05, 0.05])
    outside = np.linalg.norm(np.maximum(np.abs(points) - half, 0), axis=1)
    inside = np.minimum((half - np.abs(points)).min(axis=1), 1)
    expected = np.where(outside > 0, outside, inside)
    np.testing.assert_allclose(box().distance(points), expected, atol=1e-12)


def test_containment_and_distance_of_a_ball(rng):
    points = rng.uniform(-0.08, 0.08, (300, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 0.05) > 2e-4  # the facets cut 0.1 mm off the ball
    np.testing.assert_array_equal(ball().contains(points)[clear], radius[clear] < 0.05)
    np.testing.assert_allclose(ball().distance(points), np.abs(radius - 0.05), atol=2e-4)


def test_volume():
    np.testing.assert_allclose(box().volume, 0.002, rtol=1e-12)
    np.testing.assert_allclose(ball().volume, 4 / 3 * np.pi * 0.05**3, rtol=5e-3)  # measured 2.2e-3


@pytest.mark.parametrize(
    ("lower", "upper", "meets"),
    [
        ([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1], False),  # inside
        ([-0.1, -0.1, 0.4], [0.1, 0.1, 0.6], True),  # through a face, no corner of it inside
        ([-0.1, -0.1, 0.5], [0.1, 0.1, 0.6], True),  # on a face
        ([-0.1, -0.1, 0.51], [0.1, 0.1, 0.6], False),
        ([-2.0, -2.0, -2.0], [2.0, 2.0, 2.0], True),  # around it all
        ([0.4, 0.4, 0.4], [0.6, 0.6, 0.6], True),  # at a corner
        ([-2.0, -0.01, -0.01], [2.0, 0.01, 0.01], True),  # a needle through it
    ],
)
def test_a_box_meets_a_surface_where_one_of_its_triangles_reaches_in(lower, upper, meets):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    surface = Surface(np.asarray(box.vertices), np.asarray(box.faces))
    assert surface.meets_box(np.array(lower), np.array(upper)) == meets


def test_a_box_beside_a_slanted_triangle_does_not_meet_it():
    """The boxes of both overlap."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    surface = Surface(np.asarray(ball.vertices), np.asarray(ball.faces))
    for at, meets in ((0.62, False), (0.57, True), (0.5, False)):  # of the sphere along (1, 1, 1): 0.577
        middle = np.full(3, at)
        assert surface.meets_box(middle - 0.01, middle + 0.01) == meets, at


def test_a_hole_is_refused_with_its_place(tmp_path: Path) -> None:
    """Two holes in a ball, the larger at its top; in the file's unit."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    centres = mesh.triangles_center
    kept = (centres[:, 2] < 45.0) & (centres[:, 0] > -49.5)
    mesh.update_faces(kept)
    mesh.export(tmp_path / "ball.stl")
    with pytest.raises(MeshError, match="the largest of 2 holes is about") as caught:
        read_surface(tmp_path / "ball.stl", "mm")
    x, y, z = map(float, re.findall(r"about \((.*)\) in the file", str(caught.value))[0].split(","))
    assert abs(z - 45.0) < 2.0 and np.hypot(x, y) < 2.0
