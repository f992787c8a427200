"""Supports: sliding, springs, friction and curved ones; and the fallback without PARDISO."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, solve, symmetry

from livedeform.fem_node.effects import base_debonding
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.loads import Dead
from livedeform.fem_node.items.supports import supported_face
from livedeform.fem_node.mesh.structured import ball_mesh, block_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import DeadLoad, Support
from livedeform.fem_node.solve import linear_solver
from livedeform.fem_node.solve.assembly import System

L = 0.02


def test_springs_carry_the_load_by_their_stiffness():
    """A stiff block pushed sideways on tangential springs: F = k A u."""
    k, F = 2e5, 0.004
    load = DeadLoad("push", plane(0, L), np.array([F, 0.0, 0.0]))
    physics = replace(soft(0.3, 1e7), supports=(Support(plane(2, 0.0), "spring", stiffness=k),), loads=(load,))
    found = solve(block_space(), physics)
    base = np.abs(found.space.nodes[:, 2]) < 1e-9
    assert found.u[base, 0].mean() == pytest.approx(F / (k * L**2), rel=1e-4)  # measured 1.7e-6
    np.testing.assert_allclose(found.u[base, 2], 0.0, atol=1e-15)


def test_a_wall_that_begins_in_the_support_region_slips_as_the_base_does():
    """A scan's mesh has some small facets of its walls below any height. With one of them held along its normal this
    block slipped by 25 um instead of 56."""
    load = DeadLoad("push", plane(2, L), np.array([0.0, 0.004, 0.0]))

    def slipped(region):
        physics = replace(soft(0.3, 1e5), supports=(Support(region, "spring", stiffness=2e5),), loads=(load,))
        return solve(block_space(n=4), physics).u[:, 1].mean()

    base = plane(2, 0.0)
    with_a_wall = slipped(lambda X: base(X) | ((X[:, 2] < 0.002) & (X[:, 1] > 0.0199) & (X[:, 0] < 0.004)))
    assert with_a_wall == pytest.approx(slipped(base), rel=1e-9)


def test_a_bond_that_comes_free_does_so_smoothly():
    """A block that hangs over: its edge passes through the elements, so that a fit has something to go down."""
    weight = [9.81 * 0.3, 0.0, 0.0]
    fractions = np.linspace(0.1, 0.5, 17)
    found = []
    for fraction in fractions:
        bond = Support(plane(2, 0.0), "fixed")
        values = {"direction": np.array(0.0), "fraction": np.array(fraction)}
        physics = base_debonding.apply(replace(soft(0.45, 2e3), supports=(bond,)), values)
        found.append(float(solve(block_space(), physics, weight).u[:, 0].max()))
    rise = np.diff(np.log(found))
    assert rise.min() > 0.0
    assert (
        rise.max() < 3.0 * rise.mean()
    )  # measured 2.45; nodes that come free one row at a time leave steps of nothing


@pytest.mark.parametrize("angle", [0.0, 0.7])
@pytest.mark.parametrize("stiffness", [None, 3e5])
def test_a_bond_that_only_just_comes_free_is_the_bond(angle, stiffness):
    """Nodes at the rim went onto springs as soon as anything was free: with 1e-6 of the base free, a marker at the rim
    of a block of 60 mm in cells of 20, 10 and 5 mm sank by 0.53, 0.27 and 0.18 mm; now by less than 0.001."""
    whole = Support(plane(2, 0.0), *(("fixed",) if stiffness is None else ("spring", stiffness)))

    def hung(fraction):
        support = replace(whole, region=base_debonding.StillBonded(whole.region, angle, fraction))
        return solve(block_space(), replace(soft(0.45, 2e3), supports=(support,)), [9.81 * 0.3, 0.0, -2.0]).u

    bonded = hung(0.0)
    moved = [np.abs(hung(fraction) - bonded).max() for fraction in (1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.1)]
    assert moved[0] < 1e-4 * moved[-1]  # measured 0
    assert moved[1] < 2e-3 * moved[-1]  # 0; towards a corner 5.2e-4, since it comes free sooner
    assert moved[2] < 2e-2 * moved[-1]  # 3.8e-4, 5.1e-3
    assert min(np.diff(moved[1:])) > 0.0


@pytest.mark.parametrize(("mu", "sticks"), [(0.5, True), (0.05, False)])
def test_friction_holds_up_to_mu_times_the_pressure(mu, sticks):
    """A sideways pull of 0.2 weights: it sticks at mu = 0.5, at mu = 0.05 the spring takes the rest."""
    weight = 1000.0 * 9.81 * L**3
    pull = DeadLoad("pull", plane(0, L), np.array([0.2 * weight, 0.0, 0.0]))
    spring = Support(plane(0, 0.0), "spring")  # held along x on the other side: what friction leaves goes here
    supports = (Support(plane(2, 0.0), "friction", mu=mu), *((spring,) if not sticks else ()))
    physics = replace(soft(0.3, 1e5), supports=supports, loads=(pull,))
    mechanics = solve(block_space(), physics, [0.0, 0.0, -9.81])
    friction = next(item for item in mechanics.items if type(item).__name__ == "FrictionSupport")
    mechanics.prepare(moment([0.0, 0.0, -9.81]))
    system = System(mechanics.solver.pattern)
    system.clear(tangent=False)
    friction.evaluate(mechanics.x, system, tangent=False)
    force = -system.r[: 3 * mechanics.space.n_nodes].reshape(-1, 3).sum(axis=0)
    assert force[2] == pytest.approx(weight, rel=1e-6)
    if sticks:
        assert force[0] == pytest.approx(-0.2 * weight, rel=1e-6)
        assert np.abs(mechanics.u).max() < 1e-3
    else:
        assert abs(force[0]) <= mu * weight * 1.001


def test_a_body_that_rested_without_weight_is_held_by_friction_once_it_acts():
    """Without pressure at rest friction bore nothing there, and nothing held the body as its weight began to act."""
    physics = replace(soft(0.49, 4e3), supports=(Support(plane(2, 0.0), "friction", mu=0.5),))
    weight = [2.0, 0.0, -9.81]
    rested = Mechanics(block_space(), physics, settings=EXACT)
    rested.advance(moment(load=0.0))
    rested.advance(moment(weight))
    np.testing.assert_allclose(rested.u, solve(block_space(), physics, weight).u, atol=1e-9)


def test_a_sphere_held_along_its_normals_keeps_its_surface():
    space = make_space(ball_mesh(0.02, 4))
    everywhere = Support(lambda X: np.ones(len(X), bool), "sliding")
    mechanics = Mechanics(space, replace(soft(0.49), supports=(everywhere,)))
    mechanics.advance(moment([0.0, 0.0, -9.81]))
    nodes = np.unique(space.facets[:, :3])
    outward = space.nodes[nodes] / 0.02
    assert np.abs(np.einsum("ni,ni->n", mechanics.u[nodes], outward)).max() < 2e-5


def test_without_pardiso_scipy_gives_the_same_answer_and_says_that_it_is_slow(monkeypatch):
    physics = replace(soft(0.49), supports=symmetry(0, 1, 2))
    fast = solve(block_space(), physics, [0.0, 0.0, -9.81])
    monkeypatch.setattr(linear_solver, "PyPardisoSolver", None)
    monkeypatch.setattr(linear_solver, "_warned", False)
    with pytest.warns(RuntimeWarning, match="slower"):
        slow = solve(block_space(), physics, [0.0, 0.0, -9.81])
    np.testing.assert_allclose(slow.u, fast.u, atol=1e-12)


def rough(noise=1.5e-4, tilt=0.0):
    """A block with a scan's noise on its base, turned by ``tilt`` about x, on its element space."""
    mesh = block_mesh((0.05, 0.05, 0.03), (14, 14, 3), origin=(0.0, 0.0, 0.0))
    nodes = mesh.nodes.copy()
    base = nodes[:, 2] < 1e-9
    nodes[base, 2] += np.random.default_rng(0).normal(scale=noise, size=base.sum())
    c, s = np.cos(tilt), np.sin(tilt)
    return make_space(type(mesh)(nodes @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T, mesh.tets))


