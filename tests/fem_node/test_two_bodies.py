"""Two bodies that touch: patch test across meshes that do not match, balance, sliding, friction's limit, bonding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import moment, plane, soft, symmetry
from described import Body

from livedeform.common.errors import InputError
from livedeform.fem_node.contact.probe_shapes import Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import PlainItem
from livedeform.fem_node.items.two_bodies import TwoBodies, make_interface
from livedeform.fem_node.live.live_model import why_not_live
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.mesh.tet_mesh import join
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import DeadLoad, Interface, ModulusField, Probe, Support
from livedeform.fem_node.solve.assembly import Pattern, System, node_dofs
from livedeform.fem_node.solve.solver import SolverSettings

L = 0.02
WEIGHT = np.array([0.0, 0.0, -9.81])
SETTINGS = SolverSettings(tolerance=1e-11)
KINDS = {"frictionless": {}, "friction": {"friction": 0.5}, "rough": {"friction": np.inf}, "bonded": {"bonded": True}}


def stack(lower=2, upper=3, size=(L, L, L), kind="p2p0", above=None):
    """Two blocks on each other, in a corner of the axes, with ``lower`` and ``upper`` cells per side."""
    blocks = [block_mesh(size, lower, origin=(0, 0, 0)), block_mesh(above or size, upper, origin=(0, 0, size[2]))]
    return make_space(join(*blocks), kind)


def body(space, physics, interface=None, **options):
    """A `Mechanics` with an interface at z = L."""
    physics = replace(physics, interfaces=(interface or Interface(plane(2, L), **options),))
    mechanics = Mechanics(space, physics, settings=SETTINGS)
    return mechanics, next(item for item in mechanics.items if isinstance(item, TwoBodies))


@pytest.mark.parametrize("how", KINDS)
@pytest.mark.parametrize(("cells", "kind"), [((2, 3), "p2p0"), ((3, 2), "p2p0"), ((2, 3), "p2p1"), ((2, 3), "p1")])
def test_an_even_pressure_goes_through_meshes_that_do_not_match(how, cells, kind):
    """Contact patch test: two blocks under an even pressure deform as one homogeneous block, 15 % shorter."""
    load = DeadLoad("press", plane(2, 2 * L), np.array([0.0, 0.0, -600.0 * L**2]))
    physics = replace(soft(0.3), supports=symmetry(0, 1, 2), loads=(load,))
    space = stack(*cells, kind=kind)
    mechanics, _ = body(space, physics, **KINDS[how])
    mechanics.advance(moment(load=1.0))
    one = Mechanics(make_space(block_mesh((L, L, 2 * L), (1, 1, 2), origin=(0, 0, 0))), physics, settings=SETTINGS)
    one.advance(moment(load=1.0))
    corner = one.u[np.argmax(one.space.nodes.sum(axis=1))]
    exact = space.nodes * corner / [L, L, 2 * L]
    np.testing.assert_allclose(mechanics.u, exact, atol=1e-12)  # measured 7e-14 m
    assert corner[2] < -0.15 * L


class Gripped(PlainItem):
    """The nodes of the plane z = ``height`` moved by ``u`` (3,)."""

    def __init__(self, space, height):
        nodes = np.flatnonzero(np.abs(space.nodes[:, 2] - height) < 1e-9)
        self.dofs, self.u = (3 * nodes[:, None] + np.arange(3)).ravel(), np.zeros(3)

    def evaluate(self, x, system, *, tangent):
        return 0.0

    def constraints(self):
        return self.dofs, np.tile(self.u, len(self.dofs) // 3)


def forces(mechanics, item):
    """The interface's nodal forces (n, 3) N at the solution."""
    system = System(mechanics.solver.pattern)
    item.evaluate(mechanics.x, system, tangent=False)
    return system.r[: 3 * mechanics.space.n_nodes].reshape(-1, 3)


def weighing_stack(how, cells, kind="p2p0"):
    """A quarter of two gelatin cuboids on each other under their weight."""
    space = stack(*cells, size=(0.025, 0.025, 0.035), kind=kind)
    physics = replace(soft(0.49, 2896.0), supports=(Support(plane(2, 0.0)), *symmetry(0, 1)))
    mechanics, item = body(space, physics, Interface(plane(2, 0.035), reach=0.006, **KINDS[how]))
    mechanics.advance(moment(WEIGHT))
    return mechanics, item


@pytest.mark.parametrize("how", KINDS)
def test_the_lower_body_carries_the_upper_one(how):
    mechanics, item = weighing_stack(how, (3, 4))
    weight = 1000.0 * 9.81 * 0.025**2 * 0.035
    assert item.force(mechanics.x)[2] == pytest.approx(weight, rel=1e-6)  # measured 1e-12
    r = forces(mechanics, item)
    assert np.abs(r.sum(axis=0)).max() < 1e-12 * weight
    torque = np.cross(mechanics.space.nodes + mechanics.u, r).sum(axis=0)
    assert np.abs(torque).max() < 5e-4 * weight * 0.025  # measured 1e-4 frictionless, 6e-6 else: 1e-5 m of drift
    gap = item.gap(mechanics.x)
    assert np.nanmax(np.abs(gap)) < 2e-6  # measured 1.9e-7 m; closed everywhere
    assert np.all(item.pressures(mechanics.x) > -1e-9) or how == "bonded"


