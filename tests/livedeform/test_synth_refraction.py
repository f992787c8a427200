"""Where the truth's internal markers seem to be, against Snell's law on bodies whose surface is known."""

import numpy as np
import pytest
from scipy.optimize import brentq

from livedeform.synthetic.body_markers import BodyMarkers
from livedeform.synthetic.measuring.refraction import BodySurface, refracted
from livedeform.synthetic.truth import hexmesh

INDEX = 1.33
EYES = np.array([[-0.05, -0.2, 0.35], [0.05, -0.2, 0.35]])


def ball(radius, n=60):
    """Return a ball's surface, places some 2 mm apart."""
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi / 2, n // 2), np.linspace(0.0, 2 * np.pi, 2 * n), indexing="ij")
    normals = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return BodySurface(radius * normals.reshape(-1, 3), normals.reshape(-1, 3))


def leaves_ball(p, eye, radius):
    """Return where light from p to the eye leaves a ball about 0: in the plane of both, by Snell's law."""
    e1 = p / np.linalg.norm(p)
    e2 = eye - (eye @ e1) * e1
    e2 /= np.linalg.norm(e2)

    def place(angle):
        return radius * (np.cos(angle) * e1 + np.sin(angle) * e2)

    def miss(angle):
        s = place(angle)
        n, inside, outside = s / radius, (s - p) / np.linalg.norm(s - p), (eye - s) / np.linalg.norm(eye - s)
        return INDEX * np.cross(inside, n) @ np.cross(e1, e2) - np.cross(outside, n) @ np.cross(e1, e2)

    straight = np.arctan2(eye @ e2, eye @ e1)
    return place(brentq(miss, 0.0, straight))


@pytest.mark.parametrize("radius", [0.03, 0.045])
def test_light_leaves_a_ball_where_snells_law_says(radius):
    surface, rng = ball(radius), np.random.default_rng(2)
    points = rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.8], (6, 3)) * radius
    for eye in EYES:
        seen = refracted(points, surface, eye, INDEX)
        for p, q in zip(points, seen, strict=True):
            s = leaves_ball(p, eye, radius)
            ray = (s - eye) / np.linalg.norm(s - eye)
            # measured at most 1.4e-7 m; a flat surface straight above them is wrong by up to 5 mm
            assert np.linalg.norm(q - eye - ray * np.linalg.norm(p - eye)) < 1e-5


def leaves_flat(depth, above, reach):
    """Return how far aside of a point light leaves a flat surface, by Snell's law."""

    def miss(s):
        return (reach - s) / np.hypot(reach - s, above) - INDEX * s / np.hypot(s, depth)

    return brentq(miss, 0.0, reach)


def block():
    """Return a block's markers, two, inside, and its nodes' places."""
    mesh = hexmesh.block((0.06, 0.05, 0.04), (6, 5, 4))
    inside = np.flatnonzero((np.abs(mesh.nodes - [0.0, 0.0, 0.03]) < [0.006, 0.006, 1e-6]).all(axis=1))
    markers = BodyMarkers(np.zeros(0, np.int64), np.zeros((0, 9)), inside[:2], np.zeros((0, 3)), mesh)
    return markers, mesh.nodes


def test_a_flat_surface_refracts_by_the_law_of_tangents():
    markers, x = block()
    for eye in EYES:
        for p, q in zip(x[markers.nodes], refracted(x[markers.nodes], markers.surface(x), eye, INDEX), strict=True):
            depth, above, reach = 0.04 - p[2], eye[2] - 0.04, float(np.linalg.norm((eye - p)[:2]))
            s = leaves_flat(depth, above, reach)
            crossing = p + np.append((eye - p)[:2] / reach * s, depth)
            ray = (crossing - eye) / np.linalg.norm(crossing - eye)
            assert np.linalg.norm(q - eye - ray * np.linalg.norm(p - eye)) < 1e-7  # measured 8e-17


def test_a_point_is_lifted_by_one_minus_one_over_n_seen_from_straight_above():
    markers, x = block()
    eye = np.array([0.004, 0.0, 0.4])
    seen = refracted(np.array([[0.0, 0.0, 0.03]]), markers.surface(x), eye, INDEX)
    ray = (seen[0] - eye) / (seen[0] - eye)[2]
    at_surface = eye + ray * (0.04 - eye[2])
    # small angles: the ray leaves where depth / n is cut off the straight way
    expected = 0.004 * (0.01 / INDEX) / (0.01 / INDEX + 0.36)
    assert at_surface[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("elements", [(4, 1), (8, 2), (12, 3)], ids=["large", "usual", "small"])
def test_a_dome_of_any_elements_refracts_as_the_ball_that_it_is(elements):
    mesh = hexmesh.hemi_ellipsoid((0.045, 0.045, 0.045), *elements)
    markers = BodyMarkers(np.zeros(0, np.int64), np.zeros((0, 9)), np.zeros(0, np.int64), np.zeros((0, 3)), mesh)
    surface, points, off = markers.surface(mesh.nodes), np.array([[0.005, -0.004, 0.03], [-0.012, 0.006, 0.026]]), []
    for eye in EYES:
        for p, q in zip(points, refracted(points, surface, eye, INDEX), strict=True):
            ray = leaves_ball(p, eye, 0.045) - eye
            off.append(np.linalg.norm(q - eye - ray * np.linalg.norm(p - eye) / np.linalg.norm(ray)))
    assert max(off) < 1e-5  # measured 2.1e-6, 1.4e-7 and 2.5e-8 m


def test_it_turns_with_the_body():
    markers, x = block()
    turn = np.array([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]])
    eye = EYES[0]
    seen = refracted(x[markers.nodes], markers.surface(x), eye, INDEX)
    turned = refracted(x[markers.nodes] @ turn.T, markers.surface(x @ turn.T), turn @ eye, INDEX)
    np.testing.assert_allclose(turned, seen @ turn.T, atol=1e-8)


def test_without_refraction_nothing_moves():
    markers, x = block()
    for eye in EYES:
        np.testing.assert_allclose(
            refracted(x[markers.nodes], markers.surface(x), eye, 1.0), x[markers.nodes], atol=1e-8
        )


def test_what_lies_behind_the_horizon_is_not_seen():
    surface = ball(0.045)
    eye = np.array([0.2, 0.0, 0.1])
    near, far = np.array([[0.02, 0.0, 0.02]]), np.array([[-0.01, 0.043, 0.005]])
    assert np.isfinite(refracted(near, surface, eye, INDEX)).all()
    assert np.isnan(refracted(far, surface, eye, INDEX)).all()
