"""Probe shapes: exact distances, unit gradients, and derivatives against finite differences."""

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh

from livedeform.common.errors import InputError, MeshError
from livedeform.common.experiment.surface import Surface
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Sphere, TriangleSolid, make_shape

ICOSPHERE = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
CUBE = trimesh.creation.box(extents=[0.02, 0.01, 0.03])

SHAPES = {
    "box": Box(0.06, 0.015, 0.04, 0.002),
    "cylinder": Cylinder(0.01, 0.03, 0.003),
    "sphere": Sphere(0.012),
    "mesh": TriangleSolid(np.asarray(CUBE.vertices), np.asarray(CUBE.faces)),
}


def random_points(shape, n=400, seed=0):
    """Points around and in a shape's skin."""
    low, high = shape.bounds
    return np.random.default_rng(seed).uniform(low - 0.005, high + 0.005, (n, 3))


@pytest.mark.parametrize("name", SHAPES)
def test_its_repr_says_all_of_a_shape(name):
    """Any field that differs in its last digits makes another repr, and equal ones an equal one."""
    shape = SHAPES[name]
    assert repr(replace(shape)) == repr(shape)
    for field in fields(shape):
        value = getattr(shape, field.name)
        other = np.array(value, copy=True)
        other.flat[other.size // 2] += 1 if other.dtype.kind == "i" else 1e-9
        assert repr(replace(shape, **{field.name: other if other.ndim else float(other)})) != repr(shape)


@pytest.mark.parametrize("name", SHAPES)
def test_gradient_is_a_unit_vector_and_matches_finite_differences(name):
    shape = SHAPES[name]
    points = random_points(shape)
    exact = shape.distance(points)
    assert np.allclose(np.linalg.norm(exact.gradient, axis=1), 1.0)
    h = 1e-7
    numeric = np.stack(
        [(shape.distance(points + h * e).d - shape.distance(points - h * e).d) / (2 * h) for e in np.eye(3)], axis=1
    )
    wrong = np.linalg.norm(numeric - exact.gradient, axis=1) > 1e-5
    assert wrong.sum() <= 2  # measured 0: a point within 1e-7 m of a medial plane may straddle it


@pytest.mark.parametrize("name", SHAPES)
def test_hessian_matches_finite_differences(name):
    shape = SHAPES[name]
    points = random_points(shape, seed=1)
    exact = shape.distance(points)
    h = 1e-7
    numeric = np.stack(
        [
            (shape.distance(points + h * e).gradient - shape.distance(points - h * e).gradient) / (2 * h)
            for e in np.eye(3)
        ],
        axis=2,
    )
    scale = 1.0 + np.abs(exact.hessian).max(axis=(1, 2))
    wrong = np.abs(numeric - exact.hessian).max(axis=(1, 2)) > 1e-3 * scale
    assert wrong.sum() <= 2  # measured 0: as above, where the nearest feature changes within 1e-7 m


def test_exact_distances_of_a_rounded_box():
    box = Box(0.06, 0.015, 0.04, 0.002)
    points = np.array(
        [[0, 0, 0.003], [0, 0, -0.001], [0.031, 0, -0.02], [0.030, 0.0, 0.0], [0.030, 0.0075, 0.0], [0.1, 0.2, 0.3]]
    )
    inner = np.array([0.028, 0.0055, -0.002])  # the corner about which the box's corner is rounded
    corner = lambda p: np.linalg.norm(p - inner) - 0.002  # noqa: E731
    edge = np.hypot(0.002, 0.002) - 0.002
    expected = [0.003, -0.001, 0.001, edge, corner(points[4]), corner(points[5])]
    assert np.allclose(box.distance(points).d, expected, atol=1e-15)


def test_exact_distances_of_cylinder_and_sphere():
    cylinder = Cylinder(0.01, 0.03, 0.003)
    rim = np.hypot(0.003, 0.003) - 0.003
    got = cylinder.distance(np.array([[0, 0, 0.002], [0.006, 0.008, 0.0], [0.012, 0, -0.01], [0, 0.009, -0.01]])).d
    assert np.allclose(got, [0.002, rim, 0.002, -0.001], atol=1e-15)
    assert np.allclose(
        Sphere(0.012).distance(np.array([[0, 0, 0.0], [0, 0, 0.001], [0.012, 0, -0.012]])).d, [0, 0.001, 0]
    )


def test_a_mesh_of_a_box_is_the_box():
    mesh = TriangleSolid(np.asarray(CUBE.vertices) - [0, 0, 0.015], np.asarray(CUBE.faces))
    box = Box(0.02, 0.01, 0.03)
    points = random_points(box, 2000, seed=2)
    assert np.allclose(mesh.distance(points).d, box.distance(points).d, atol=1e-15)


def test_a_mesh_of_a_sphere_has_its_distance_and_sign():
    mesh = TriangleSolid(np.asarray(ICOSPHERE.vertices), np.asarray(ICOSPHERE.faces))
    points = np.random.default_rng(3).normal(size=(500, 3)) * 0.008
    exact = np.linalg.norm(points, axis=1) - 0.01
    assert np.abs(mesh.distance(points).d - exact).max() < 2.5e-4  # measured 1.8e-4: the facets' sagitta


def test_a_mesh_is_as_round_as_its_ridges():
    """It was neither sharp nor round: a box of triangles was walked as a ball, 0.4 mm and 12 % of the force apart."""
    box = TriangleSolid(np.asarray(CUBE.vertices), np.asarray(CUBE.faces))
    assert box.roundness == 0.0
    for fine in (1, 2, 3):
        ball = trimesh.creation.icosphere(subdivisions=fine, radius=0.01)
        found = TriangleSolid(np.asarray(ball.vertices), np.asarray(ball.faces)).roundness
        assert 0.008 < found < 0.01  # measured 8.67 to 8.72 mm
    lying = trimesh.creation.capsule(height=0.04, radius=0.01, count=[32, 32])
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    found = TriangleSolid(np.asarray(lying.vertices), np.asarray(lying.faces)).roundness
    assert 0.006 < found < 0.01  # measured 6.6 mm
    rod = trimesh.creation.cylinder(0.01, 0.04, sections=32)
    assert TriangleSolid(np.asarray(rod.vertices), np.asarray(rod.faces)).roundness == 0.0  # its rim


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match="edge radius"):
        make_shape("box", [0.06, 0.015, 0.04], 0.01)
    with pytest.raises(InputError, match="not known"):
        make_shape("cone", [1, 2])
    with pytest.raises(InputError, match="positive"):
        make_shape("cylinder", [-0.01, 0.02])
    open_box = TriangleSolid(np.asarray(CUBE.vertices), np.asarray(CUBE.faces)[1:])
    with pytest.raises(MeshError, match="edges"):
        open_box.distance(np.zeros((1, 3)))


