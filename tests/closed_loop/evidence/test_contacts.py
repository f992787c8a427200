"""Where presses touch, and how deep they go: what a proposed motion goes by."""

from __future__ import annotations

import numpy as np
import pytest
import toy

from livedeform.closed_loop.assessment.next_experiment import ProbeReach, feasible
from livedeform.closed_loop.evidence.contacts import contacts_of
from livedeform.common.types import Pose

LIMITS = toy.SETTINGS.sampling.depth
Knot = tuple[float, float, float]  # s, m sideways, m below the top of the body


def motion(*knots: Knot) -> tuple[Pose, ...]:
    """Poses at 100 Hz through the knots, the probe's face down."""
    t, x, d = np.array(knots).T
    seconds = np.arange(0.0, 30.0, 0.01)
    down = np.array([1.0, 0.0, 0.0, 0.0])
    places = np.column_stack([np.interp(seconds, t, x), np.zeros(len(seconds)), toy.HEIGHT - np.interp(seconds, t, d)])
    return tuple(Pose(round(1e9 * s), p, down) for s, p in zip(seconds, places, strict=True))


def presses(far: float, depth: float, along: float, speed: float = 0.02) -> tuple[Pose, ...]:
    """Four presses from ``far`` above the body, each ``depth`` deep and ``along`` long."""
    knots: list[Knot] = [(0.0, 0.0, -far)]
    for begin in (1.5, 8.5, 15.5, 22.5):
        touch = begin + far / speed
        deep = touch + depth / 0.01
        knots += [(begin, 0.0, -far), (touch, 0.0, 0.0), (deep, 0.0, depth), (deep + 1.5, along, depth)]
        knots += [(deep + 1.5 + (far + depth) / speed, along, -far)]
    return motion(*knots)


@pytest.mark.parametrize(
    ("far", "depth", "along"), [(0.003, 0.008, 0.0), (0.04, 0.008, 0.0), (0.02, 0.004, 0.024), (0.04, 0.004, 0.0)]
)
def test_the_way_through_the_air_and_sideways_is_no_depth(far: float, depth: float, along: float) -> None:
    """An approach of 40 mm made every proposed press one in the air; a slide of 24 mm one of 15 mm into the body."""
    o = toy.record([], seed=1, poses=presses(far, depth, along), n=30)
    top, found, contacts = contacts_of([o], LIMITS)
    assert top is not None and len(contacts) == 4
    above = float(top.position[2]) - toy.HEIGHT
    assert -0.5e-3 < above < 3e-3  # measured 0.7 to 1.2 mm
    assert found == pytest.approx(depth + above, abs=1e-4)
    for plan in feasible(
        ProbeReach(np.array([-0.03, -0.03, 0.0]), np.array([0.03, 0.03, toy.HEIGHT]), top, found),
        top,
        toy.SETTINGS.proposal,
    ):
        deepest = toy.HEIGHT - min(float(p.position[2]) for p in plan.poses)
        assert deepest < depth + 1e-4
        assert deepest > 0.3 * depth
