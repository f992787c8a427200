"""Where solutions are started from: it changes how long they take, not what they are."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import plane, soft

from livedeform.common import frames
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Cylinder
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.start import Extrapolation, SolvedMoment, WarmStart
from livedeform.fem_node.path.tangents import answers_linearly
from livedeform.fem_node.path.walk import Walk
from livedeform.fem_node.physics.fields import ModulusField
from livedeform.fem_node.physics.record import Probe, Prony, Support

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
GRAVITY = np.array([0.0, 0.0, -9.81])
HEIGHT = 0.03
WITHIN = 3e-5  # m: what the contact lets through, which ends within 0.01 mm of a gap


def moment(z: float, gravity: np.ndarray = GRAVITY) -> Moment:
    return Moment(0.0, np.inf, gravity, pose=frames.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, z])))


def noted(*heights: float) -> Extrapolation:
    """Solutions that are x = z, pressed by 1 + 100 z."""
    extrapolation = Extrapolation()
    for z in heights:
        extrapolation.note(moment(z), np.array([z]), np.array([1.0 + 100.0 * z, 0.0]))
    return extrapolation


def test_the_line_through_the_last_two_solutions_goes_on():
    x, multiplier = noted(0.030, 0.029, 0.028).at(moment(0.0265))
    np.testing.assert_allclose(x, 0.0265)
    np.testing.assert_allclose(multiplier, [3.65, 0.0])


@pytest.mark.parametrize(
    ("heights", "then"),
    [
        ((0.029,), moment(0.028)),
        ((0.03, 0.029), moment(0.025)),  # too far
        ((0.03, 0.029), moment(0.028, 2.0 * GRAVITY)),
        ((0.03, 0.029), replace(moment(0.028), pose=None)),
        ((0.03, 0.03), moment(0.028)),
        ((0.03, 0.029), replace(moment(0.0285), pose=moment(0.0285).pose + 0.01 * np.eye(4, k=3))),  # sideways
    ],
)
def test_where_the_line_does_not_lead_nothing_is_foreseen(heights, then):
    assert noted(*heights).at(then) is None


def test_a_body_that_was_put_elsewhere_knows_no_line():
    extrapolation = noted(0.03, 0.029)
    extrapolation.back_to(np.array([0.03]))
    assert extrapolation.at(moment(0.028)) is None


def phantom(**changes) -> PhantomModel:
    space = make_space(block_mesh((0.04, 0.04, HEIGHT), (4, 4, 3), origin=(-0.02, -0.02, 0.0)))
    supports = (Support(plane(2, 0.0)),)
    physics = soft(0.49, 4000.0, supports=supports, probe=Probe(Cylinder(0.01, 0.03, 0.005)))
    return PhantomModel(space, replace(physics, **changes), markers=np.array([[0.0, 0.013, HEIGHT], [0.012, 0, 0.02]]))


POSES = [Pose(k * 100_000_000, np.array([0.001, 0.0, 0.0297 - 4e-4 * k]), DOWN) for k in range(6)]


def test_a_press_on_the_line_is_the_press_from_rest():
    model = phantom()
    for pose in POSES:
        along = model.predict(pose)
    alone = phantom().predict(POSES[-1])
    assert along.converged and alone.converged
    assert np.abs(along.surface - alone.surface).max() < WITHIN


def test_a_run_that_starts_from_another_body_s_finds_its_own():
    base, softer = phantom(), phantom(material=replace(phantom().physics.material, youngs_modulus=3800.0))
    stamps = [pose.stamp_ns for pose in POSES]
    along = [Direction("E", softer.physics, 1.0)]
    solved = {}
    base.simulate(POSES, stamps, along, warm=WarmStart(solved))
    led = softer.simulate(POSES, stamps, [replace(along[0], at=1.0)], warm=WarmStart(solved))
    alone = softer.simulate(POSES, stamps)
    for a, b in zip(led.predictions, alone.predictions, strict=True):
        assert a.converged and np.abs(a.surface - b.surface).max() < WITHIN
    assert sum(p.n_iterations for p in led.predictions) < sum(p.n_iterations for p in alone.predictions)


def test_only_what_forgets_is_answered_linearly():
    plain = phantom().physics
    assert answers_linearly(plain, [replace(plain, prony=Prony((0.3,), (0.5,)))])
    assert not answers_linearly(plain.with_probe(friction=0.3), [plain.with_probe(friction=0.3)])
    assert not answers_linearly(plain, [plain.with_probe(friction=0.3)])
    assert not answers_linearly(plain, [replace(plain, supports=())])


def test_a_start_takes_over_the_error_of_the_one_before():
    contact = phantom().mechanics.contact
    points = len(contact.state.multiplier)

    def at(x: float, *pressed: float) -> SolvedMoment:
        multiplier = np.pad(np.array(pressed), (0, points - len(pressed)))
        return SolvedMoment(np.array([x]), (replace(contact.state, multiplier=multiplier), None, 0, 1.0), None)

    start = at(3.0, 5.0, 1.0, 0.0).corrected(at(1.0, 4.0, 2.0, 0.0), at(1.5, 6.0, 0.5, 2.0))
    np.testing.assert_allclose(start.x, 3.5)
    state = start.contact[0]
    np.testing.assert_allclose(state.multiplier[:4], [7.0, 0.0, 2.0, 0.0])
    np.testing.assert_array_equal(np.flatnonzero(state.touches), [0, 2])


class Softening(ModulusField):
    changes_with_time = True

    def __call__(self, X, t):
        return np.full(len(X), 1.0 - 0.01 * t)


def test_a_moment_that_nothing_touches_is_not_solved_again_for_what_drifts(monkeypatch):
    """The probe is clear of the body three times. What softens with time sags more each time; the body itself does
    not."""
    heights = (0.034, 0.0297, 0.0293, 0.033, 0.0295, 0.035)
    poses = [Pose(k * 500_000_000, np.array([0.001, 0.0, h]), DOWN) for k, h in enumerate(heights)]
    softening = replace(phantom(gravity=GRAVITY).physics, modulus_fields=(Softening(),))

    def simulated():
        return phantom(gravity=GRAVITY).simulate(poses, [p.stamp_ns for p in poses], [Direction("g", softening, 0.01)])

    short = simulated()
    monkeypatch.setattr(Walk, "_untouched", lambda *_: None)
    long = simulated()
    for a, b in zip(short.predictions, long.predictions, strict=True):
        assert a.converged and b.converged
        assert np.abs(a.markers - b.markers).max() < WITHIN
        np.testing.assert_allclose(a.force, b.force, atol=1e-3 * np.abs(b.force).max() + 1e-9)
    clear = np.abs(short.d_markers[[0, 3, 5]]).max(axis=(1, 2, 3))
    assert 1e-5 < 1.5 * clear[1] < clear[2]  # m, of the whole softening
    np.testing.assert_allclose(short.d_markers, long.d_markers, atol=1e-3 * np.abs(long.d_markers).max())
    iterations = [sum(p.n_iterations for p in s.predictions) for s in (short, long)]
    assert iterations[0] < iterations[1]
