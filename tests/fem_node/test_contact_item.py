"""The contact item alone: residual and tangent against its energy, search, force and torque."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.fem_node.contact.contact import make_contact
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.generate import block_mesh
from livedeform.fem_node.physics.record import Probe
from livedeform.fem_node.solve.assembly import Pattern, System, node_dofs

SPACE = make_space(block_mesh([0.04, 0.04, 0.02], [4, 4, 2]), "p2p0")
PATTERN = Pattern(SPACE.n_dof, [node_dofs(SPACE.cells)])
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()  # the probe's +z looks into the block from above


def moment(z, tilt=0.0, x=0.0):
    T = frames.transform(Rotation.from_euler("y", tilt).as_matrix() @ DOWN, np.array([x, 0.002, z]))
    return Moment(0.0, np.inf, np.zeros(3), pose=T)


def item(shape, **law):
    contact = make_contact(SPACE, Probe(shape, **law), 4000.0)
    contact.attach(PATTERN)
    return contact


@pytest.mark.parametrize("shape", [Box(0.02, 0.01, 0.03, 0.002), Cylinder(0.008, 0.02, 0.002), Sphere(0.01)])
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_residual_and_tangent_derive_from_the_energy(shape, friction):
    contact = item(shape, friction=friction)
    contact.law = replace(contact.law, curvature_limit=np.inf)  # the solver is spared that term far from equilibrium
    rng = np.random.default_rng(1)
    x = rng.normal(size=SPACE.n_dof) * 2e-5
    contact.prepare(moment(0.0197, 0.1))
    contact.update(x)
    contact.commit(x)
    contact.prepare(moment(0.0196, 0.1, 2e-4))
    system = System(PATTERN)
    contact.evaluate(x, system, tangent=True)
    direction = rng.normal(size=SPACE.n_dof)
    h = 1e-9
    up, down = System(PATTERN), System(PATTERN)
    energy_up = contact.evaluate(x + h * direction, up, tangent=False)
    energy_down = contact.evaluate(x - h * direction, down, tangent=False)
    slope = (energy_up - energy_down) / (2 * h)
    assert slope == pytest.approx(system.r @ direction, rel=1e-6)
    curvature = (up.r - down.r) / (2 * h)
    exact = system.matrix() @ direction
    assert np.linalg.norm(curvature - exact) < 1e-5 * np.linalg.norm(exact)


@pytest.mark.parametrize("shape", [Box(0.02, 0.01, 0.03, 0.002), Cylinder(0.008, 0.02, 0.002), Sphere(0.01)])
@pytest.mark.parametrize(
    "law",
    [
        {},
        {"adhesion": 300.0},
        {"formulation": "penalty"},
        {"friction": 0.4},
        {"friction": 0.4, "adhesion": 300.0},
        {"friction": 0.4, "formulation": "penalty"},
        {"formulation": "prescribed"},
    ],
)
def test_facets_that_are_left_out_bear_nothing(shape, law, monkeypatch):
    """Only facets that may act are looked at: all of them say the same, also of a surface that has moved away from
    where its multipliers, its friction's limits and its adhesion are."""
    rng, said = np.random.default_rng(2), []
    for left_out in (True, False):
        contact = item(shape, **law)
        if not left_out:
            monkeypatch.setattr(contact, "_acting", contact._points)
        contact.prepare(moment(0.0192, 0.1))
        x, asked = rng.normal(size=SPACE.n_dof) * 2e-5, []
        for z in (0.0192, 0.0196, 0.0201):
            contact.T = moment(z, 0.1, 3e-4).pose
            system = System(PATTERN)
            energy = contact.evaluate(x, system, tangent=True)
            asked += [energy, system.r, system.matrix().toarray(), *contact.wrench(x), contact.update(x)]
            state = contact.state
            asked += [state.multiplier, state.attached, state.limit, state.multiplier_t]
            contact.commit(x)
        said.append(asked)
        rng = np.random.default_rng(2)
    for with_few, with_all in zip(*said, strict=True):
        np.testing.assert_allclose(with_few, with_all, rtol=1e-12, atol=1e-12)


def test_force_and_torque_balance_the_residual():
    contact = item(Box(0.02, 0.01, 0.03, 0.002), friction=0.3)
    x = np.zeros(SPACE.n_dof)
    contact.prepare(moment(0.0195, 0.05, 0.003))
    contact.update(x)
    system = System(PATTERN)
    contact.evaluate(x, system, tangent=False)
    force, torque = contact.wrench(x)
    nodal = -system.r.reshape(-1, 3)  # what the probe does to the nodes
    assert np.allclose(force, nodal.sum(axis=0), rtol=1e-12)
    assert np.allclose(torque, np.cross(SPACE.nodes, nodal).sum(axis=0), rtol=1e-9, atol=1e-12)
    assert force[2] < 0 and contact.penetration(x) > 4e-4


def test_away_from_the_body_there_is_nothing():
    contact = item(Sphere(0.01), friction=0.3, adhesion=100.0)
    x = np.zeros(SPACE.n_dof)
    for m in (moment(0.0205), moment(0.1), Moment(0.0, np.inf, np.zeros(3))):
        contact.prepare(m)
        system = System(PATTERN)
        assert contact.evaluate(x, system, tangent=True) == 0.0
        assert not system.r.any() and not system.values.any()
        assert not contact.update(x)
        contact.commit(x)
        assert np.all(contact.wrench(x)[0] == 0)


def test_save_and_restore_undo_update_and_commit():
    contact = item(Sphere(0.01), friction=0.3)
    x = np.zeros(SPACE.n_dof)
    contact.prepare(moment(0.0199))
    saved = contact.save()
    before = System(PATTERN)
    contact.evaluate(x, before, tangent=False)
    contact.update(x)
    contact.commit(x)
    contact.prepare(moment(0.019))
    contact.restore(saved)
    after = System(PATTERN)
    contact.evaluate(x, after, tangent=False)
    assert np.array_equal(before.r, after.r)


def test_a_prescribed_surface_is_held_in_all_directions_and_let_go_when_pulled():
    contact = item(Box(0.02, 0.01, 0.03, 0.002), formulation="prescribed")
    x = np.zeros(SPACE.n_dof)
    contact.prepare(moment(0.0199))
    while contact.update(x) and contact.outer < 3:
        pass
    contact.commit(x)
    contact.prepare(moment(0.0199, x=1e-4))  # sideways: the surface resists although it is not pushed any deeper
    system = System(PATTERN)
    contact.evaluate(x, system, tangent=False)
    assert abs(contact.wrench(x)[0][0]) > 0.05
    contact.prepare(moment(0.0205))
    contact.update(x)
    contact.update(x)
    assert not contact.state.attached.any()
