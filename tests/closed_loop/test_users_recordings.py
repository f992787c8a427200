"""What users record: bodies far softer than declared, a force in some recordings alone, a test without a press."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.assessment.held_out import errors_of, noise_floor
from livedeform.closed_loop.diagnosis import Diagnosis, odd_marker_doubts
from livedeform.closed_loop.evidence.observation import Observation, observe, poses_at
from livedeform.closed_loop.evidence.track import track
from livedeform.closed_loop.forward import Column, Run
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import Array, EffectValues, MarkerFrame, Pose

BODY = toy.ToyBody(PLACES)
FORCE_SIGMA = 0.01  # N
NAMES = ("stiffness", "density", "skin", "time_offset", "viscoelasticity")


class WithForce(toy.ToyModel):
    """A toy model whose probe feels 400 N/m times the ratio of the stiffness."""

    def force(self, effects: Sequence[EffectValues], o: Observation) -> Array:
        ratio = next((float(e.values["ratio"]) for e in effects if e.name == "stiffness"), 1.0)
        position, _ = poses_at(o.path, o.stamps_ns)
        depth = np.maximum(toy.HEIGHT - position[:, 2], 0.0)
        return np.column_stack([0.0 * depth, 0.0 * depth, -400.0 * ratio * depth])

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        runs = super().run(effects, observations, columns)
        out = []
        for run, o in zip(runs, observations, strict=True):
            forces, by = self.force(effects, o), self._by(effects, o, columns)
            out.append(run if o.forces is None else replace(run, forces=forces, d_forces=by))
        return out

    def _by(self, effects: Sequence[EffectValues], o: Observation, columns: Sequence[Column]) -> Array:
        out = np.zeros((o.n_moments, 3, len(columns)))
        for i, c in enumerate(columns):
            others = [e for e in effects if e.name != c.candidate.name]
            low, high = (np.array(c.z) for _ in range(2))
            high[c.coordinate] += (h := c.candidate.coordinates[c.coordinate].step)
            there, here = (self.force([*others, c.candidate.values(z)], o) for z in (high, low))
            out[..., i] = (there - here) / h
        return out


def measured(
    effects: list[EffectValues], seed: int, n: int = 36, name: str = "fit", forces: bool = False
) -> Observation:
    o = toy.record(effects, seed=seed, body=BODY, n=n, name=name)
    if not forces:
        return o
    noise = FORCE_SIGMA * np.random.default_rng(seed).standard_normal((o.n_moments, 3))
    return replace(o, forces=WithForce(BODY).force(effects, o) + noise, force_sigma=FORCE_SIGMA)


def values_of(found: Diagnosis) -> dict[str, float]:
    return {e.name: float(value) for e in found.effects for value in e.values.values()}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 10))])
def test_what_is_added_was_fitted_to_its_end(seed: int) -> None:
    """A fit that was left behind after two runs of the model was scored as if it had made its next step, and added
    where it was: of a body of 0.3 times the stiffness a third was explained, and the rest by no known effect."""
    effects = [toy.effect("stiffness", ratio=0.3)]
    inputs = toy_inputs(measured(effects, seed), measured(effects, seed + 1000, 24, "test"), toy.NAMES)
    found = investigate(toy.ToyModel(BODY), inputs)
    assert found.verdict == "effect" and found.selection.model.joint.converged
    (name,) = values_of(found)
    assert {name, *found.rivals[name]} >= {"stiffness", "density"}  # one is as good as the other on this body
    true = {"stiffness": 0.3, "density": 1.0 / 0.3}[name]
    assert values_of(found)[name] == pytest.approx(true, rel=0.01)  # measured 0.0014
    assert found.after.rmse < 1.05 * found.floor


@pytest.mark.parametrize(
    "missing",
    [
        "in one of two fits",
        pytest.param("nowhere", marks=pytest.mark.slow),
        pytest.param("in the test", marks=pytest.mark.slow),
    ],
)
def test_a_recording_without_a_force_leaves_the_others_theirs(missing: str) -> None:
    """A softer body sags as a heavier one does, and the force tells; it was left out of all recordings."""
    effects = [toy.effect("stiffness", ratio=0.8)]
    fits = [measured(effects, s, name=n, forces=True) for s, n in ((3, "one"), (53, "two"))]
    test = measured(effects, 1003, 24, "test", forces=missing != "in the test")
    if missing == "in one of two fits":
        fits[1] = replace(fits[1], forces=None, force_sigma=float("nan"))
    inputs = replace(toy_inputs(fits[0], test, NAMES), fitted=tuple(fits))
    found = investigate(WithForce(BODY), inputs)
    assert (found.verdict, list(values_of(found)), found.rivals["stiffness"]) == ("effect", ["stiffness"], ())
    assert values_of(found)["stiffness"] == pytest.approx(0.8, rel=0.02)  # measured 0.0016


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_forces_that_are_not_those_of_the_model_are_a_doubt(sign: float) -> None:
    """Of the force on the probe for that on the phantom it was said that what is left is within the noise (p = 1, chi2
    per datum 3.5): no black box looks at forces."""
    fit, test = (measured([], s, n, name, forces=True) for s, n, name in ((3, 36, "fit"), (1003, 24, "test")))
    turned = [replace(o, forces=None if o.forces is None else sign * o.forces) for o in (fit, test)]
    found = investigate(WithForce(BODY), toy_inputs(*turned, NAMES))
    said = [doubt for doubt in found.doubts if doubt.startswith("the measured forces are not those of the model")]
    assert len(said) == (sign < 0.0)
    assert 0.7 < found.discrepancy.chi2 < 1.3  # of the markers alone: measured 0.95


@pytest.mark.parametrize("ratio", [1.0, 1.2])
@pytest.mark.parametrize("seed", [0, 2])
def test_points_that_the_tracker_states_to_be_poor_make_nothing_up(seed: int, ratio: float) -> None:
    """With one point in twenty at 30 times the noise, stated so, `unexplained` was said where nothing is missing."""
    effects = [toy.effect("stiffness", ratio=ratio)] if ratio != 1.0 else []
    fit, test = (
        toy.record(effects, seed=s, body=BODY, n=n, name=name, poor=(0.05, 30.0))
        for s, n, name in ((seed, 36, "fit"), (seed + 1000, 24, "test"))
    )
    found = investigate(toy.ToyModel(BODY), toy_inputs(fit, test, toy.NAMES))
    assert found.verdict == ("none" if ratio == 1.0 else "effect") and not found.doubts
    for name, value in values_of(found).items():
        assert {name, *found.rivals[name]} >= {"stiffness", "density"}
        true = {"stiffness": ratio, "density": 1.0 / ratio}[name]
        assert value == pytest.approx(true, rel=0.03)  # measured 0.015


@pytest.mark.parametrize(
    ("seed", "seconds"), [(0, 2.0), *(pytest.param(*c, marks=pytest.mark.slow) for c in ((1, 4.0), (0, 10.0)))]
)
def test_an_error_that_changes_slowly_is_not_said_to_be_physics(seed: int, seconds: float) -> None:
    """It was `unexplained`, with p = 0: within the presses it lasts for, no recording tells it from motion."""
    fit, test = (
        toy.record([], seed=s, body=BODY, n=n, name=name, slow=seconds)
        for s, n, name in ((seed, 36, "fit"), (seed + 1000, 24, "test"))
    )
    found = investigate(toy.ToyModel(BODY), toy_inputs(fit, test, toy.NAMES))
    assert not test.noise.measured and found.discrepancy.p_value < 1e-3
    assert found.verdict == "undecided" and not found.effects
    assert "if the rest changes slowly, it looks like what is left" in found.text


def idle(name: str) -> Observation:
    """A recording in which the probe stays 5 cm above the body."""
    stamps, ids = (np.arange(0.05, 29.9, 0.04) * 1e9).astype(np.int64), np.arange(len(PLACES)).astype(np.uint32)
    poses = [Pose(p.stamp_ns, np.array([0.0, 0.0, toy.HEIGHT + 0.05]), p.orientation_xyzw) for p in toy.path()]
    position, _ = poses_at(poses, stamps)
    points = BODY.points([], 1e-9 * stamps, position) + 1e-4 * np.random.default_rng(9).standard_normal(
        (len(stamps), len(ids), 3)
    )
    covariances, nothing = np.broadcast_to(1e-8 * np.eye(3), (len(ids), 3, 3)).copy(), np.full(len(ids), np.nan)
    frames = [MarkerFrame(int(s), ids, p, covariances, nothing) for s, p in zip(stamps, points, strict=True)]
    return observe(name, track(frames, ids), poses, n_moments=24, start_ns=0, settings=toy.SETTINGS)


@pytest.mark.parametrize("effect", [toy.effect("time_offset", seconds=0.1), toy.effect("strain_stiffening", b=1.5)])
def test_a_recording_without_a_press_confirms_nothing_that_a_press_shows(effect: EffectValues) -> None:
    """It was said to explain 100 % of what was not fitted."""
    names = ("stiffness", "time_offset", "strain_stiffening")
    found = investigate(toy.ToyModel(BODY), toy_inputs(measured([effect], 3), idle("test"), names))
    assert found.verdict == "undecided" and not found.effects
    assert any("no press is held out" in doubt for doubt in found.doubts)
    assert [a.candidate.name for a in found.selection.added] == [effect.name]  # what was fitted is on record


@pytest.mark.parametrize(
    ("marker", "off"), [(25, 0.6e-3), pytest.param(3, 1.0e-3, marks=pytest.mark.slow), (None, 0.0)]
)
def test_a_marker_whose_place_is_wrong_is_named(marker: int | None, off: float) -> None:
    """Trusted less at every moment, it vanished: "explains the recordings within their noise", and not a word."""

    def shifted(o: Observation) -> Observation:
        by = np.zeros((len(PLACES), 3))
        if marker is not None:
            by[marker] = [off, 0.0, 0.0]
        return replace(o, points=o.points + by, single=o.single + by)

    effects = [toy.effect("stiffness", ratio=0.8)]
    fit, test = (shifted(measured(effects, s, n, k)) for s, n, k in ((3, 36, "fit"), (1003, 24, "test")))
    found = investigate(toy.ToyModel(BODY), toy_inputs(fit, test, ("stiffness", "density", "skin")))
    said = [doubt for doubt in found.doubts if "off all the time" in doubt]
    if marker is None:
        assert found.verdict == "effect" and not said
    else:
        named = re.findall(r"(\d+) by ([\d.]+) mm", said[0])
        assert [int(name) for name, _ in named[:1]] == [marker]
        assert float(named[0][1]) == pytest.approx(1e3 * off, abs=0.05)  # mm, measured 0.02


@pytest.mark.parametrize("frames", [1, 2, 4])
@pytest.mark.parametrize("seed", range(4))
def test_a_marker_that_is_hardly_seen_is_not_off_all_the_time(frames: int, seed: int) -> None:
    """The mean of one frame is as far off as that frame's noise."""
    effects = [toy.effect("stiffness", ratio=0.8)]
    fit, test = measured(effects, seed), measured(effects, seed + 1000, 24, "test")
    hidden = np.zeros((24, len(PLACES)), bool)
    hidden[frames:, [5, 17, 30]] = True
    points, single = (np.where(hidden[..., None], np.nan, x) for x in (test.points, test.single))
    inputs = toy_inputs(fit, replace(test, points=points, single=single), ("stiffness", "density"))
    errors = errors_of(inputs.held_out, toy.ToyModel(BODY).run(effects, inputs.held_out))
    assert not odd_marker_doubts(errors, inputs, noise_floor(errors, errors))
