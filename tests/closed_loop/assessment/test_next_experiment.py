"""The experiment that would tell two explanations apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import toy
from toy_loop import closed, toy_inputs

from livedeform.closed_loop.assessment import next_experiment
from livedeform.closed_loop.assessment.next_experiment import (
    NextExperiment,
    Proposal,
    apart_in,
    feasible,
    grows,
    planned,
)
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Run
from livedeform.closed_loop.inference.fitted_model import Added, columns_of
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import EffectValues

NAMES = ("density", "stiffness", "probe_offset")


@dataclass
class Planning(toy.ToyModel):
    """A model that notes how many motions are planned at once, and finds no equilibrium in those that are ``lost``."""

    lost: Sequence[str] = ()
    asked: list[int] = field(default_factory=list)

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        if all(np.isfinite(o.patience) for o in observations):
            self.asked.append(len(observations))
        runs = super().run(effects, observations, columns)
        return [
            replace(r, points=np.where(np.arange(o.n_moments)[:, None, None] > 5, np.nan, r.points))
            if o.name in self.lost
            else r
            for o, r in zip(observations, runs, strict=True)
        ]


def inputs() -> Inputs:
    """Recordings of a body that is heavier than declared."""
    effects = [toy.effect("density", ratio=1.3)]
    fit, test = (toy.record(effects, seed=s, name=n, n=36) for s, n in ((0, "fit"), (1, "test")))
    return toy_inputs(fit, test, NAMES)


def diagnosed(model: Planning) -> Diagnosis:
    return investigate(model, inputs())


def proposed(model: Planning, least: float) -> Proposal:
    """Propose a motion that tells the density from its rival by the root of ``least`` sigmas."""
    selection, reach = diagnosed(Planning(toy.ToyBody(toy.markers()))).selection, inputs().reach
    settings = replace(toy.SETTINGS, screening=replace(toy.SETTINGS.screening, min_gap=least))
    proposal = NextExperiment(settings, model, reach).propose(selection, {"density": ("stiffness",)})
    assert proposal is not None
    return proposal


def test_all_motions_are_planned_at_once() -> None:
    model = Planning(toy.ToyBody(toy.markers()))
    proposal = diagnosed(model).proposal
    assert proposal is not None and model.asked == [6]
    assert set(proposal.separation) == {"two depths", "hold and wait", "off centre", "tilted", "sideways", "two speeds"}


def test_a_motion_that_is_not_solved_to_its_end_is_not_proposed() -> None:
    every = proposed(Planning(toy.ToyBody(toy.markers())), 0.0)
    assert every.best is not None
    proposal = proposed(Planning(toy.ToyBody(toy.markers()), lost=(every.best.name,)), 0.0)
    assert proposal.best is not None and proposal.best.name != every.best.name
    assert set(every.separation) - set(proposal.separation) == {every.best.name}
    assert all(every.separation[n] == d for n, d in proposal.separation.items())


def test_a_motion_that_tells_nothing_is_not_handed_out() -> None:
    """A weight is told from a stiffness by no press: the best of 0.01 sigma was written as the bag to play."""
    proposal = diagnosed(Planning(toy.ToyBody(toy.markers()))).proposal
    assert proposal is not None and proposal.best is None and len(proposal.separation) == 6
    assert max(proposal.separation.values()) < 0.1  # measured 0.010
    assert "no feasible trajectory separates density from stiffness" in proposal.advice


class Pushing(toy.ToyModel):
    """A model of which a stiffness alone makes a force: 2 N on the probe, times its ratio."""

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        ratio = float(next((e.values["ratio"] for e in effects if e.name == "stiffness"), 1.0))
        out = []
        for o, run in zip(observations, super().run(effects, observations, columns), strict=True):
            forces = np.tile([0.0, 0.0, -2.0 * ratio], (o.n_moments, 1))
            by_log = [float(c.candidate.name == "stiffness") for c in columns]
            out.append(replace(run, forces=forces, d_forces=forces[..., None] * np.array(by_log)))
        return out


@pytest.mark.parametrize("linear", [True, False])
def test_a_force_that_is_recorded_tells_what_markers_cannot(linear: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A weight and a stiffness, which no press tells apart by markers: at most 0.1 sigma."""
    if not linear:
        monkeypatch.setattr(next_experiment, "grows", lambda added: False)
    model = Pushing(toy.ToyBody(toy.markers()))
    selection = diagnosed(Planning(toy.ToyBody(toy.markers()))).selection
    with_forces = [replace(o, forces=np.zeros((o.n_moments, 3)), force_sigma=0.02) for o in selection.observations]
    best = {}
    for name, observations in (("markers", selection.observations), ("forces", with_forces)):
        asked = replace(selection, observations=observations)
        proposal = NextExperiment(toy.SETTINGS, model, inputs().reach).propose(asked, {"density": ("stiffness",)})
        assert proposal is not None
        best[name] = max(proposal.separation.values())
    assert best["markers"] < 0.1
    assert best["forces"] > 1.0


