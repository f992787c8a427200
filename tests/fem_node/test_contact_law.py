"""The contact laws: derivatives of their energies, complementarity, friction cone, letting go."""

import numpy as np

from livedeform.fem_node.contact.law import has_let_go, normal, tangential

RNG = np.random.default_rng(0)


def test_pressure_is_the_slope_of_the_energy_and_stiffness_of_the_pressure():
    gap = RNG.uniform(-1e-3, 1e-3, 200)
    multiplier = RNG.uniform(0, 3000, 200)
    attached = RNG.random(200) < 0.5
    law = lambda g: normal(g, multiplier, 1e7, attached, 400.0)  # noqa: E731
    h = 1e-10
    up, down, at = law(gap + h), law(gap - h), law(gap)
    smooth = (up.stiffness == down.stiffness) & ((up.pressure == 0) == (down.pressure == 0))
    assert smooth.mean() > 0.99
    slope = (up.energy - down.energy)[smooth] / (2 * h)
    assert np.allclose(slope, -at.pressure[smooth], atol=1e-4)  # Pa; measured 1.2e-5, rounding
    assert np.allclose(((up.pressure - down.pressure) / (2 * h))[smooth], -at.stiffness[smooth], rtol=1e-5, atol=1e-2)


def test_free_points_are_only_pushed_and_attached_ones_let_go():
    gap = np.array([-1e-4, 1e-5, 1e-4, 1e-3])
    free = normal(gap, np.zeros(4), 1e7, np.zeros(4, bool), 400.0)
    assert np.allclose(free.pressure, [1000.0, 0, 0, 0])
    stuck = normal(gap, np.zeros(4), 1e7, np.ones(4, bool), 400.0)
    assert np.allclose(stuck.pressure, [1000.0, -100.0, -400.0, -400.0])
    assert np.all(np.diff(stuck.energy[1:]) > 0)
    gone = has_let_go(gap, stuck.pressure, np.array([True, True, True, True]), 400.0, 2e-4)
    assert gone.tolist() == [False, False, False, True]


def test_friction_stays_in_its_cone_and_derives_from_its_energy():
    n = 100
    slip = RNG.normal(size=(n, 3)) * 1e-4
    normals = RNG.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    multiplier = np.cross(RNG.normal(size=(n, 3)) * 300, normals)
    limit = RNG.uniform(100, 2000, n)
    law = lambda s: tangential(s, normals, multiplier, limit, 1e7)  # noqa: E731
    at = law(slip)
    size = np.linalg.norm(at.traction, axis=1)
    assert np.all(size <= limit * (1 + 1e-12))
    assert 10 < np.sum(size > limit * (1 - 1e-9)) < 90  # both regimes are there
    assert np.abs(np.einsum("ni,ni->n", at.traction, normals)).max() < 1e-9
    h = 1e-10
    for i, e in enumerate(np.eye(3)):
        up, down = law(slip + h * e), law(slip - h * e)
        assert np.allclose((up.energy - down.energy) / (2 * h), -at.traction[:, i], atol=1e-2)
        assert np.allclose((up.traction - down.traction) / (2 * h), -at.stiffness[:, :, i], rtol=1e-4, atol=20.0)


def test_without_a_limit_friction_sticks_and_without_pressure_it_is_gone():
    slip = np.array([[1e-4, 0, 0], [1e-4, 0, 0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    at = tangential(slip, normals, np.zeros((2, 3)), np.array([np.inf, 0.0]), 1e7)
    assert np.allclose(at.traction, [[-1000.0, 0, 0], [0, 0, 0]])
    assert np.all(np.isfinite(at.energy)) and np.all(np.isfinite(at.stiffness))
