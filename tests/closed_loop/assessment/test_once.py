"""What happens in a recording that is fitted, and not in what was held out, is judged there.

Cameras that are registered later do not know that they were moved; a body that is as warm as its scan has not grown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.assessment.called_for import Called
from livedeform.closed_loop.assessment.earning import Earned, Fall
from livedeform.closed_loop.candidates import catalogue
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import Array, EffectValues, Pose

RULE = toy.SETTINGS.verdict
SHIFT = np.array([1.5e-4, -1e-4, 0.0])  # m
RELAXES = toy.effect("viscoelasticity", g=[0.2], tau=[2.0])


class Filmed(Inputs):
    """Inputs of an experiment whose cameras are registered to the markers at rest, each recording's anew."""

    @property
    def registered(self) -> bool:
        return True


@dataclass(frozen=True)
class Bumped(toy.ToyBody):
    """The cameras are bumped at ``onset`` s."""

    onset: float = np.inf

    def points(self, effects: Sequence[EffectValues], seconds: Array, position: Array) -> Array:
        return super().points(effects, seconds, position) + SHIFT * (seconds >= self.onset)[:, None, None]


class FilmedModel(toy.ToyModel):
    """Knows of a motion of the cameras in the recording that is fitted; the other one is registered after it."""

    def predict(self, effects: Sequence[EffectValues], observation: Observation) -> Array:
        points = super().predict([e for e in effects if e.name != "camera_motion"], observation)
        for e in effects:
            if e.name == "camera_motion" and observation.name == "fit":
                points = points + e.values["translation"] * (observation.seconds >= e.values["onset"])[:, None, None]
        return points


def diagnosed(truth: list[EffectValues], onset: float, names: Sequence[str], seed: int = 0) -> Diagnosis:
    fit = toy.record(truth, seed=seed, body=Bumped(PLACES, onset=onset), name="fit", n=36)
    test = toy.record(truth, seed=seed + 1000, name="test", n=24)
    inputs = toy_inputs(fit, test, [n for n in names if n != "camera_motion"])
    around = replace(toy.surroundings(PLACES), has_cameras=True, moments=tuple(fit.seconds))
    known = {**inputs.candidates, **catalogue(around, ["camera_motion"])}
    given = {f.name: getattr(inputs, f.name) for f in fields(inputs)} | {"candidates": known}
    return investigate(FilmedModel(toy.ToyBody(PLACES)), Filmed(**given), seed=seed)


@pytest.mark.parametrize("onset", [7.3, pytest.param(19.1, marks=pytest.mark.slow)])
def test_cameras_that_were_bumped_where_it_was_fitted_are_named(onset):
    found = diagnosed([], onset, toy.NAMES)
    assert found.verdict == "effect" and [e.name for e in found.effects] == ["camera_motion"]
    assert "camera_motion did not happen in what was held out" in found.text
    values = found.effects[0].values
    np.testing.assert_allclose(values["translation"], SHIFT, atol=3e-5)
    assert values["onset"] == pytest.approx(onset, abs=1.0)


def test_beside_it_each_other_effect_is_judged_on_what_was_held_out():
    found = diagnosed([RELAXES], 12.4, ["viscoelasticity", "stiffness", "gravity_tilt"])
    assert found.verdict == "effect"
    assert {e.name for e in found.effects} == {"camera_motion", "viscoelasticity"}


@pytest.mark.slow
def test_nothing_else_passes_for_it():
    """A body that relaxes, of which that is no candidate: much is left where it was fitted."""
    assert diagnosed([RELAXES], np.inf, ["stiffness"]).verdict != "effect"
    assert diagnosed([], np.inf, ["stiffness"]).verdict in ("none", "undecided")


def test_what_else_is_left_is_told_and_where_it_is_much_nothing_is_confirmed():
    found = diagnosed([RELAXES], 12.4, ["stiffness"])  # a tenth of what the bump moves
    assert [e.name for e in found.effects] == ["camera_motion"] and found.explained < 0.97  # measured 0.93
    assert "A smooth residual of" in found.text
    much = diagnosed([toy.effect("viscoelasticity", g=[0.9], tau=[2.0])], 12.4, ["stiffness"])
    assert much.verdict in ("undecided", "unexplained") and not much.effects


class WarmModel(toy.ToyModel):
    """The recording that is held out is at the reference temperature."""

    def predict(self, effects: Sequence[EffectValues], observation: Observation) -> Array:
        cold = observation.name == "test"
        return super().predict([e for e in effects if not cold or e.name != "thermal_expansion"], observation)


def warmed(alpha: float, truth: list[EffectValues], names: Sequence[str]) -> Diagnosis:
    """Diagnose recordings of which only the one that is fitted was made while the body warmed."""
    fit = toy.record([*truth, toy.effect("thermal_expansion", alpha=alpha)], seed=3, name="fit", n=36)
    test = toy.record(truth, seed=1003, name="test", n=24)
    return investigate(WarmModel(toy.ToyBody(PLACES)), toy_inputs(fit, test, names), seed=3)


def test_a_body_that_grows_where_it_was_fitted_and_was_cold_in_what_was_held_out_is_named():
    """It was `undecided`: held-out data took nothing off chi2, as they could not."""
    names = (*toy.NAMES, "thermal_expansion")
    found = warmed(2e-4, [], names)
    assert found.verdict == "effect" and [e.name for e in found.effects] == ["thermal_expansion"]
    assert "thermal_expansion did not happen in what was held out" in found.text
    assert found.effects[0].values["alpha"] == pytest.approx(2e-4, rel=0.1)
    assert warmed(0.0, [], names).verdict in ("none", "undecided")
    other = warmed(0.0, [RELAXES], ("stiffness", "thermal_expansion"))  # it is not there to take what relaxes
    assert other.verdict != "effect"


def test_data_that_are_changed_by_it_are_not_mute():
    def earned(taken: float, moved: float) -> Earned:
        called = Called(1.0, 0.1, moved * RULE.min_excess**2)
        return Earned("camera_motion", taken, called, Fall(0.0, 1.0, 1.0), None, 1, 1)

    assert earned(0.1, 0.0).is_mute(RULE)
    assert not earned(-14.9, 0.0).is_mute(RULE)  # contradicted
    assert not earned(0.1, 1.1).is_mute(RULE)  # it would matter


def one_touch(depth: float = 0.001) -> list[Pose]:
    """One short press (m) of 2 s, in 30 s."""
    stamps = np.arange(0.0, 30.0, 0.01)
    z = np.interp(stamps, [0.0, 2.0, 3.2, 5.2, 5.7], [0.01, 0.005, -depth, -depth, 0.005])
    down = np.array([1.0, 0.0, 0.0, 0.0])
    return [Pose(int(s * 1e9), np.array([0.0, 0.0, toy.HEIGHT + d]), down) for s, d in zip(stamps, z, strict=True)]


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_a_clock_that_what_was_held_out_does_not_show_is_not_confirmed(seed: int) -> None:
    """It lasts, and one touch says nothing of it: with a clock that was not late there it was an effect, without a
    doubt, that explained 100 %, in three of these five."""
    fit = toy.record([toy.effect("time_offset", seconds=0.08)], seed=seed, name="fit", n=36)
    test = toy.record([], seed=seed + 1000, name="test", n=24, poses=one_touch())
    found = investigate(toy.ToyModel(toy.ToyBody(PLACES)), toy_inputs(fit, test), seed=seed)
    assert found.verdict == "undecided" and not found.effects
