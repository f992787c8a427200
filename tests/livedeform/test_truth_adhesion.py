"""The truth's adhesion: it bears its strength over what is glued, and pulls as its work of separation asks."""

from __future__ import annotations

import numpy as np
import pytest
from truth_probes import BALL, PLATE, TOP, down

from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import block
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import OPENING, TruthProbe
from livedeform.synthetic.truth.solver import TruthBody

STRENGTH, E = 300.0, 4000.0  # Pa


def under(probe: TruthProbe, elements: tuple[int, int, int], **physics: float) -> TruthBody:
    """A flat block without weight, under a probe."""
    p = TruthPhysics(E, physics.pop("nu", 0.0), gravity=(0.0, 0.0, 0.0), adhesion=STRENGTH, **physics)  # type: ignore[arg-type]
    body = TruthBody(block((0.06, 0.05, TOP), elements), p, probe)
    body.rest(1)
    return body


def pulls(body: TruthBody, step: float, *, highest: float = 0.004, exact: float = 1.0) -> Array:
    """Press 1.5 mm deep and pull to ``highest`` (m) in steps (m) of ``step``; return the force (n,) N on the way up."""
    body.gap_tolerance /= exact
    body.slip_tolerance /= exact
    body.step(down(0.0, 0.0, TOP + 0.0002), 0.1)
    body.step(down(0.0, 0.0, TOP - 0.0015), 0.2)
    heights = np.arange(-0.0015, highest, step)
    return np.array([body.step(down(0.0, 0.0, TOP + z), 0.3 + k).force[2] for k, z in enumerate(heights)])


def test_a_plate_bears_its_strength_over_all_that_it_covers_and_then_lets_go() -> None:
    """An even tension s stretches the block by somewhat more than s / E of its height before its surface opens."""
    body = under(PLATE, (3, 2, 2))
    force = pulls(body, 1e-4, highest=1.5 * TOP * STRENGTH / E)
    assert force.max() == pytest.approx(STRENGTH * 0.06 * 0.05, rel=1e-6)
    last = int(np.flatnonzero(force > 0.0)[-1])
    assert force[last] > 0.9 * force.max()  # all at once
    assert np.abs(force[last + 1 :]).max() == 0.0
    assert not body.memory.contact.glued.any()


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_ball_pulls_the_same_however_exactly_its_contact_is_solved_on_the_way(friction: float) -> None:
    """Measured 1.1 % of the press's force, and 0.4 % of the pull's, for gaps solved to 20 and to 2.5 um."""
    one, other = (pulls(under(BALL, (6, 5, 2), nu=0.45, friction=friction), 5e-4, exact=exact) for exact in (1.0, 8.0))
    pulling = other > 0.0
    assert pulling.any()
    assert np.abs(one - other).max() < 0.02 * np.abs(other).max()
    assert np.abs(one - other)[pulling].max() < 0.01 * other.max()


@pytest.mark.slow
def test_a_ball_pulls_the_same_in_smaller_steps() -> None:
    one, other = pulls(under(BALL, (6, 5, 2), nu=0.45), 5e-4), pulls(under(BALL, (6, 5, 2), nu=0.45), 2.5e-4)[::2]
    assert one.max() > 0.0
    assert np.abs(one - other).max() < 0.001 * one.max()


@pytest.mark.slow
@pytest.mark.parametrize("strength", [500.0, 1500.0, 4000.0])
def test_a_ball_pulls_by_what_its_work_of_separation_asks_for(strength: float) -> None:
    """Johnson, Kendall & Roberts 1971. Measured 0.83, 0.95 and 0.80 times as much with elements of 10 mm: asked is
    within 0.3."""
    radius = 0.02
    physics = TruthPhysics(E, 0.49, adhesion=strength)
    body = TruthBody(block((0.06, 0.06, 0.04), (6, 6, 4)), physics, TruthProbe("sphere", (radius,)))
    body.rest(2)
    top = float(body.memory.x[:, 2].max())
    force = []
    for k, height in enumerate([2e-4, -2e-3, *np.arange(-1e-3, 6e-3, 1e-4)]):
        force.append(body.step(down(0.0007, 0.0011, top + height), 0.1 * (k + 1)).force[2])
        if k > 5 and not body.memory.contact.glued.any():
            break
    found = max(force) / (1.5 * np.pi * strength * OPENING * radius)
    print(strength, found)
    assert abs(found - 1.0) < 0.3
