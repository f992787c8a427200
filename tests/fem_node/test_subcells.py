"""A modulus that jumps within elements: its integrals are right, however elements lie."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import moment, soft

from livedeform.fem_node.element import quadrature
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.element.subcells import SubCells, averaged, corners, middles, splits
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.fields import Ball, Skin, share_below

POINTS, WEIGHTS = quadrature.tetrahedron(2)


@pytest.mark.parametrize("times", [1, 2])
def test_the_parts_have_the_whole_s_middle_and_lie_inside(times: int) -> None:
    at = middles(times)
    assert at.shape == (8**times, 4)
    assert at.min() > 0.0
    np.testing.assert_allclose(at.sum(axis=1), 1.0)
    np.testing.assert_allclose(at.mean(axis=0), 0.25)
    assert len(np.unique(at.round(9), axis=0)) == len(at)


def test_a_linear_factor_stays_what_it_is() -> None:
    at_corners = np.array([[1.0, 2.0, 3.0, 5.0], [4.0, 4.0, 4.0, 4.0]])
    np.testing.assert_allclose(averaged(at_corners @ middles(2).T, POINTS, WEIGHTS), at_corners @ POINTS.T)
    np.testing.assert_allclose(averaged(at_corners @ middles(1).T, np.full((1, 4), 0.25), np.ones(1)), [[2.75], [4.0]])


@pytest.mark.parametrize("stiff", [0.1, 2.0, 50.0])
def test_a_jump_keeps_its_integral_and_nothing_is_softer_than_its_softest_part(stiff: float) -> None:
    jumps = np.where(middles(2)[:, 0] > 0.5, stiff, 1.0)[None]
    found = averaged(jumps, POINTS, WEIGHTS)
    assert found.min() >= min(stiff, 1.0)
    assert (found @ WEIGHTS)[0] == pytest.approx(jumps.mean())


def factor_of(mesh: TetMesh, field: Ball | Skin) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the factor (n,) of the modulus, the volumes (n,) m3 and the places (n, 3) m of all points."""
    body = Continuum(make_space(mesh), soft(modulus_fields=(field,)))
    body.prepare(moment())
    return body._factor.ravel(), body.weights.ravel(), body.unloaded_points.reshape(-1, 3)


@pytest.mark.parametrize("thickness", [0.003, 0.005, 0.007])
def test_a_thin_layer_keeps_its_volume_and_its_depth(thickness: float) -> None:
    size, mesh = np.array([0.08, 0.06, 0.045]), block_mesh([0.08, 0.06, 0.045], [6, 4, 3])
    factor, volumes, _ = factor_of(mesh, Skin(thickness, 2.0))
    inner = size - 2.0 * thickness
    held = np.prod(size) - np.prod(inner)  # no facet is held: the whole surface has a skin
    assert float((factor - 1.0) @ volumes) == pytest.approx(held, rel=0.05)


@pytest.mark.parametrize("thickness", [2e-4, 5e-4, 8e-4, 1e-3, 3e-3])
def test_a_layer_is_as_much_as_its_thickness_says_however_thin(thickness: float) -> None:
    """Over the depth below a flat face; smoothed over 1 mm, 0.5 mm made 1.125 times as much, and 0.2 mm 1.8 times."""
    corners = np.array([[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]])
    z = np.linspace(0.0, 0.01, 20001)
    factor = Skin(thickness, 11.0, corners)(np.column_stack([0.0 * z, 0.0 * z - 0.2, -z]), 0.0)
    assert np.trapezoid(factor - 1.0, z) == pytest.approx(10.0 * thickness, rel=1e-3)  # measured 0
    assert factor[0] == pytest.approx(11.0) and factor[z > thickness + 0.001].max() == 1.0


@pytest.mark.parametrize("thickness", [5e-4, 1e-3, 2e-3, 4e-3])
@pytest.mark.parametrize("n", [(3, 3, 2), (6, 6, 4)])
def test_a_layer_thinner_than_a_part_of_an_element_keeps_its_volume(n, thickness: float) -> None:
    """By the parts' middles alone a layer of 0.5 mm was not there at all in cells of 20 mm, and 38 % of it was missing
    in cells of 10 mm."""
    size = np.array([0.08, 0.08, 0.05])
    factor, volumes, _ = factor_of(block_mesh(size, n), Skin(thickness, 5.0))
    held = np.prod(size) - np.prod(size - 2.0 * thickness)  # no facet is held
    assert float((factor - 1.0) @ volumes) == pytest.approx(4.0 * held, rel=0.03)  # measured -2.0 % at most


