"""A load that rubs where it hangs: Coulomb's swing, which loses as much in each period, and rests where it is held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, symmetry

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.items.rubbing_load import RubbingLoad
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import DeadLoad, Inertia, MaterialSpec
from livedeform.fem_node.solve.assembly import System

L, SIDE, STEP, MODULUS = 0.1, 0.02, 0.001, 40000.0
SPACE = block_space((SIDE, SIDE, L), (1, 1, 4))
FORCE = 0.8  # N
STIFFNESS = MODULUS * SIDE**2 / L  # N/m
BAR = replace(
    soft(0.0, MODULUS),
    supports=symmetry(0, 1, 2),
    loads=(DeadLoad("weight", plane(2, L), np.array([0.0, 0.0, -FORCE])),),
    inertia=Inertia(0.0),
    density=1.0,  # next to nothing beside what hangs: one oscillator
    gravity=np.array([0.0, 0.0, -9.81]),
    material=MaterialSpec("linear", MODULUS, 0.0),
)


def rubbing(ratio: float, give: float = 1e-5):
    values = {"ratio": np.array(ratio), "give": np.array(give)}
    return apply_effects(BAR, [EffectValues("load_friction", values)])


def swing(physics, n: int) -> np.ndarray:
    """Return how far (n,) m the top is above where it comes to rest without friction."""
    mechanics = Mechanics(SPACE, physics, settings=EXACT)
    mechanics.advance(moment(load=0.0))
    top, height = np.argmax(SPACE.nodes.sum(axis=1)), []
    for k in range(n):
        mechanics.advance(moment(dt=STEP, still=False, acting=(k + 1) * STEP))
        height.append(mechanics.u[top, 2])
    return np.array(height) + FORCE / STIFFNESS


def peaks(height: np.ndarray) -> np.ndarray:
    inner = height[1:-1]
    return np.abs(inner[(np.diff(height)[:-1] * np.diff(height)[1:]) < 0.0])


def test_without_friction_nothing_changes():
    np.testing.assert_array_equal(swing(rubbing(0.0), 30), swing(BAR, 30))
    assert not memory_of(rubbing(0.0)).slips and memory_of(rubbing(0.1)).slips


@pytest.mark.slow
def test_each_half_period_loses_as_much():
    """2 F / k, whatever the swing (Coulomb; Den Hartog 1931); what the steps of time lose besides is taken off."""
    ratio = 0.05
    with_friction, without = peaks(swing(rubbing(ratio), 1500))[:7], peaks(swing(BAR, 1500))[:7]
    lost = -np.diff(with_friction) + np.diff(without)
    np.testing.assert_allclose(lost, 2.0 * ratio * FORCE / STIFFNESS, rtol=0.1)


def test_it_rests_where_friction_holds_it():
    height = swing(rubbing(0.2), 1500)
    assert np.ptp(height[-200:]) < 1e-5
    assert abs(height[-1]) < 0.2 * FORCE / STIFFNESS


@pytest.mark.slow
def test_it_gives_before_it_slides():
    """A swing much smaller than that meets a spring of F / give, and is shorter."""
    give, ratio = 0.05, 2.0
    middle = FORCE / STIFFNESS - FORCE / (STIFFNESS + ratio * FORCE / give)
    swings = [swing(BAR, 600)[1:], swing(rubbing(ratio, give), 600)[1:] - middle]
    crossings = [np.flatnonzero(np.diff(np.sign(height))) for height in swings]
    periods = [2.0 * np.diff(c).mean() for c in crossings]
    stiffer = 1.0 + ratio * FORCE / give / STIFFNESS
    assert periods[0] / periods[1] == pytest.approx(np.sqrt(stiffer), rel=0.03)


@pytest.mark.parametrize("gone", [-3e-4, -1e-5, 2e-5, 4e-4])
def test_residual_and_tangent_are_derivatives_of_its_potential(gone):
    mechanics = Mechanics(SPACE, rubbing(0.1, 1e-4), settings=EXACT)
    item = next(i for i in mechanics.items if isinstance(i, RubbingLoad))
    system = System(mechanics.solver.pattern)
    x = np.zeros(SPACE.n_dof)
    item.prepare(moment(dt=STEP, still=False, acting=1.0))
    x[2::3] = -1.3e-4
    item.commit(x)  # a part of the friction acts already
    x[2::3] += gone

    def at(y, *, tangent=False):
        system.clear(tangent=tangent)
        return item.evaluate(y, system, tangent=tangent), system.r.copy()

    along, h = np.zeros_like(x), 1e-9
    along[2::3] = 1.0
    (low, r_low), (high, r_high) = at(x - h * along), at(x + h * along)
    energy, r = at(x, tangent=True)
    assert np.isfinite(energy)
    assert (high - low) / (2 * h) == pytest.approx(r @ along, rel=1e-5)
    np.testing.assert_allclose(system.times(along), (r_high - r_low) / (2 * h), rtol=1e-4, atol=1e-9)


def test_without_inertia_it_holds_back_what_sinks():
    mechanics = Mechanics(SPACE, replace(rubbing(0.1), inertia=None), settings=EXACT)
    mechanics.advance(moment(load=0.0))
    top = np.argmax(SPACE.nodes.sum(axis=1))
    for k in range(3):  # nothing moves any more after the first
        mechanics.advance(moment(dt=5.0, still=True, acting=5.0 * (k + 1)))
        assert mechanics.u[top, 2] == pytest.approx(-0.9 * FORCE / STIFFNESS, rel=1e-3)


def test_it_begins_with_its_load_and_goes_back_with_the_body():
    loads = tuple(replace(load, delay=0.5) for load in rubbing(0.1).loads)
    mechanics = Mechanics(SPACE, replace(rubbing(0.1), loads=loads), settings=EXACT)
    item = next(i for i in mechanics.items if isinstance(i, RubbingLoad))
    system, x = System(mechanics.solver.pattern), np.zeros(SPACE.n_dof)
    x[2::3] = -1e-3

    def force():
        system.clear(tangent=False)
        item.evaluate(x, system, tangent=False)
        return system.r.sum()

    item.prepare(moment(dt=STEP, still=False, acting=0.4))
    assert force() == 0.0
    item.prepare(moment(dt=STEP, still=False, acting=0.6))
    before, saved = force(), item.save()
    assert before == pytest.approx(-0.1 * FORCE, rel=1e-3)
    item.commit(x)
    x[2::3] = 0.0
    assert force() == pytest.approx(0.1 * FORCE, rel=1e-3)  # it turns with the motion
    x[2::3] = -1e-3
    item.restore(saved)
    assert force() == before
