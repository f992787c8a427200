"""The model is never converged in a wrong state: jumps against walks, and what verification sees."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from livedeform.common import frames
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Pose
from livedeform.fem_node.contact import law as contact_law
from livedeform.fem_node.contact import verify
from livedeform.fem_node.contact.inside import is_inside
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Sphere, innermost, make_shape
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.live.live_model import LivePredictor
from livedeform.fem_node.mesh.structured import block_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.start import Start, WarmStart
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support
from livedeform.fem_node.simulator import SETTINGS
from livedeform.fem_node.solve.solver import Solver, SolverSettings

TOP = 0.04
COARSE = make_space(block_mesh((0.06, 0.06, TOP), (3, 3, 2)))
FINE = make_space(block_mesh((0.06, 0.06, TOP), (6, 6, 5)))  # 1080 cells
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
PROBES = {
    "ball": Sphere(0.008),
    "cylinder": Cylinder(0.01, 0.03, 0.001),
    "box": Box(0.03, 0.012, 0.03, 0.001),
}


def physics(shape, **law):
    return Physics(
        MaterialSpec("neo_hookean", 4000.0, 0.49),
        supports=(Support(lambda X: X[:, 2] < 1e-6),),
        probe=Probe(shape, **law),
    )


def pose(k, depth, x=0.003):
    return Pose(k * 33_333_333, np.array([x, 0.002, TOP - depth]), DOWN)


def walked(model, depth, step=5e-4):
    """The prediction at ``depth``, gone to from 1 mm above in short steps."""
    model.reset()
    depths = np.linspace(-0.001, depth, 1 + round((depth + 0.001) / step))
    return [model.predict(pose(k, d)) for k, d in enumerate(depths)][-1]


def agrees(answer, reference):
    """Within 1 % of the force and 0.05 mm everywhere on the surface."""
    size = np.linalg.norm(reference.force)
    assert reference.converged
    if not answer.converged:
        return False
    force = np.linalg.norm(answer.force - reference.force) / size
    return force < 0.01 and np.linalg.norm(answer.surface - reference.surface, axis=1).max() < 5e-5


JUMPS = {
    "first seen inside": [],
    "from 20 mm above": [-0.02],
    "6 mm and more from contact": [-0.001, 0.001, 0.002],
    "back from the far side": [-0.001, 0.2],
}


@pytest.mark.parametrize("probe", ["ball", *(pytest.param(p, marks=pytest.mark.slow) for p in ("cylinder", "box"))])
def test_a_jump_ends_where_a_walk_does(probe):
    """12 mm deep. In one step the force was 10 to 150 % off, and places 4 to 16 mm."""
    model = PhantomModel(COARSE, physics(PROBES[probe]))
    reference = walked(model, 0.012)
    then = model.predict(pose(99, 0.0125))
    for before in JUMPS.values():
        model.reset()
        for k, depth in enumerate(before):
            model.predict(pose(k, depth))
        assert agrees(model.predict(pose(20, 0.012)), reference)
        assert agrees(model.predict(pose(21, 0.0125)), then)


@pytest.mark.slow
@pytest.mark.parametrize("probe", PROBES)
def test_a_jump_ends_where_a_walk_does_on_a_finer_mesh(probe):
    model = PhantomModel(FINE, physics(PROBES[probe]))
    reference = walked(model, 0.012)
    for before in JUMPS.values():
        model.reset()
        for k, depth in enumerate(before):
            model.predict(pose(k, depth))
        assert agrees(model.predict(pose(20, 0.012)), reference)


def test_twelve_missing_poses_on_a_sideways_way():
    """A ball that jumps 6 mm sideways while it is deep inside ends where it would be had it come from above. Dragged
    there in one step it was off by 10 % of the force and 1.4 mm, as it is in twelve."""
    model = PhantomModel(COARSE, physics(PROBES["ball"]))
    above = model.predict(pose(0, 0.008, -0.003))
    walked(model, 0.008, 1e-3)
    assert agrees(model.predict(pose(113, 0.008, -0.003)), above)


def test_a_slide_over_elements_that_are_too_large_is_approached_from_above():
    """A cylinder with edges of 1 mm on facets of 20 mm: dragged by 1 mm it was off by 15 % of the force and 3 mm."""
    model = PhantomModel(COARSE, physics(PROBES["cylinder"]))
    above = model.predict(pose(0, 0.004, 0.002))
    walked(model, 0.004, 1e-3)
    slid = [model.predict(pose(100 + k, 0.004, 0.003 - 0.0005 * k)) for k in (1, 2)][-1]
    assert agrees(slid, above)


def test_a_long_slide_of_a_probe_that_is_a_mesh_is_approached_from_above():
    """Nobody knows its edges. Dragged by 6 mm on facets of 20 mm it pushed sideways by a fourth of its force, without
    any friction, and the surface was 4.5 mm off."""
    block = trimesh.creation.box((0.03, 0.012, 0.03), frames.transform(np.eye(3), np.array([0.0, 0.0, -0.015])))
    model = PhantomModel(COARSE, physics(make_shape("mesh", (block.vertices, block.faces))))
    down = [(depth, -0.002) for depth in (-0.001, 0.001, 0.003, 0.005)]
    slides = [(0.005, -0.002 + 0.001 * k) for k in range(1, 7)]
    slid = [model.predict(pose(k, *at)) for k, at in enumerate(down + slides)][-1]
    model.reset()
    above = [model.predict(pose(k, 0.001 * k - 0.001, 0.004)) for k in range(7)][-1]
    assert agrees(slid, above)


@pytest.mark.parametrize(("edge", "free"), [(0.012, 0.03), (0.006, 0.0025), (0.001, 0.0)])
def test_the_sharper_a_probe_is_for_the_elements_the_shorter_are_its_slides(edge, free):
    """Of facets of 20 mm: with edges above half of it slides are free, below a quarter there are none."""
    approach = Mechanics(COARSE, physics(Cylinder(0.0125, 0.03, edge))).contact.approach
    came = pose_matrix(-0.001)
    for by in (0.001, 0.002, 0.004, 0.02):
        assert approach.slid(came, frames.pose_matrix(pose(0, 0.01, 0.003 + by))) == (by > free)
    assert not approach.slid(came, pose_matrix(0.02))


def test_what_cannot_be_is_refused_and_does_not_stay():
    """A probe that ends in the middle of the body or below it: no number, the reason, and the next pose as if it had
    not been."""
    model = PhantomModel(COARSE, physics(PROBES["ball"]))
    reference = walked(model, 0.004)
    model.reset()
    model.predict(pose(0, -0.001))
    refused = model.predict(pose(1, 0.036))
    assert not refused.converged and np.isnan(refused.markers).all() and np.isnan(refused.force).all()
    assert refused.message
    assert agrees(model.predict(pose(2, 0.004)), reference)


@pytest.fixture
def factorisations(monkeypatch):
    counted, plain = [0], Solver.factorise

    def counting(self, x):
        counted[0] += 1
        plain(self, x)

    monkeypatch.setattr(Solver, "factorise", counting)
    return counted


def test_an_upside_down_probe_is_refused_at_once(factorisations):
    """A ball whose z axis points up, with its centre on the surface: its way in leads through the base that is held.
    Nothing is solved for it but the state at rest, and that once."""
    model = PhantomModel(COARSE, physics(PROBES["ball"]))
    place = np.array([0.003, 0.002, TOP + 0.008])
    for k in range(4):
        answer = model.predict(Pose(k * 33_333_333, place - [0.0, 0.0, 5e-4 * k], np.array([0.0, 0.0, 0.0, 1.0])))
        assert not answer.converged and "what holds" in answer.message and "z axis" in answer.message
    assert factorisations[0] <= 4


def test_a_probe_in_what_holds_the_body_is_refused_at_once(factorisations):
    model = PhantomModel(COARSE, physics(PROBES["ball"]))
    model.predict(pose(0, -0.001))
    spent = factorisations[0]
    assert "mm deep in what holds the body" in model.predict(pose(1, TOP + 0.002)).message
    assert factorisations[0] == spent


def test_a_refusal_is_bounded_and_not_repeated(factorisations):
    """A ball in the middle of the body, from above: what failed takes no more than ten usual steps, of at least
    `SolverSettings.least_usual` factorisations, beside the steps that were walked; the same pose again takes none, and
    one nearby neither."""
    model = PhantomModel(COARSE, physics(PROBES["ball"]))
    model.predict(pose(0, -0.001))
    spent = factorisations[0]
    refused = model.predict(pose(1, 0.036))
    settings = SolverSettings()
    assert not refused.converged
    assert factorisations[0] - spent <= 3 * settings.patience * settings.least_usual
    spent = factorisations[0]
    assert model.predict(pose(1, 0.036)).message == refused.message
    assert model.predict(pose(2, 0.0365)).message == refused.message  # half a millimetre further
    assert factorisations[0] == spent
    assert model.predict(pose(3, -0.0005)).converged  # a step from where the body is


class TwoEnds(PlainItem):
    """A spring per dof whose other end is ``apart`` m to the one or the other side each time a walk in short steps
    begins."""

    def __init__(self, apart):
        self.apart, self.end = apart, 0.0

    def couplings(self):
        return [np.arange(3)[None]]

    def furthest(self, x, start, moment, done):
        return min(1.0, done + 0.3)

    def prepare(self, moment):
        if 0.1 < moment.load < 0.2:
            self.end = self.apart
            self.apart = -self.apart

    def evaluate(self, x, system, *, tangent):
        system.add_vectors(np.arange(3)[None], (x - self.end)[None])
        if tangent:
            system.add_blocks(self.places, np.eye(3)[None])
        return 0.5 * float((x - self.end) @ (x - self.end))

    def attach(self, pattern):
        self.places = pattern.positions(np.arange(3)[None])


@pytest.mark.parametrize(("apart", "unique"), [(1e-6, True), (1e-3, False)])
def test_more_than_one_equilibrium_is_said(apart, unique):
    """Walks in pieces of different lengths that end in different places are no answer."""
    solver = Solver([TwoEnds(apart)], 3, np.array([[0.0, 0.0, 0.0]]))
    solver.size = 1.0
    start, end = Moment(0.0, np.inf, np.zeros(3), load=0.0), Moment(0.0, np.inf, np.zeros(3))
    if unique:
        assert np.abs(solver.solve(np.zeros(3), end, start).x).max() <= apart
    else:
        with pytest.raises(ConvergenceError, match="more than one equilibrium"):
            solver.solve(np.zeros(3), end, start)


def test_friction_is_dragged_along_on_the_way():
    """A jump of 8 mm with friction ends where short steps do: the way in is rubbed too."""
    model = PhantomModel(COARSE, physics(PROBES["ball"], friction=0.4))
    slow = walked(model, 0.008)
    model.reset()
    model.predict(pose(0, -0.001))
    fast = model.predict(pose(1, 0.008))
    assert fast.converged
    np.testing.assert_allclose(fast.force, slow.force, rtol=0.02, atol=2e-3)


@pytest.mark.parametrize("law", [{"friction": 0.8}, {"adhesion": 300.0}, {}])
def test_what_rubs_or_sticks_is_not_lifted_where_its_way_is_lost(law, monkeypatch):
    """A slide whose straight way is lost has no answer: pressed anew from above, a probe has dragged nothing along:
    sideways its force was -0.02 N instead of 0.08 (a box in a slide of 2 mm). A body without memory has one."""
    settings = replace(SETTINGS, condensed=False)
    body = Mechanics(COARSE, physics(PROBES["ball"], **law), settings=settings)
    deepest = 0.0 if "adhesion" in law else 0.002  # pulled: attached, and pressed nowhere
    for k, depth in enumerate((-0.001, 0.001, deepest)):
        body.advance(Moment(k, np.inf, np.zeros(3), pose=frames.pose_matrix(pose(k, depth, 0.0))))
    before, along = body.x.copy(), Solver._along
    if "adhesion" in law:
        assert body.contact.state.attached.any() and not body.contact.state.touches.any()

    def straight_is_lost(self, solution, way, stride):
        if len(way) == 2:
            raise ConvergenceError("the straight way is lost")
        return along(self, solution, way, stride)

    monkeypatch.setattr(Solver, "_along", straight_is_lost)
    aside = Moment(3.0, np.inf, np.zeros(3), pose=frames.pose_matrix(pose(3, deepest, 0.001)))
    if not law:
        body.advance(aside)
        assert body.wrench()[0][2] < -0.01
        return
    with pytest.raises(ConvergenceError, match="straight way is lost"):
        body.advance(aside)
    assert np.array_equal(body.x, before)


# -- verification, state by state --------------------------------------------------------------------------------------


def touched(**changes):
    """A sound contact of four points, changed."""
    sound = verify.Touched(
        gap=np.zeros(4),
        pressure=np.array([100.0, 200.0, 50.0, 0.0]),
        weight=np.full(4, 1e-6),
        attached=np.zeros(4, bool),
        facing=np.full(4, -1.0),
        deepest_between=0.0,
    )
    return sound._replace(**changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"gap": np.array([0.0, -1e-3, 0.0, 0.0])}, "inside the probe"),
        ({"gap": np.array([0.0, 1e-3, 0.0, 0.0])}, "from 1.00 mm away"),
        ({"pressure": np.array([100.0, -20.0, 0.0, 0.0])}, "pulls"),
        ({"facing": np.array([-1.0, 0.9, -1.0, 0.0])}, "from inside the body"),
        ({"deepest_between": 3e-3}, "between the contact points"),
    ],
)
def test_each_flaw_is_seen(changes, said):
    found = verify.flaw(touched(**changes), tolerance=2e-5, compliance=0.0, between=2e-3, pulls=0.0)
    assert (said in found) if said else found == ""


def test_a_surface_that_sticks_may_be_pulled_up_to_its_strength():
    pulled = touched(pressure=np.array([100.0, -20.0, 0.0, 0.0]), attached=np.array([False, True, False, False]))
    assert verify.flaw(pulled, tolerance=2e-5, compliance=0.0, between=2e-3, pulls=30.0) == ""
    assert "pulls" in verify.flaw(pulled, tolerance=2e-5, compliance=0.0, between=2e-3, pulls=10.0)


def test_a_probe_inside_an_undeformed_body_is_seen():
    """In balance (nothing is touched), without penetration, and wrong."""
    body = Mechanics(FINE, physics(Sphere(0.004)))
    body.contact.T = frames.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.016]))
    assert "inside the body" in body.contact.flaw(body.x)
    assert not body.contact.misses(body.x, body.contact.T)
    body.contact.T = frames.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, TOP + 1e-4]))
    assert body.contact.flaw(body.x) == ""


def test_an_element_that_is_inside_out_is_seen():
    body = Mechanics(COARSE, physics(PROBES["ball"]))
    assert body.continuum.flaw(body.x) == ""
    x = body.x.copy()
    corner = COARSE.cells[0, 0]
    x[3 * corner : 3 * corner + 3] += 2.5 * (COARSE.nodes[COARSE.cells[0, 1:4]].mean(axis=0) - COARSE.nodes[corner])
    assert "inside out" in body.continuum.flaw(x)


# -- wrong states put into a body that was solved rightly: each must be refused, by the check that is there for it -----


@pytest.fixture(scope="module")
def solved():
    """A ball 4 mm deep, with the state it was solved in."""
    body = Mechanics(COARSE, physics(PROBES["ball"]))
    body.advance(Moment(0.0, np.inf, np.zeros(3), pose=pose_matrix(0.004)))
    return body, body.save(), body.contact.save()


@pytest.fixture
def body(solved):
    mechanics, state, contact = solved
    mechanics.restore(state)
    mechanics.contact.restore(contact)
    yield mechanics
    mechanics.restore(state)


def swallowed_nodes(body):
    """The surface is where it was before the press, inside the probe."""
    return np.zeros_like(body.x)


def swallowed_probe(body):
    """The probe is in the middle of the body and touches nothing."""
    body.contact.T = pose_matrix(0.03)
    body.contact.state = replace(body.contact.state, multiplier=0.0 * body.contact.state.multiplier)
    return np.zeros_like(body.x)


def far_pressure(body):
    """The probe has gone up by 1 mm, and its pressures are those of before."""
    body.contact.T = pose_matrix(0.003)
    state = body.contact.state
    body.contact.state = replace(state, multiplier=50.0 * state.multiplier)
    return body.x


def between_the_points(body):
    """A node at a corner of the contact sticks out into the ball, deeper than contact points are apart."""
    x = body.x.copy()
    nearest = np.argmin(np.linalg.norm(COARSE.nodes - [0.003, 0.002, TOP], axis=1))
    x[3 * nearest + 2] += 0.006
    return x


def inside_out(body):
    """A corner far from the probe went through its element."""
    x, corner = body.x.copy(), COARSE.cells[0, 0]
    x[3 * corner : 3 * corner + 3] += 2.5 * (COARSE.nodes[COARSE.cells[0, 1:4]].mean(axis=0) - COARSE.nodes[corner])
    return x


WRONG = {
    swallowed_nodes: "inside the probe",
    swallowed_probe: "the probe is inside the body",
    far_pressure: "mm away",
    between_the_points: "the probe",
    inside_out: "inside out",
}


def test_what_was_solved_is_accepted(body):
    body.solver._verify(body.x)


@pytest.mark.parametrize("wrong", WRONG)
def test_each_wrong_state_is_refused(body, wrong):
    x = wrong(body)
    with pytest.raises(ConvergenceError, match=f"a wrong equilibrium was found: .*{WRONG[wrong]}"):
        body.solver._verify(x)


def test_a_tunnelled_side_is_refused():
    """A box has gone through the surface and pushes at it with its back, from within; no gap is wrong."""
    body = Mechanics(COARSE, physics(PROBES["box"]))
    body.contact.T = pose_matrix(0.03)
    body.contact.state = replace(body.contact.state, multiplier=np.full_like(body.contact.state.multiplier, 100.0))
    with pytest.raises(ConvergenceError, match="100 % of the contact force act on the surface from inside the body"):
        body.solver._verify(body.x)


def test_a_law_that_glues_is_refused(body, monkeypatch):
    """The probe went up by 0.2 mm, and a law without an inequality holds the surface."""
    plain = contact_law.normal

    def glued(gap, multiplier, penalty, attached, strength):
        return plain(gap, multiplier, penalty, attached, strength)._replace(pressure=multiplier - penalty * gap)

    monkeypatch.setattr(contact_law, "normal", glued)
    body.contact.T = pose_matrix(0.0038)
    with pytest.raises(ConvergenceError, match="pulls at a surface that does not stick"):
        body.solver._verify(body.x)


@pytest.mark.parametrize("space", [COARSE, make_space(hemi_ellipsoid_mesh((0.05, 0.04, 0.03), 4))])
def test_the_winding_number_tells_inside_from_outside(space):
    rng = np.random.default_rng(3)
    mesh = space.mesh
    inside = np.einsum(
        "na,nai->ni", rng.dirichlet(np.ones(4), 200), mesh.nodes[mesh.tets][rng.integers(0, len(mesh.tets), 200)]
    )
    outside = inside[:50] * 3.0 + [0.0, 0.0, 0.1]
    assert is_inside(inside, mesh.nodes, mesh.boundary_triangles).all()
    assert not is_inside(outside, mesh.nodes, mesh.boundary_triangles).any()


@pytest.mark.parametrize("shape", PROBES.values())
def test_the_innermost_point_is_inside(shape):
    low, high = shape.bounds
    assert shape.distance(innermost(shape)[None]).d[0] < -0.3 * (high - low).min() / 2


# -- live --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [0.0, pytest.param(0.02, marks=pytest.mark.slow), 0.5])
def test_a_live_session_starts_anywhere_retracts_and_returns(start):
    """A probe far above the body has no surface near it."""
    live = LivePredictor(PhantomModel(COARSE, physics(PROBES["ball"])))
    full = PhantomModel(COARSE, physics(PROBES["ball"]))
    rest = full.rest()
    walks = {depth: walked(full, depth) for depth in (0.004, 0.0045, 0.008)}
    for k, depth in enumerate((-start, -0.5 * start, 0.004, -start, 0.004, 0.0045, 0.008, -start, 0.004)):
        answer = live.predict(pose(k, depth))
        assert answer.converged
        expected = walks.get(depth, rest)
        assert np.abs(answer.surface - expected.surface).max() < 5e-5 + answer.error_bound
        np.testing.assert_allclose(answer.force, expected.force, rtol=0.02, atol=2e-3)


def test_a_live_answer_that_is_no_contact_is_left_to_the_full_model():
    """The library's nearest body, touched from the wrong side, is not an answer."""
    live = LivePredictor(PhantomModel(COARSE, physics(PROBES["ball"])))
    live.predict(pose(0, -0.02))
    entry = live.library[0]
    live.library[0] = replace(entry, T=pose_matrix(0.03))  # as if rest had been seen with the probe in the body
    answer = live.predict(pose(1, 0.03))
    assert live.counts.live == 0 and (not answer.converged or answer.force[2] < -1.0)


def pose_matrix(depth):
    return frames.pose_matrix(pose(0, depth))


def test_a_jump_of_the_loop_is_no_solution_if_it_pushes_surface_elsewhere():
    """A cylinder 6 mm deep at once: in balance, free of penetration, and by 11 % too light. It is walked instead."""
    shape, moments = PROBES["cylinder"], [pose(20, 0.006)]
    reference = walked(PhantomModel(COARSE, physics(shape)), 0.006)
    model = PhantomModel(COARSE, physics(shape), settings=SETTINGS)
    answer = model.simulate(moments, [p.stamp_ns for p in moments], warm=WarmStart()).predictions[0]
    assert agrees(answer, reference)
    body = model.mechanics
    body.advance(Moment(0.0, np.inf, np.zeros(3)))
    with pytest.raises(ConvergenceError, match="push surface elsewhere"):
        body._at_once(Start(body.x, jump=True), Moment(0.0, np.inf, np.zeros(3), pose=frames.pose_matrix(moments[0])))
