"""A moment without an equilibrium is given up in bounded work, and is not tried again from the same state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import plane, soft

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import ConvergenceError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.fem_node.contact.contact import ProbeContact
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.start import Start
from livedeform.fem_node.physics.record import Probe, Support
from livedeform.fem_node.simulator import SETTINGS
from livedeform.fem_node.solve.solver import Solver, SolverSettings


def hopeless() -> Mechanics:
    """A column on its base, far too soft for ten times its weight: it buckles and collapses."""
    space = make_space(block_mesh((0.01, 0.01, 0.08), (2, 2, 8)))
    physics = replace(soft(0.49, 400.0), supports=(Support(plane(2, 0.0), "fixed"),))
    return Mechanics(space, physics)


@pytest.fixture
def factorisations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    counted = [0]
    plain = Solver.factorise

    def counting(self: Solver, x: np.ndarray) -> None:
        counted[0] += 1
        plain(self, x)

    monkeypatch.setattr(Solver, "factorise", counting)
    return counted


def test_a_hopeless_moment_is_given_up_in_bounded_work_and_not_tried_again(factorisations: list[int]) -> None:
    body, weight = hopeless(), Moment(0.0, np.inf, np.array([0.0, 0.0, -98.1]))
    with pytest.raises(ConvergenceError) as first:
        body.solve(weight)
    spent = factorisations[0]
    assert 0 < spent < 2 * SolverSettings().least_patience
    with pytest.raises(ConvergenceError) as second:
        body.solve(Moment(0.0, np.inf, np.array([0.0, 0.0, -98.1])))
    assert factorisations[0] == spent and str(second.value) == str(first.value)
    body.solve(Moment(0.0, np.inf, np.array([0.0, 0.0, -0.01])))  # another moment is tried
    assert factorisations[0] > spent


def test_every_frame_of_a_hopeless_body_costs_nothing_after_the_first(factorisations: list[int]) -> None:
    body = hopeless()
    physics = replace(body.physics, gravity=np.array([0.0, 0.0, -98.1]))
    model = PhantomModel(body.space, physics)
    first = model.predict(None, 0)
    spent = factorisations[0]
    later = [model.predict(None, k * 50_000_000) for k in (1, 2, 3)]
    assert not first.converged and not any(p.converged for p in later)
    assert factorisations[0] <= 2 * spent


@pytest.mark.slow
def test_the_first_touch_of_a_probe_that_rubs_is_solved() -> None:
    """The shipped cuboid under a box of friction 0.5, until it has touched: poses in the air take 10 factorisations,
    the first touch 160 iterations. With the patience of the poses before it was refused."""
    folder = Path(__file__).parents[2] / "bags" / "gelatin_cuboid"
    poses = load_recording(folder / "bags" / "a").poses
    start = poses[0].stamp_ns
    model = PhantomModel.from_experiment(load_experiment(folder / "experiment"))
    for pose in poses:
        if pose.stamp_ns > start + 1_720_000_000:
            break
        prediction = model.predict(pose)
        assert prediction.converged, prediction.message
    assert np.linalg.norm(prediction.force) > 0.0  # it has touched


# -- one of many moments: tried once


def unsettled(monkeypatch: pytest.MonkeyPatch, *, once: bool) -> Mechanics:
    """A block under a ball whose contact never settles, as under edges that are far sharper than the elements."""
    monkeypatch.setattr(ProbeContact, "update", lambda self, x: self.T is not None)
    space = make_space(block_mesh((0.06, 0.06, 0.03), (3, 3, 2)))
    base = Support(plane(2, 0.0), "fixed")
    physics = replace(soft(0.45, 4000.0), supports=(base,), probe=Probe(make_shape("sphere", 0.02)))
    settings = replace(SETTINGS, least_patience=40, patience=1.0, least_usual=1e3, once=once)
    return Mechanics(space, physics, settings=settings)


def pressed(depth: float, time: float = 0.0) -> Moment:
    """The ball's lowest point so deep (m) in the middle of the block's top as it was scanned."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [0.03, 0.03, 0.03 - depth]
    return Moment(time, np.inf, np.zeros(3), pose=pose)


def iterations(body: Mechanics, moment: Moment) -> float:
    """Newton iterations until the ``moment`` is given up from two starts and from where the body is."""
    begun = body.solver.left = 1e9
    with pytest.raises(ConvergenceError, match="given up"):
        body.solve(moment, [Start(body.x), Start(body.x, in_one_step=False)])
    return begun - body.solver.left


def test_a_moment_of_many_has_its_patience_for_all_starts_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three starts take 120 iterations, together 40."""
    three, one = (iterations(unsettled(monkeypatch, once=once), pressed(0.002)) for once in (False, True))
    assert one < 0.5 * three


def test_a_pose_that_was_given_up_is_not_tried_again_and_the_next_one_less(monkeypatch: pytest.MonkeyPatch) -> None:
    body = unsettled(monkeypatch, once=True)
    first = iterations(body, pressed(0.002))
    assert iterations(body, pressed(0.002, time=1.0)) == 0.0
    assert 0.0 < iterations(body, pressed(0.003)) < 0.8 * first  # measured 20 and 40
    monkeypatch.undo()  # it settles from now on: what was given up elsewhere is in nobody's way
    assert np.linalg.norm(body.advance(pressed(0.001)).x) > 0.0