def test_a_motion_is_planned_with_the_noise_of_the_middle_recording() -> None:
    recorded = [toy.record([], seed=s, n=12, sigma=sigma) for s, sigma in enumerate((1e-4, 9e-4, 3e-4))]
    (trajectory, *_) = feasible(inputs().reach, recorded[0].path[0], toy.SETTINGS.proposal)
    plan = planned(trajectory, recorded, toy.SETTINGS.proposal)
    assert plan.noise is recorded[2].noise
    assert plan.forces is None
    pushed = replace(recorded[1], forces=np.zeros((12, 3)), force_sigma=0.02)
    plan = planned(trajectory, [recorded[0], pushed, recorded[2]], toy.SETTINGS.proposal)
    assert plan.noise is recorded[2].noise and plan.forces is not None and plan.force_sigma == 0.02


def test_what_was_recorded_is_solved_at_any_price() -> None:
    assert toy.record([], seed=0, n=12).patience == np.inf
    assert closed([toy.effect("stiffness", ratio=1.15)]).proposal is not None


@pytest.mark.parametrize("rival", ["stiffness", "skin"])
def test_two_models_are_as_far_apart_as_a_run_of_each_tells(rival: str) -> None:
    """From one run, halfway between them: off by 0.5 and 1.0 % of the distance; the rival's columns have a cosine of
    1.000 and 0.999 and are 1.2 and 0.7 times as large."""
    known = toy.candidates(toy.markers(), ["density", rival])
    values = {"density": {"ratio": 1.2}, "stiffness": {"ratio": 1.2}, "skin": {"thickness": 3e-3, "ratio": 2.0}}
    first, second = (
        Added(known[n], known[n].coordinates_of({k: np.array(v) for k, v in values[n].items()}))
        for n in ("density", rival)
    )
    model, plan = toy.ToyModel(toy.ToyBody(toy.markers())), toy.record([], seed=0, n=12)
    assert grows(first) and grows(second)
    (apart,) = apart_in(model, [], (first, second), [plan])
    (a,), (b,) = model.run([first.values], [plan]), model.run([second.values], [plan], columns_of([second]))
    assert apart is not None
    d = a.points - b.points
    (exactly,) = apart_in(model, [], (first, second), [plan], rough=True)
    assert exactly is not None and np.array_equal(exactly.points, d)
    near, there = (r.d_points[..., -1].ravel() for r in (apart.rival, b))
    sizes = np.linalg.norm(near), np.linalg.norm(there)
    assert np.linalg.norm(apart.points - d) < 0.03 * np.linalg.norm(d)
    assert near @ there > 0.99 * sizes[0] * sizes[1]
    assert 0.5 < sizes[0] / sizes[1] < 2.0


def test_what_is_switched_on_or_rubs_has_no_half() -> None:
    known = toy.candidates(toy.markers(), ["probe_friction", "base_slip", "stiffness"])
    assert [grows(Added(c, np.asarray(c.kick))) for c in known.values()] == [n == "stiffness" for n in known]
