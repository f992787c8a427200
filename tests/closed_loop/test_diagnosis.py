"""What the diagnosis says, and how sure it is."""

import re
from dataclasses import replace

import numpy as np
import phantom
import pytest
import toy
from toy_loop import toy_inputs

from livedeform.closed_loop.assessment.discrepancy import Discrepancy
from livedeform.closed_loop.assessment.held_out import HeldOutErrors, RecordingErrors
from livedeform.closed_loop.assessment.verdict import Conclusion
from livedeform.closed_loop.candidates import catalogue
from livedeform.closed_loop.diagnosis import (
    elements_error,
    left_doubts,
    registration_reasons,
    rubbing_doubts,
    steady_notes,
    unsolved_notes,
)
from livedeform.closed_loop.forward import Correction, Run
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel
from livedeform.closed_loop.model.workers import FemModel
from livedeform.fem_node.effects.probe_adhesion import WRONG


def run(lost: int) -> Run:
    points = np.zeros((5, 3, 3))
    points[:lost] = np.nan
    return Run(points, None, np.zeros((5, 3, 3, 0)), None)


def test_moments_that_could_not_be_solved_are_counted():
    said = unsolved_notes("fitted", [run(0), run(2)])
    assert said == ["2 of 10 fitted moments are left out: no equilibrium was found there"]


def test_the_reason_is_said():
    said = unsolved_notes("held-out", [replace(run(1), reasons=("solver: more than one equilibrium",))])
    assert said[0].endswith("(solver: more than one equilibrium)")


def test_nothing_is_said_where_all_are_solved():
    assert unsolved_notes("fitted", [run(0)]) == unsolved_notes("held-out", []) == []


def test_elements_place_a_probe_less_well_sideways():
    """At an offset of 0.22 mm along x and 0.82 mm deep, elements of 14 mm: noise-free fits were 0.2 mm off sideways."""
    candidate = toy.candidates(toy.markers(), ["probe_offset"])["probe_offset"]
    error = elements_error(Added(candidate, np.array([2.2e-4, 0.0, 8.2e-4])), toy.SETTINGS.fit, 0.014)
    np.testing.assert_allclose(error, [1.82e-4, 1.82e-4, 3.3e-5], rtol=0.01)


@pytest.mark.parametrize(("name", "share"), [("probe_adhesion", WRONG), ("probe_friction", 0.04)])
def test_an_effect_that_elements_get_more_wrong_says_by_how_much(name, share):
    candidate = toy.candidates(toy.markers(), [name])[name]
    error = elements_error(Added(candidate, np.array([2.5])), toy.SETTINGS.fit, 0.014)
    np.testing.assert_allclose(error, 2.5 * share)


@pytest.mark.parametrize("name", ["probe_friction", "probe_adhesion", "stiffness"])
def test_what_elements_get_wrong_of_a_probe_that_begins_to_rub_is_doubted(name):
    """A friction of 0.073 came out at 0.062 +- 0.004, one of 0.0165 at 0.007 +- 0.003: elements of 14 mm."""
    places = toy.markers()
    candidate = catalogue(toy.surroundings(places), [name])[name]
    model = FittedModel(toy.uncertain(places), (Added(candidate, np.full(len(candidate.coordinates), 0.1)),))
    inputs = toy_inputs(*(toy.record([], seed=s, name=n) for s, n in ((1, "fit"), (2, "test"))))
    said = rubbing_doubts(model, inputs)
    assert len(said) == (name != "stiffness") and all(name in text for text in said)
    told = Correction(z={(name, 0): 0.1})  # by the refined mesh, along the whole path
    assert not rubbing_doubts(replace(model, uncertain=replace(model.uncertain, correction=told)), inputs)
    body = phantom.setting(2, ("fit", "test"))
    for mu, doubts in ((0.0, len(said)), (0.3, 0)):  # of one that rubs as it is declared a refined mesh tells it
        physics = body.physics.with_probe(friction=mu)
        with FemModel(replace(body, physics=physics), 1) as forward:
            assert len(rubbing_doubts(model, replace(inputs, forward=forward))) == doubts


@pytest.mark.parametrize("seed", range(5))
def test_no_part_of_what_is_left_is_larger_than_the_whole(seed: int):
    """Of 41.9 mm that markers with wrong ids left, 49.9 mm were said to be one rigid motion, by which they turn."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.03, 0.03, (12, 3))
    measured = np.repeat(places[None, rng.permutation(12)], 6, axis=0) + 1e-4 * rng.standard_normal((6, 12, 3))
    measured[rng.random((6, 12)) < 0.4] = np.nan
    blocks, weights = np.zeros(6, int), rng.uniform(0.1, 1.0, 6)
    errors = RecordingErrors(
        "a", 0, np.arange(6), np.arange(12), measured, np.repeat(places[None], 6, axis=0),
        np.tile(1e-8 * np.eye(3), (6, 12, 1, 1)), weights, blocks, blocks,
    )  # fmt: skip
    inputs = replace(toy_inputs(toy.record([], seed=1), toy.record([], seed=2, name="test")), places=places)
    said = registration_reasons(HeldOutErrors((errors,)), inputs)
    said += steady_notes(HeldOutErrors((errors,)), np.full(12, 1e-4), inputs.settings.verdict)
    parts = [re.search(r"([0-9.]+) mm of the ([0-9.]+) mm", text) for text in said]
    assert parts and all(part is not None and float(part[1]) <= float(part[2]) for part in parts)


def test_what_is_left_beside_the_effects_that_are_given_is_a_doubt():
    """A tether was traced to an inclusion and a tilt without a doubt, 0.047 mm rms beside them (chi2 1.25)."""
    left = Discrepancy(3.7e-7, 40.0, 4.7e-5, 1.25, np.zeros((1, 1, 3)), np.ones((1, 1), bool))
    settings = toy.SETTINGS.verdict
    (said,) = left_doubts(Conclusion("effect", "", loud=True, explained=0.91), left, settings)
    assert "0.047 mm" in said and "1.25" in said
    assert not left_doubts(Conclusion("effect", "", loud=False, explained=1.0), left, settings)
    assert not left_doubts(Conclusion("unexplained", "", loud=True, explained=0.5), left, settings)  # is said already


def test_little_that_is_left_is_a_doubt_where_little_is_explained():
    """A cavity that breathes was traced to cameras that moved once, which explained 48 % of the evidence, without a
    doubt: 0.042 mm rms were left (p = 1e-22), a tenth of a frame's noise."""
    left = Discrepancy(1.4e-22, 90.0, 4.2e-5, 1.25, np.zeros((1, 1, 3)), np.ones((1, 1), bool))
    conclusion, settings = Conclusion("effect", "", loud=False, explained=0.48), toy.SETTINGS.verdict
    (said,) = left_doubts(conclusion, left, settings)
    assert "0.042 mm" in said and "48 % are explained" in said
    assert not left_doubts(conclusion, replace(left, p_value=0.2), settings)  # chance
    assert not left_doubts(replace(conclusion, explained=float("nan")), left, settings)  # nothing there to explain
