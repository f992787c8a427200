"""Distances from and containment in closed surfaces, against shapes whose answers are known."""

import numpy as np
import trimesh

from livedeform.common.experiment.surface import Surface


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
