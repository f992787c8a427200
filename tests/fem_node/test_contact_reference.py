"""Contact against exact solutions: Hertz's sphere and Sneddon's flat punch on a quarter of a large block."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.fem_node.contact.probe_shapes import Cylinder, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.generate import TetMesh, block_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

E, NU = 4000.0, 0.49
E_STAR = E / (1.0 - NU**2)
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
FACES = 1e-3 * np.array([0.0, 1.25, 2.5, 3.75, 5.0, 7.5, 14.0, 35.0, 120.0])  # cells grow away from the contact


def quarter_block() -> TetMesh:
    """x, y >= 0 of a block of 240 x 240 x 120 mm with its top at z = 0."""
    n = len(FACES) - 1
    unit = block_mesh([n, n, n], n, origin=[0.0, 0.0, 0.0])
    nodes = np.interp(unit.nodes, np.arange(n + 1), FACES)
    nodes[:, 2] = -np.interp(n - unit.nodes[:, 2], np.arange(n + 1), FACES)
    return TetMesh(nodes, unit.tets)


def pressed(shape, depth) -> Mechanics:
    on = lambda axis, value: lambda p: np.abs(p[:, axis] - value) < 1e-9  # noqa: E731
    supports = (Support(on(0, 0.0), "sliding"), Support(on(1, 0.0), "sliding"), Support(on(2, -FACES[-1]), "fixed"))
    physics = Physics(MaterialSpec("neo_hookean", E, NU), gravity=np.zeros(3), supports=supports, probe=Probe(shape))
    body = Mechanics(make_space(quarter_block(), "p2p0"), physics)
    T = frames.transform(DOWN, np.array([0.0, 0.0, -depth]))
    body.advance(Moment(0.0, np.inf, np.zeros(3), pose=T))
    return body


def test_sphere_follows_hertz():
    radius, depth = 0.04, 0.0004
    body = pressed(Sphere(radius), depth)
    force = 4.0 * body.wrench()[0]
    hertz = 4.0 / 3.0 * E_STAR * np.sqrt(radius) * depth**1.5
    chi = np.sqrt(radius * depth) / FACES[-1]  # the block is not quite infinite: Dimitriadis et al. 2002, bonded
    assert -force[2] == pytest.approx(hertz * (1.0 + 1.133 * chi), rel=0.03)
    assert body.contact.penetration(body.x) < 2e-5
    where, pressure = body.contact.pressures(body.x)
    a = np.sqrt(radius * depth)
    assert np.hypot(where[:, 0], where[:, 1]).max() == pytest.approx(a, rel=0.2)  # the contact's radius
    peak = 2.0 * E_STAR * a / (np.pi * radius)
    inner = np.hypot(where[:, 0], where[:, 1]) < 0.5 * a
    exact = peak * np.sqrt(1.0 - (where[inner, 0] ** 2 + where[inner, 1] ** 2) / a**2)
    assert np.mean(pressure[inner]) == pytest.approx(np.mean(exact), rel=0.25)


@pytest.mark.slow
def test_flat_punch_follows_sneddon():
    radius, depth = 0.005, 0.0002
    body = pressed(Cylinder(radius, 0.02), depth)
    force = 4.0 * body.wrench()[0]
    chi = radius / FACES[-1]
    sneddon = 2.0 * E_STAR * radius * depth * (1.0 + 1.133 * chi)
    assert -force[2] == pytest.approx(sneddon, rel=0.03)
    assert body.contact.penetration(body.x) < 2e-5
    # how exactly the force is known: what 0.02 mm are worth by the quarter's own stiffness, 0.263 mN (here 0.385)
    worth = 2e-5 * 0.5 * E_STAR * radius
    assert worth < body.contact.reported_within(body.x) < 2.0 * worth
