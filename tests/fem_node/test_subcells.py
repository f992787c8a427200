"""A modulus that jumps within elements: its integrals are right, however elements lie."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import moment, soft

from livedeform.fem_node.element import quadrature
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.element.subcells import averaged, middles, splits
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.fields import Ball, Skin

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
