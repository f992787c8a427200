"""A diagnosis tells where it was not let go on: at the most effects, at the end of a range, and
where what it lacks goes with the speed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.candidates import narrowed
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import EffectValues

BODY = toy.ToyBody(PLACES)
RELAXES = toy.effect("plastic_set", fraction=0.4)
LATE = toy.effect("time_offset", seconds=0.06)


def found_in(
    effects: list[EffectValues],
    names: tuple[str, ...] = toy.NAMES,
    most: int | None = None,
    seed: int = 1,
) -> Diagnosis:
    fit, test = (
        toy.record(effects, seed=s, body=BODY, n=n, name=name)
        for s, n, name in ((seed, 36, "fit"), (seed + 1000, 24, "test"))
    )
    return investigate(toy.ToyModel(BODY), toy_inputs(fit, test, names), seed=seed, max_effects=most)


@pytest.mark.parametrize(("most", "cut"), [(0, True), (1, True), (2, False)])
def test_a_search_that_is_cut_off_says_what_it_would_have_gone_on_with(most: int, cut: bool) -> None:
    """With one of two effects it explained 100 %, without a doubt, and both values were wrong."""
    found = found_in([RELAXES, LATE], most=most)
    assert len(found.effects) == most
    assert any("(--max-effects)" in doubt for doubt in found.doubts) is cut
    assert bool(found.selection.cut_off) is cut


@pytest.mark.parametrize(("effect", "at_the_end"), [(("poisson_ratio", 0.1), True), (("poisson_ratio", 0.4), False)])
def test_a_value_at_the_end_of_what_is_tried_is_doubted(effect: tuple[str, float], at_the_end: bool) -> None:
    """The report's table said so; text and diagnosis.json gave 0.2 (0.2 to 0.39) of a Poisson's ratio of 0.1."""
    name, value = effect
    found = found_in([toy.effect(name, value=value)], (name, "stiffness", "skin"))
    assert [e.name for e in found.effects] == [name]
    assert any("at the end of what is tried" in doubt for doubt in found.doubts) is at_the_end


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_what_goes_with_the_speed_is_seen(seed: int) -> None:
    """A clock 0.06 s late, of which no candidate knows, was `none`: within the noise, at 20 sigma of its chi2."""
    others = tuple(name for name in toy.NAMES if name != "time_offset")
    found = found_in([LATE], others, seed=seed)
    assert found.verdict != "none" and found.discrepancy.p_value < 1e-3
    assert found_in([], others, seed=seed).verdict == "none"


@pytest.mark.parametrize(("sigma", "told"), [(0.002, True), (0.05, False)])
def test_a_stated_sigma_that_the_data_reject_is_named_and_holds_nothing_back(sigma: float, told: bool) -> None:
    """A Poisson's ratio of 0.35, stated as 0.49 +- 0.002, was 0.42 (0.36 to 0.48) without a word."""
    effect = [toy.effect("poisson_ratio", value=0.4)]
    fit, test = (
        toy.record(effect, seed=s, body=BODY, n=n, name=name, sigma=2e-4)
        for s, n, name in ((1, 36, "fit"), (1001, 24, "test"))
    )
    inputs = toy_inputs(fit, test, ("stiffness", "poisson_ratio", "skin"))
    known = inputs.candidates["poisson_ratio"]
    stated = narrowed(known, {"value": sigma}, inputs.settings.allowance.stated)
    model = toy.ToyModel(BODY)
    found = investigate(model, replace(inputs, candidates={**inputs.candidates, known.name: stated}))
    assert [e.name for e in found.effects] == ["poisson_ratio"]
    assert any("of the sigmas off that the experiment states" in doubt for doubt in found.doubts) is told
    (without,) = investigate(model, inputs).effects
    if told:
        assert found.effects[0].values["value"] == pytest.approx(float(without.values["value"]), abs=1e-4)
        assert found.effects[0].sigmas["value"] == pytest.approx(float(without.sigmas["value"]), rel=1e-2)


def test_what_is_usual_holds_nothing_back_that_is_beyond_it() -> None:
    """A clock 0.2 s late is four times as late as usual, known to 0.014 s: it was 0.193."""
    late = [toy.effect("time_offset", seconds=0.2)]
    fit, test = (
        toy.record(late, seed=s, body=BODY, n=n, name=name, sigma=6e-4)
        for s, n, name in ((1, 36, "fit"), (1001, 24, "test"))
    )
    inputs = toy_inputs(fit, test, ("time_offset",))
    candidate = inputs.candidates["time_offset"]
    (clock,) = candidate.coordinates
    assert clock.sigma == 0.05
    anything = replace(candidate, coordinates=(replace(clock, sigma=1.0),))
    found, free = (
        investigate(toy.ToyModel(BODY), replace(inputs, candidates={"time_offset": c})).effects[0]
        for c in (candidate, anything)
    )
    sigma = float(free.sigmas["seconds"])
    assert float(found.sigmas["seconds"]) == pytest.approx(sigma, rel=0.05)
    # measured 0.031 of a sigma
    assert abs(float(found.values["seconds"]) - float(free.values["seconds"])) < 0.1 * sigma