def test_a_bonded_stack_is_one_body():
    """On matching meshes, against one body of twice the height."""
    tops = {}
    for n in (2, 4):
        mechanics, _ = weighing_stack("bonded", (n, n))
        one = Mechanics(
            make_space(block_mesh((0.025, 0.025, 0.07), (n, n, 2 * n), origin=(0, 0, 0))),
            replace(mechanics.physics, interfaces=()),
        )
        one.advance(moment(WEIGHT))
        top = [np.argmin(np.linalg.norm(m.space.nodes - [0, 0, 0.07], axis=1)) for m in (mechanics, one)]
        tops[n] = mechanics.u[top[0], 2] / one.u[top[1], 2] - 1.0
    assert abs(tops[4]) < 1e-5 and abs(tops[4]) < abs(tops[2])  # measured 4e-6 and 9e-7 of the shortening


def test_without_friction_a_body_slides_over_many_elements():
    """A soft block is pressed on a stiff slab and dragged by 9 mm, nearly its own width: no force along the slab."""
    mechanics, item, grip = slider(friction=0.0, reach=0.011)
    normal = []
    for x in (0.0, 0.001, 0.003, 0.006, 0.009):
        grip.u = np.array([x, 0.0, -0.001])
        mechanics.advance(moment())
        force = item.force(mechanics.x)
        assert np.abs(force[:2]).max() < 1e-3 * force[2]
        normal.append(force[2])
    assert np.ptp(normal) < 3e-4 * normal[0]  # measured 6e-5


def slider(height=0.01, **interface):
    """A soft block of 10 x 10 mm on a slab a million times stiffer, gripped at its top."""
    slab = block_mesh((0.04, 0.02, 0.005), (6, 3, 1), origin=(-0.01, -0.005, 0))
    block = block_mesh((0.01, 0.01, height), (3, 3, max(1, round(300 * height))), origin=(0, 0, 0.005))
    space = make_space(join(slab, block))
    physics = replace(soft(), supports=(Support(plane(2, 0.0)),), modulus_fields=(StiffBelow(),))
    mechanics, item = body(space, physics, Interface(plane(2, 0.005), **interface))
    grip = Gripped(space, 0.005 + height)
    mechanics.items.append(grip)
    return mechanics, item, grip


class StiffBelow(ModulusField):
    def __call__(self, X, t):
        return np.where(X[:, 2] < 0.005, 1e6, 1.0)


def test_friction_sticks_first_and_then_drags_with_mu_times_the_normal_force():
    mechanics, item, grip = slider(height=0.004, friction=0.3, reach=0.003)
    ratios = []
    for x in (0.0, 1e-4, 2e-4, 5e-4, 1e-3, 1.3e-3):
        grip.u = np.array([x, 0.0, -0.0002])
        mechanics.advance(moment())
        force = item.force(mechanics.x)
        ratios.append(-force[0] / force[2])
    assert np.all(np.diff(ratios[:4]) > 0.01)
    assert ratios[1] < 0.1 and ratios[-1] == pytest.approx(0.3, rel=0.01)  # measured 0.2993


@pytest.mark.parametrize(("how", "holds"), [("frictionless", False), ("rough", False), ("bonded", True)])
def test_a_body_that_is_lifted_parts_unless_it_is_bonded(how, holds):
    mechanics, item, grip = slider(height=0.004, **KINDS[how])
    for z in (-0.0002, 0.0005):
        grip.u = np.array([0.0, 0.0, z])
        mechanics.advance(moment())
    force = item.force(mechanics.x)
    if holds:
        assert force[2] < -1e-3
    else:
        assert np.all(force == 0.0) and np.nanmin(item.gap(mechanics.x)) == pytest.approx(0.0005, rel=1e-6)


@pytest.mark.parametrize("how", ["frictionless", "friction", "bonded"])
def test_residual_and_tangent_derive_from_the_energy(how):
    space = stack(1, 2)
    item = make_interface(space, Interface(plane(2, L), **KINDS[how]), 3000.0)
    pattern = Pattern(space.n_dof, [node_dofs(space.cells), *item.couplings()])
    item.attach(pattern)
    rng = np.random.default_rng(1)
    x = 1e-5 * rng.standard_normal(space.n_dof)
    x[2::3] -= np.where(space.nodes[:, 2] > L + 1e-9, 2e-5, 0.0)
    for _ in range(3):
        item.update(x)
    x = x + 1e-5 * rng.standard_normal(space.n_dof)
    system, direction, h = System(pattern), rng.standard_normal(space.n_dof), 1e-10
    item.evaluate(x, system, tangent=True)
    up, down = System(pattern), System(pattern)
    slope = (
        item.evaluate(x + h * direction, up, tangent=False) - item.evaluate(x - h * direction, down, tangent=False)
    ) / (2 * h)
    assert slope == pytest.approx(system.r @ direction, rel=1e-5)
    curvature, exact = (up.r - down.r) / (2 * h), system.matrix() @ direction
    assert np.linalg.norm(exact) > 0.0
    assert np.linalg.norm(curvature - exact) < 1e-5 * np.linalg.norm(exact)


def test_a_body_of_two_parts_takes_an_interface():
    blocks = [block_mesh((L, L, L), 2, origin=(0, 0, z)) for z in (0, L)]
    body = Body.of(join(*blocks)).held(plane(2, 0.0)).touching(plane(2, L), bonded=True)
    assert body.solve().u[:, 2].min() < 0.0


def test_no_library_of_solutions_holds_for_two_bodies_or_friction_with_the_support():
    probe = Probe(Sphere(0.01))
    assert why_not_live(soft(probe=probe)) == ""
    assert "two bodies" in why_not_live(soft(probe=probe, interfaces=(Interface(plane(2, L)),)))
    assert "support" in why_not_live(soft(probe=probe, supports=(Support(plane(2, 0.0), "friction", mu=0.5),)))


def test_an_interface_needs_two_bodies():
    space = make_space(block_mesh((L, L, L), 2))
    with pytest.raises(InputError, match="1 bodies"):
        make_interface(space, Interface(lambda X: X[:, 2] > 0.009), 3000.0)