@pytest.mark.parametrize("kind", ["spring", "friction"])
def test_a_rough_flat_base_slides_along_its_plane(kind):
    """Held along the normals of its own roughness a scanned base locks: with them the first block slips by less than
    half."""
    load = DeadLoad("push", plane(2, 0.03, 1e-5), np.array([0.0, 0.01, -0.1]))
    grip = {"spring": {"stiffness": 2e4}, "friction": {"stiffness": 2e4, "mu": 0.6}}[kind]

    def slipped(space):
        support = Support(lambda X: X[:, 2] < 0.002, kind, **grip)
        return solve(space, replace(soft(0.3, 1e4), supports=(support,), loads=(load,))).u[:, 1].mean()

    assert slipped(rough()) == pytest.approx(slipped(rough(noise=0.0)), rel=0.01)


def test_the_plane_of_a_rough_tilted_base_is_found_and_a_cap_is_no_plane():
    tilt = np.radians(12.0)
    tilted = rough(tilt=tilt)
    face = supported_face(tilted, Support(lambda X: X @ [0.0, -np.sin(tilt), np.cos(tilt)] < 0.002, "spring"))
    assert face.axis is None
    np.testing.assert_allclose(face.normal, [0.0, np.sin(tilt), -np.cos(tilt)], atol=0.01)
    cap = supported_face(make_space(ball_mesh(0.05, 8)), Support(lambda X: X[:, 2] < -0.045, "spring"))
    assert cap.normal is None


@pytest.mark.parametrize("n", [(4, 4, 4), (5, 7, 4), (9, 8, 4)])
def test_a_load_acts_on_its_region_however_the_surface_is_meshed(n):
    """A disc on a block's top: the load's middle and its spread are the disc's, not those of some triangles."""
    radius, centre = 0.01, np.array([0.031, 0.022])
    mesh = block_mesh((0.06, 0.05, 0.03), n, origin=(0.0, 0.0, 0.0))
    space = make_space(mesh)
    disc = lambda X: (np.hypot(*(X[:, :2] - centre).T) < radius) & (X[:, 2] > 0.0299)  # noqa: E731
    system_force = Dead(space, DeadLoad("press", disc, np.array([0.0, 0.0, -2.0])))
    system_force.prepare(moment())
    share = system_force._force.reshape(-1, 3)[:, 2] / -2.0
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(share @ space.nodes[:, :2], centre, atol=0.02 * radius)
    offset = space.nodes[:, :2] - centre
    assert share @ (offset**2).sum(axis=1) == pytest.approx(0.5 * radius**2, rel=0.03)