def test_a_layer_grows_smoothly_with_its_thickness() -> None:
    """By the area of its inner face, at every thickness: a fit goes down the slope."""
    size, step = np.array([0.08, 0.08, 0.05]), 1e-4
    body = Continuum(make_space(block_mesh(size, (3, 3, 2))), soft())
    places = body.space.nodes[body.space.cells]
    parts = SubCells(places, splits(body.space.typical_size), quadratic=True)
    surface = body.space.mesh.nodes[body.space.mesh.boundary_triangles]
    volume = np.repeat(body.space.weights.sum(axis=1), parts.n) / parts.n
    thickness = np.arange(2e-4, 3e-3, step)
    layer = np.array([(Skin(t, 2.0, surface).over(parts, 0.0) - 1.0) @ volume for t in thickness])
    inner = np.array([size - 2.0 * t - step for t in thickness[:-1]])
    area = 2.0 * (inner[:, 0] * inner[:, 1] + inner[:, 1] * inner[:, 2] + inner[:, 2] * inner[:, 0])
    np.testing.assert_allclose(np.diff(layer) / step, area, rtol=0.03)  # measured 0.980 to 1.020


@pytest.mark.parametrize(
    ("values", "share"),
    [
        ([0.0, 0.0, 0.0, 1.0], lambda x: 1.0 - (1.0 - x) ** 3),
        ([1.0, 0.0, 1.0, 1.0], lambda x: x**3),
        ([0.0, 1.0, 0.0, 1.0], lambda x: x**2 * (3.0 - 2.0 * x)),
        ([-1.0, -1.0, -1.0, -1.0], lambda x: 1.0),
        ([2.0, 2.0, 2.0, 2.0], lambda x: 0.0),
    ],
)
def test_the_share_of_a_tetrahedron_below_a_level(values, share) -> None:
    for x in (0.0, 0.2, 0.5, 0.9, 1.0):
        assert share_below(np.array([values]), x)[0] == pytest.approx(share(x), abs=1e-12)


def test_the_share_below_a_level_is_the_sum_of_that_of_the_parts() -> None:
    values = np.random.default_rng(0).normal(size=(200, 4))
    parts = np.einsum("pcb,nb->npc", corners(1), values)
    for level in (-1.0, 0.0, 0.3, 2.0):
        of_parts = share_below(parts.reshape(-1, 4), level).reshape(-1, 8).mean(axis=1)
        np.testing.assert_allclose(share_below(values, level), of_parts, atol=1e-12)


@pytest.mark.parametrize("x", [0.0, 0.004, 0.009])
def test_a_small_ball_keeps_its_volume_and_its_place(x: float) -> None:
    factor, volumes, places = factor_of(block_mesh([0.08, 0.06, 0.045], [6, 4, 3]), Ball((x, 0.002, 0.025), 0.008, 1.1))
    more = (factor - 1.0) * volumes
    assert float(more.sum()) == pytest.approx(0.1 * 4.0 / 3.0 * np.pi * 0.008**3, rel=0.04)
    np.testing.assert_allclose(more @ places / more.sum(), [x, 0.002, 0.025], atol=3e-4)


@pytest.mark.parametrize("x", [0.0, 0.004, 0.009])
def test_a_stiff_ball_is_in_its_place_and_no_larger_than_it_is(x: float) -> None:
    ratio, radius, blur = 5.0, 0.008, 0.001
    factor, volumes, places = factor_of(
        block_mesh([0.08, 0.06, 0.045], [6, 4, 3]), Ball((x, 0.002, 0.025), radius, ratio)
    )
    more = (factor - 1.0) * volumes
    np.testing.assert_allclose(more @ places / more.sum(), [x, 0.002, 0.025], atol=3e-4)
    r = np.linspace(0.0, radius + blur, 4001)
    excess = ratio ** np.clip(0.5 - 0.5 * (r - radius) / blur, 0.0, 1.0) - 1.0
    assert float(more.sum()) == pytest.approx(np.trapezoid(4.0 * np.pi * r**2 * excess, r), rel=0.05)


def test_coarse_elements_are_split_more_often() -> None:
    assert [splits(h) for h in (0.003, 0.006, 0.014)] == [1, 1, 2]
