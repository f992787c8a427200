"""A body that relaxes and was held for a while only: what it has not recovered it need not creep again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, plane, soft, symmetry

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.timeline import Timeline
from livedeform.fem_node.path.walk import Walk, sensitivities_of
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import DeadLoad, Inertia, MaterialSpec, Prony

L, SIDE, E, PULL, RELEASE = 0.1, 0.02, 4000.0, 100.0, 0.2  # m, m, Pa, Pa, s
SPACE = block_space((SIDE, SIDE, L), (1, 1, 4), kind="p2")
PRONY = Prony((0.2,), (1.5,))
BAR = replace(
    soft(0.0, E),
    supports=symmetry(0, 1, 2),
    loads=(DeadLoad("pull", plane(2, L), np.array([0.0, 0.0, PULL * SIDE**2])),),
    gravity=np.zeros(3),
    material=MaterialSpec("linear", E, 0.0),
    prony=PRONY,
    release=RELEASE,
)
TOP = int(np.argmax(SPACE.nodes.sum(axis=1)))
SECONDS = np.r_[0.1, np.geomspace(0.21, 3.0, 40)]


def held_for(seconds, physics=BAR):
    return replace(physics, held_for=seconds)


def walk_of(physics, sensitivities=None, mechanics=None):
    mechanics = mechanics or Mechanics(SPACE, physics, settings=EXACT)
    line = Timeline(0, 0, RELEASE, dynamic=physics.inertia is not None, hung=bool(memory_of(physics).hung))
    return Walk(mechanics, line, sensitivities=sensitivities)


def top(physics, seconds=SECONDS):
    """Return the end's displacement (k,) m at ``seconds`` of the recording."""
    walk, out = walk_of(physics), []
    for t in seconds:
        walk.to(round(1e9 * t))
        out.append(walk.body.u[TOP, 2])
    return np.array(out)


@pytest.mark.parametrize("seconds", [0.7, 4.0, 1e4])
def test_it_creeps_by_what_it_had_recovered(seconds):
    """With u = u_hung - c exp(-t / ((1 + beta) tau)) of a bar that is pulled, c is 1 - exp(-held / tau) of what it is
    of a body that has forgotten."""
    mu, beta = 0.5 * E, PRONY.g[0] / (1.0 - PRONY.g[0])
    forgotten = 1.0 - np.exp(-(seconds + RELEASE) / PRONY.tau[0])  # it is held in the recording as well
    creep = L * PULL / (3.0 * mu) * beta / (1.0 + beta) * forgotten
    exact = L * PULL / E - creep * np.exp(-(SECONDS - RELEASE) / ((1.0 + beta) * PRONY.tau[0]))
    exact[SECONDS < RELEASE] = 0.0
    np.testing.assert_allclose(top(held_for(seconds)), exact, atol=1e-4 * creep)  # steps of time; measured 3e-5


def test_held_for_long_is_not_having_hung():
    """Also of a body that swells, which rests elsewhere than it was scanned."""
    swollen = apply_effects(BAR, [EffectValues("swelling", {"rate": np.array(0.0), "offset": np.array(0.02)})])
    for physics in (BAR, swollen, replace(swollen, inertia=Inertia(0.002))):
        np.testing.assert_allclose(top(held_for(1e5, physics), SECONDS[:9]), top(physics, SECONDS[:9]), rtol=1e-6)


def test_a_body_that_cannot_hang_says_so():
    soft_bar = replace(BAR, loads=(DeadLoad("pull", plane(2, L), np.array([0.0, 1e6, 0.0])),))
    soft_bar = replace(soft_bar, material=MaterialSpec("neo_hookean", E, 0.3), held_for=2.0)
    with pytest.raises(ConvergenceError, match="hung before it was held"):
        walk_of(soft_bar).to(10**8)


def test_a_body_that_does_not_relax_has_nothing_to_remember():
    elastic = replace(BAR, prony=None)
    np.testing.assert_array_equal(top(held_for(0.5, elastic)), top(elastic))


@pytest.mark.parametrize("inertia", [None, pytest.param(Inertia(0.002), marks=pytest.mark.slow)])
def test_sensitivities_know_how_it_was_held(inertia):
    """Of the time, the modulus and the relaxation, against differences of two runs."""
    physics = held_for(2.0, replace(BAR, inertia=inertia))
    changed = {
        "seconds": lambda h: held_for(2.0 + h, physics),
        "modulus": lambda h: physics.with_material(youngs_modulus=E * (1.0 + h)),
        "swelling": lambda h: apply_effects(
            physics, [EffectValues("swelling", {"rate": np.array(0.0), "offset": np.array(h)})]
        ),
        "g": lambda h: replace(physics, prony=Prony((0.2 + h,), (1.5,))),
    }
    width = 1e-5  # wider, and the two runs of a difference may take other steps of time
    leader = Mechanics(SPACE, physics, settings=EXACT)
    directions = [Direction(name, of(width), width) for name, of in changed.items()]
    sensitivities = sensitivities_of(leader, directions, [None] * len(directions))
    walk = walk_of(physics, sensitivities, leader)
    points = EmbeddedPoints(SPACE, SPACE.nodes[[TOP]])
    seconds, slopes = (SECONDS if inertia is None else SECONDS[:10]), []
    for t in seconds:
        walk.to(round(1e9 * t), range(len(directions)))
        slopes.append(sensitivities.derivatives(points, range(len(directions)))[0][0, 2])
    for k, (name, of) in enumerate(changed.items()):
        expected = (top(of(width), seconds) - top(of(-width), seconds)) / (2.0 * width)
        size = np.abs(expected).max()
        np.testing.assert_allclose(np.array(slopes)[:, k], expected, atol=2e-3 * size, err_msg=name)
