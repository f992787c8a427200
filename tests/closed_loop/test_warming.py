"""A new effect by its card alone: it is a candidate where a temperature is declared, and is named where it is true."""

from __future__ import annotations

from dataclasses import replace

import phantom
import pytest
import toy
from toy_loop import closed

from livedeform.closed_loop.candidates import catalogue
from livedeform.closed_loop.forward import Column
from livedeform.closed_loop.model.fem_model import Body

NAMES = (*toy.NAMES, "stereo_scale", "thermal_expansion")


def test_it_is_a_candidate_where_a_temperature_is_declared_only():
    around = toy.surroundings(toy.markers())
    steady = replace(toy.TEMPERATURE, values=(20.0, 20.0, 20.0))
    for temperature, known in ((toy.TEMPERATURE, True), (steady, False), (None, False)):
        physics = replace(around.physics, temperature=temperature)
        assert ("thermal_expansion" in catalogue(replace(around, physics=physics))) == known


def test_it_is_named_and_its_value_is_right():
    result = closed([toy.effect("thermal_expansion", alpha=2e-4)], names=NAMES)
    assert result.verdict == "effect"
    assert [e.name for e in result.effects] == ["thermal_expansion"]
    fitted, sigma = result.effects[0].values["alpha"], result.effects[0].sigmas["alpha"]
    assert abs(fitted - 2e-4) < 4.0 * sigma and sigma < 2e-5
    assert result.ranking[0].indistinguishable_from == ()


def test_nothing_is_said_of_it_where_there_is_nothing():
    assert closed([], names=NAMES).verdict == "none"


def test_the_body_answers_at_every_moment_of_its_own():
    """Moments of one pose differ by the temperature, and the tangent is that of whole runs."""
    body = Body(phantom.setting(2, temperature=toy.TEMPERATURE))
    o = phantom.moments([0.2, 0.5, 0.8, 1.0])
    candidate = toy.candidates(toy.markers(), ["thermal_expansion"])["thermal_expansion"]
    at = candidate.values([2e-4])
    run = body.simulate([at], o, [Column(candidate, (2e-4,), 0)])
    assert abs(run.points[3] - run.points[0]).max() > 5e-6  # m: 1.2 K warmer
    ends = [body.simulate([candidate.values([2e-4 + d])], o, ()).points for d in (1e-6, -1e-6)]
    column = run.d_points[..., 0]
    assert column == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=0.02, abs=0.02 * abs(column).max())
