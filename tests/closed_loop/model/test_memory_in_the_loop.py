"""The loop keeps to what `memory_of` says of a body: moments of one pose differ where it remembers, or drifts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import phantom
import pytest
import toy

from livedeform.closed_loop.model.fem_model import Body
from livedeform.closed_loop.model.workers import FemModel
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import ModulusField, Probe, Prony

STICKS = Probe(make_shape("box", (0.06, 0.015, 0.04), 0.002), formulation="prescribed")


@dataclass(frozen=True)
class Thaw(ModulusField):
    """A field that the loop has never heard of."""

    changes_with_time = True

    def __call__(self, X, t):
        return np.full(len(X), np.exp(-0.2 * t))


def test_a_field_that_nobody_knows_is_followed_in_time():
    """Two moments of one pose, and the model of the live graph at both."""
    setting = phantom.setting(2, modulus_fields=(Thaw(),))
    o, body = phantom.moments([0.2, 1.0]), Body(setting)
    run = body.simulate([], o, [])
    assert np.abs(run.points[1] - run.points[0]).max() > 1e-5  # m, of sag
    space = make_space(setting.mesh, setting.element)
    model = PhantomModel(space, body.physics([]), markers=setting.markers)
    reference = model.simulate(list(o.path), [int(s) for s in o.stamps_ns], start_ns=0)
    for k, prediction in enumerate(reference.predictions):
        assert run.points[k] == pytest.approx(prediction.markers, abs=1e-8)


def test_a_prescribed_surface_goes_with_the_probe():
    """Pressed straight at a place, or dragged there: the pose is the same, and the surface is elsewhere."""
    stops = [(0.0, 0.003, -0.002), (1.0, 0.003, 0.009), (2.0, 0.003, -0.002), (3.0, 0.0, -0.002), (4.0, 0.0, 0.009)]
    stops.append((5.0, 0.003, 0.009))
    stamps = np.arange(0.0, 5.01, 0.02)
    t, x, depth = np.array(stops).T
    down = np.array([1.0, 0.0, 0.0, 0.0])
    poses = [
        Pose(round(1e9 * s), np.array([np.interp(s, t, x), 0.0, toy.HEIGHT - np.interp(s, t, depth)]), down)
        for s in stamps
    ]
    run = Body(phantom.setting(2, probe=STICKS)).simulate([], phantom.moments([1.0, 3.0, 5.0], poses), [])
    top = toy.markers()[:, 2].argmax()
    assert run.points[2, top, 0] - run.points[0, top, 0] > 1e-3  # m: of the 3 mm that it was dragged


def test_workers_take_a_body_that_sticks_in_one_piece():
    o = phantom.moments(list(np.linspace(0.5, 6.0, 32)))
    for probe, pieces in ((STICKS, 1), (Probe(STICKS.shape), 2)):
        model = FemModel(phantom.setting(2, probe=probe), processes=2)
        assert len(list(model._plan([], 0, o, ()))) == pieces


def test_the_second_mesh_is_solved_without_rubbing():
    for probe in (STICKS, Probe(STICKS.shape, friction=0.3, adhesion=100.0)):
        body = Body(phantom.setting(2, probe=probe)).slippery()
        assert not memory_of(body.physics([])).reasons and body.setting.physics.probe.formulation == "lagrange"


@pytest.mark.parametrize(
    "remembers", [{"prony": Prony((0.4,), (10.0,))}, {"probe": STICKS}, {}], ids=["relaxes", "sticks", "neither"]
)
def test_the_held_out_part_of_a_recording_goes_on_from_the_fitted_one(remembers):
    """Without it a relaxing body is as stiff at the next press as one that was never pressed: 18 % of the force."""
    whole = phantom.moments(np.linspace(2.5, 16.0, 10))
    fitted, held_out = whole.take(whole.seconds < 9.0), whole.take(whole.seconds >= 9.0)
    model = FemModel(phantom.setting(2, **remembers), processes=1)
    (run,) = model.run([], [whole])
    (part,) = model.run([], [replace(held_out, before=fitted)])
    later = whole.seconds >= 9.0
    assert part.points == pytest.approx(run.points[later], abs=1e-7)  # m
    assert part.forces == pytest.approx(run.forces[later], abs=1e-4)  # N
    (alone,) = model.run([], [replace(held_out, before=replace(fitted, name="another"))])
    apart = np.abs(alone.points - run.points[later]).max()
    assert apart > 1e-5 if remembers else apart < 1e-7
