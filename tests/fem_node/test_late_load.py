"""Loads that pull later than the body's own weight: what hangs later swings later, and only then weighs."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, symmetry

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.items.loads import hung_masses
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.timeline import Instant, Timeline
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import DeadLoad, Inertia, MaterialSpec, Prony

L, SIDE, STEP, GRAVITY = 0.1, 0.02, 0.002, np.array([0.0, 0.0, -9.81])
SPACE = block_space((SIDE, SIDE, L), (1, 1, 4))
WEIGHT = DeadLoad("weight", plane(2, L), np.array([0.0, 0.0, -0.8]))
BAR = replace(
    soft(0.0, 40000.0),
    supports=symmetry(0, 1, 2),
    loads=(WEIGHT,),
    inertia=Inertia(0.002),
    gravity=GRAVITY,
    material=MaterialSpec("linear", 40000.0, 0.0),
)


def late(delay: float, physics=BAR):
    return apply_effects(physics, [EffectValues("late_load", {"delay": np.array(delay)})])


def swing(physics, n: int = 60, gravity=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the top's height (n,) m above the unloaded one, a step after another from the release; without gravity
    only the load pulls."""
    mechanics = Mechanics(SPACE, physics, settings=EXACT)
    mechanics.advance(moment(load=0.0))
    top, height = np.argmax(SPACE.nodes.sum(axis=1)), []
    for k in range(n):
        mechanics.advance(moment(gravity, dt=STEP, still=False, acting=(k + 1) * STEP))
        height.append(mechanics.u[top, 2])
    return np.array(height)


def test_without_a_delay_nothing_changes():
    np.testing.assert_array_equal(swing(late(0.0)), swing(BAR))
    assert not memory_of(late(0.0)).drifts and memory_of(late(0.01)).drifts


def test_what_hangs_later_swings_in_the_same_way_later():
    at_once, later = swing(BAR), swing(late(10 * STEP))
    assert np.ptp(at_once) > 0.005  # m
    np.testing.assert_array_equal(later[:9], 0.0)
    np.testing.assert_allclose(later[12:], at_once[2:-10], atol=1e-4)


def test_within_a_step_it_changes_smoothly_with_the_delay():
    """du/d(delay) is minus the speed."""
    delay, h = 10.4 * STEP, 0.05 * STEP
    slope = (swing(late(delay + h)) - swing(late(delay - h))) / (2.0 * h)
    speed = np.gradient(swing(late(delay)), STEP)
    np.testing.assert_allclose(slope[20:-1], -speed[20:-1], atol=0.05 * np.abs(speed).max())  # measured 0.02


def test_until_it_pulls_it_does_not_weigh():
    """Of a bar that falls by its own weight the load's mass is no part before it pulls."""
    assert [hung.delay for hung in hung_masses(SPACE, late(0.01))] == [0.01]
    alone = swing(replace(BAR, loads=()), 20, GRAVITY)
    np.testing.assert_allclose(swing(late(1.0), 20, GRAVITY), alone, atol=1e-12)
    assert np.abs(swing(BAR, 20, GRAVITY) - alone).max() > 1e-4


@pytest.mark.parametrize(
    ("late_by", "share"), [(-0.01, 0.0), (0.0005, 0.75), (0.0015, 1.25), (0.0021, 1.0), (0.1, 1.0), (np.inf, 1.0)]
)
def test_the_step_in_which_it_begins_has_the_impulse_of_its_share(late_by, share):
    """Half of it is the next step's, which takes the mean of both ends: 0.25 of the time and 0.5 of the next step."""
    assert moment(dt=STEP, still=False, acting=0.03 + late_by).begun(0.03) == pytest.approx(share)
    assert moment(dt=STEP, acting=0.03 + late_by).begun(0.03) == float(late_by >= 0.0)


def test_the_first_step_has_all_of_it():
    assert moment(dt=STEP, still=False, acting=STEP).begun(0.0) == 1.0
    assert moment(dt=STEP, still=False, acting=STEP).begun(0.25 * STEP) == pytest.approx(0.75)


def test_a_step_of_time_ends_where_a_load_begins_to_pull():
    line = Timeline(0, 0, release=0.2, dynamic=True, delays=(0.0123456,))
    body = Mock(pace=lambda: 0.005)
    stamps = [i.stamp_ns for i in line.instants(200_000_000, 230_000_000, body)]
    assert 212_345_600 in stamps and stamps[-1] == 230_000_000 and max(np.diff(stamps)) <= 5_000_000
    at_once = line.instants(200_000_000, 212_346_000, body)  # as near as that to a stamp none is made
    assert min(np.diff([i.stamp_ns for i in at_once])) > 1_000_000


def test_the_timeline_counts_from_the_release():
    line = Timeline(0, 0, release=0.2, dynamic=True)
    for stamp, active, acting in ((100_000_000, False, -0.1), (250_000_000, True, 0.05)):
        assert line.moment(BAR, Instant(stamp, STEP, active), None).acting == pytest.approx(acting)
    assert Timeline(0, 0, release=0.0).moment(BAR, Instant(0, np.inf, active=True), None).acting == np.inf


RELEASE = 0.2  # s
CREEPING = replace(BAR, inertia=None, gravity=np.zeros(3), prony=Prony((0.4,), (0.5,)), release=RELEASE)
TOP = np.array([[0.0, 0.0, L]])


@pytest.mark.parametrize("delay", [0.1, 0.0123456789, 0.3])
@pytest.mark.parametrize("seconds", [(0.5, 1.5), (0.0, 0.5)])
def test_a_body_that_creeps_does_so_from_where_its_load_begins(delay, seconds):
    """Without inertia, too, there is a moment where the load begins, between two stamps or at one."""
    at_once, later = (
        [model.predict(None, stamp).markers[0, 2] for stamp in (0, *(round(1e9 * (RELEASE + d + s)) for s in seconds))]
        for d, model in ((d, PhantomModel(SPACE, late(d, CREEPING), markers=TOP)) for d in (0.0, delay))
    )
    assert at_once[-1] < L - 0.004
    np.testing.assert_allclose(later[-1], at_once[-1], atol=1e-9)  # it was up to 0.12 mm where the load came by a ramp


def test_the_creep_s_derivative_by_the_delay_is_that_of_whole_runs():
    delay, h, stamps = 0.1, 1e-3, [0, 150_000_000, *range(350_000_000, 1_500_000_000, 100_000_000)]

    def model(d):
        return PhantomModel(SPACE, late(d, CREEPING), markers=TOP)

    direction = Direction("delay", late(delay + 1e-5, CREEPING), 1e-5)
    found = model(delay).simulate(None, stamps, [direction], start_ns=0).d_markers[:, 0, 2, 0]
    runs = [model(delay + d).simulate(None, stamps, start_ns=0).predictions for d in (h, -h)]
    whole = np.array([(a.markers - b.markers)[0, 2] / (2.0 * h) for a, b in zip(*runs, strict=True)])
    assert np.abs(whole).max() > 1e-4  # m/s
    np.testing.assert_allclose(found, whole, atol=0.01 * np.abs(whole).max())
