"""A table that is not level: what hangs on the body pulls where gravity does, and stays as heavy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, solve
from scipy.spatial.transform import Rotation

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.items.loads import hung_masses
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.walk import WalkSettings
from livedeform.fem_node.physics.record import DeadLoad, Inertia, Support
from livedeform.fem_node.solve.assembly import System

SIDE, PULL = 0.02, 0.05  # m, N: as heavy as 64 % of the body
G = 9.81
DOWN = np.array([0.0, 0.0, -G])
TOP = np.array([[0.0, 0.0, SIDE], [SIDE, 0.01, SIDE]])


def body(force=(0.0, 0.0, -PULL), **changes):
    load = DeadLoad("weight", plane(2, SIDE), np.array(force))
    base = Support(plane(2, 0.0), "fixed")
    return soft(0.45, 4e3, supports=(base,), gravity=DOWN, loads=(load,), density=1000.0, **changes)


def tilted(physics, x, y=0.0):
    return apply_effects(physics, [EffectValues("gravity_tilt", {"angle_x": np.array(x), "angle_y": np.array(y)})])


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.19, 0.21, 0.4, 0.8])
def test_body_and_weight_pull_on_the_table_along_gravity(angle):
    """At every tilt, those beyond which the declared load would not be taken for a weight as well."""
    physics = tilted(body(inertia=Inertia(0.003)), angle, -0.5 * angle)
    turn = Rotation.from_rotvec([angle, -0.5 * angle, 0.0])
    np.testing.assert_allclose(physics.loads[0].force, turn.apply([0.0, 0.0, -PULL]), atol=1e-15)
    mechanics = solve(block_space(), replace(physics, inertia=None), physics.gravity)
    mechanics.prepare(moment(physics.gravity))
    r = mechanics.residual(mechanics.x, System(mechanics.solver.pattern))
    reaction = r[: 3 * mechanics.space.n_nodes].reshape(-1, 3).sum(axis=0)
    total = (1000.0 * SIDE**3 + PULL / G) * physics.gravity
    np.testing.assert_allclose(-reaction, total, atol=1e-9)  # measured 8.3e-17 N
    masses = [float(hung.blocks.sum()) for hung in hung_masses(block_space(), physics)]
    assert masses == pytest.approx([PULL / G], rel=1e-12)


@pytest.mark.parametrize("force", [(PULL, 0.0, 0.0), (0.0, 0.0, PULL), (0.0, PULL, -PULL)])
def test_a_load_that_is_no_weight_stays_as_declared(force):
    physics = tilted(body(force), 0.3)
    np.testing.assert_array_equal(physics.loads[0].force, force)
    assert not hung_masses(block_space(), physics)


def test_sensitivities_know_that_the_weight_turns():
    h = 1e-3
    model = PhantomModel(block_space(), body(), markers=TOP, settings=EXACT)
    columns = [Direction("x", tilted(body(), 1e-6), 1e-6), Direction("y", tilted(body(), 0.0, 1e-6), 1e-6)]
    for corrections in (1, 3):
        rough = WalkSettings(path_step=None, corrections=corrections)
        found = model.simulate(None, [0], columns, start_ns=0, walk_settings=rough).d_markers[0]
        for k, axis in enumerate(((h, 0.0), (0.0, h))):
            ends = [PhantomModel(block_space(), tilted(body(), *(s * a for a in axis)), markers=TOP, settings=EXACT)
                    .rest().markers for s in (1.0, -1.0)]  # fmt: skip
            difference = (ends[0] - ends[1]) / (2.0 * h)
            assert np.abs(found[..., k] - difference).max() < 1e-5 * np.abs(difference).max()  # measured 3.7e-7
