"""A body that is pressed until it passes through itself has no answer: contact with itself is not modelled."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import plane
from scipy.spatial.transform import Rotation

from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Sphere
from livedeform.fem_node.contact.self_contact import FacingParts
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Prony, Support

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
SIZE, HEIGHT, LOW, GAP = 0.06, 0.045, 0.03, 0.005  # m; GAP: of the hole, whose floor is at LOW
HOLES = {
    "cavity": (0.0, 0.015),
    "slit": (0.0, 1.0),
    "overhang": (0.03, 0.015),
}  # m: middle along x, half length along y
LEVELS = np.array([0.0, 0.02, LOW, LOW + GAP, HEIGHT])  # m


def holed(kind):
    """Return a block of 60 x 60 x 45 mm with a hole of 5 mm 10 mm below its top."""
    mesh = block_mesh((SIZE, SIZE, 4.0), (4, 4, 4))
    nodes = np.column_stack([mesh.nodes[:, :2], np.interp(mesh.nodes[:, 2], np.arange(5), LEVELS)])
    x, y, z = nodes[mesh.tets].mean(axis=1).T
    at, half = HOLES[kind]
    hole = (np.abs(x - at) < 0.015) & (np.abs(y) < half) & (z > LOW) & (z < LOW + GAP)
    return TetMesh.oriented(nodes, mesh.tets[~hole])


def sunk(nodes, share, kind):
    """Return nodes (n, 3) m, those above the hole moved down by a ``share`` of it, less so around its middle."""
    at = nodes[:, :2] - [HOLES[kind][0], 0.0]
    shape = np.exp(-((at / 0.015) ** 2).sum(axis=1))
    roof = np.abs(nodes[:, 2] - LOW - GAP) < 1e-9
    depth = share * GAP * shape / shape[roof].max() * np.clip((nodes[:, 2] - LOW) / GAP, 0.0, 1.0)
    return nodes - np.outer(depth, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("element", ["p1", "p2p0"])
@pytest.mark.parametrize("kind", HOLES)
def test_walls_that_have_passed_through_one_another_are_found(kind, element):
    space = make_space(holed(kind), element)
    parts = FacingParts.of(space)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for share, touches in ((0.0, False), (0.95, False), (1.3, True), (2.0, True)):
        places = sunk(space.nodes, share, kind)
        found = parts.touching(places)
        assert (found is not None) == touches
        assert (parts.touching(places @ turn.T + 0.1) is not None) == touches
        assert not touches or abs(found[2] - LOW) < GAP


def test_bodies_that_do_not_look_at_themselves_pay_nothing():
    dented = block_mesh((SIZE, SIZE, HEIGHT), (6, 6, 10))
    middle = dented.nodes[dented.tets].mean(axis=1)
    step = TetMesh.oriented(dented.nodes, dented.tets[~((middle[:, 0] > 0.0) & (middle[:, 2] > 0.5 * HEIGHT))])
    for mesh in (block_mesh((SIZE, SIZE, HEIGHT), 4), hemi_ellipsoid_mesh((SIZE, SIZE, HEIGHT), 6), step):
        assert not len(mesh.facing_triangles) and FacingParts.of(make_space(mesh, "p2p0")) is None


def test_two_bodies_look_at_one_another_and_what_crosses_in_the_scan_is_no_news():
    one = block_mesh((SIZE, SIZE, 0.01), (3, 3, 1))
    for tilt, crosses in ((0.0, False), (0.2, True)):  # rad, of the upper one: its edge goes into the lower one
        other = one.nodes @ np.diag([0.5, 0.7, 1.0]) @ Rotation.from_rotvec([0.0, tilt, 0.0]).as_matrix().T
        nodes = np.concatenate([one.nodes, other + np.array([0.0, 0.0, 0.012])])
        parts = FacingParts.of(make_space(TetMesh(nodes, np.concatenate([one.tets, one.tets + len(one.nodes)])), "p1"))
        assert bool(len(parts.crossed)) == crosses and parts.touching(nodes) is None
        lower = nodes - np.outer(np.arange(len(nodes)) >= len(one.nodes), [0.001, 0.002, 0.004])
        assert parts.touching(lower) is not None


@pytest.mark.parametrize("memory", [{}, {"prony": Prony((0.3,), (1.0,))}])
def test_a_pressed_cavity_is_refused_where_it_closes_and_is_as_before_once_the_probe_is_back(memory):
    """The roof went through the floor, by 0.75 and 2.3 mm, and nothing was said."""
    markers = np.array([[0.0, 0.0, LOW + GAP], [0.0, 0.0, LOW]])
    model = PhantomModel(
        make_space(holed("cavity"), "p2p0"),
        Physics(MaterialSpec("neo_hookean", 8000.0), supports=(Support(plane(2, 0.0)),), probe=Probe(Sphere(0.015)),
                **memory),
        markers=markers,
    )  # fmt: skip
    heights = (0.060, 0.040, 0.034, 0.040)
    found = [model.predict(Pose(10**9 + k * 100_000_000, np.array([0.0, 0.0, z]), DOWN)) for k, z in enumerate(heights)]
    assert [p.converged for p in found] == [True, True, False, True]
    assert "touches itself at (" in found[2].message and np.isnan(found[2].markers).all()
    for p in (found[1], found[3]):
        assert 0.0 < p.markers[0, 2] - p.markers[1, 2] < 0.5 * GAP
    if not memory:
        np.testing.assert_allclose(found[3].markers, found[1].markers, atol=2e-7)