BALL = ICOSPHERE.copy().apply_translation([0.0, 0.0, -0.011])
BLOCK = trimesh.creation.box(extents=[0.03, 0.014, 0.04]).apply_translation([0.0, 0.0, -0.02])
WITHIN = trimesh.creation.icosphere(subdivisions=1, radius=0.005).apply_translation([0.0, 0.0, -0.02])
BESIDE = trimesh.creation.box(extents=[0.01, 0.01, 0.01]).apply_translation([0.03, 0.0, -0.005])


def _looking(meshes, turned):
    """Return vertices (n, 3) m and triangles (k, 3) of meshes, of which some triangles are turned around: by share."""
    mesh = trimesh.util.concatenate([m.copy() for m in meshes])
    ends = np.cumsum([len(m.faces) for m in meshes])
    triangles = np.array(mesh.faces)
    for end, m, share in zip(ends, meshes, turned, strict=True):
        some = slice(end - len(m.faces), end - len(m.faces) + round(share * len(m.faces)))
        triangles[some] = triangles[some, ::-1]
    return np.asarray(mesh.vertices), triangles


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize(
    ("meshes", "turned"),
    [([BALL], [1]), ([BALL], [0.5]), ([BLOCK], [1]), ([BLOCK], [0.3]), ([BLOCK, BESIDE], [0, 1]),
     ([BLOCK, BESIDE], [1, 0]), ([BLOCK, BESIDE], [0.5, 0.5])],
)  # fmt: skip
def test_whichever_way_the_triangles_look_outside_is_outside(tmp_path, meshes, turned, from_file):
    """Inside out all distances had the other sign, and every pose near the body was one of a probe inside it."""
    size = _looking(meshes, turned)
    if from_file:
        trimesh.Trimesh(*size, process=False).export(tmp_path / "probe.stl")
        size = tmp_path / "probe.stl"
    shape, sound = make_shape("mesh", size), make_shape("mesh", _looking(meshes, [0] * len(meshes)))
    points = random_points(sound)
    np.testing.assert_allclose(shape.distance(points).d, sound.distance(points).d, atol=1e-9)
    within = np.any([Surface(m.vertices, m.faces).contains(points) for m in meshes], axis=0)
    np.testing.assert_array_equal(sound.distance(points).d < 0.0, within)


@pytest.mark.parametrize("turned", [0, 1, 0.5])
def test_what_lies_within_a_probe_is_of_no_account(turned):
    hollow = make_shape("mesh", _looking([BLOCK, WITHIN], [0, turned]))
    points = random_points(hollow)
    full = make_shape("mesh", _looking([BLOCK], [0]))
    np.testing.assert_array_equal(hollow.distance(points).d, full.distance(points).d)


def test_an_open_probe_and_one_in_millimetres_are_refused():
    with pytest.raises(MeshError, match="not closed"):
        make_shape("mesh", (BLOCK.vertices, BLOCK.faces[2:]))
    with pytest.raises(MeshError, match=r"51.92 m across.*metres"):
        make_shape("mesh", (1000.0 * BLOCK.vertices, BLOCK.faces))
