"""Which candidates the data cannot tell apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import toy
from toy_loop import closed

from livedeform.closed_loop.assessment.ranking import Ranking
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.inference.forward_selection import TOGETHER
from livedeform.common.types import EffectValues

LEAST, GAP = toy.SETTINGS.selection.min_score, toy.SETTINGS.screening.min_gap


def idle(result: Diagnosis) -> set[str]:
    """Name the candidates that explain no more than the declared model, and are told from the best one."""
    return {r.name for r in result.ranking if r.score > -LEAST and r.score_gap >= GAP}


def test_where_nothing_is_missing_no_candidate_is_listed_as_a_confusion() -> None:
    result = closed([])
    assert result.verdict == "none" and len(result.ranking) > 10
    assert not any(r.indistinguishable_from for r in result.ranking)


@pytest.mark.parametrize(
    "effect", [toy.effect("stiffness", ratio=1.15), toy.effect("viscoelasticity", g=[0.15], tau=[2.0])]
)
def test_what_gains_nothing_is_no_rival(effect: object) -> None:
    result = closed([effect])
    nothing = idle(result)
    assert nothing and not nothing & {a.candidate.name for a in result.added}
    for r in result.ranking:
        assert not nothing & set(r.indistinguishable_from)
        assert r.name not in nothing or not r.indistinguishable_from


@pytest.mark.parametrize(
    "first", [toy.effect("gravity_tilt", angle_x=0.08, angle_y=0.03), toy.effect("viscoelasticity", g=[0.3], tau=[2.0])]
)
@pytest.mark.parametrize(
    "second",
    [toy.effect("stiffness", ratio=1.1), pytest.param(toy.effect("density", ratio=1.0 / 1.1), marks=pytest.mark.slow)],
)
def test_each_effect_has_its_own_rivals(first: EffectValues, second: EffectValues) -> None:
    """Without a force a body that is stiffer and one that is lighter move alike, whatever else is the matter: that was
    said where one of them was the first effect, and not where it was the second."""
    result = closed([first, second])
    assert result.verdict == "effect" and result.effects[0].name == first.name
    assert len(result.effects) == 2 and result.effects[1].name in ("stiffness", "density")
    other = "density" if result.effects[1].name == "stiffness" else "stiffness"
    assert other in result.rivals[result.effects[1].name] and result.rivals[first.name] == ()
    of_name = {r.name: r.indistinguishable_from for r in result.ranking}
    assert result.effects[1].name in of_name[other] and first.name not in of_name[other]
    assert result.proposal is not None and set(result.proposal.names) == {"stiffness", "density"}
    words = first.name.replace("_", " ")
    assert result.headline.startswith(f"Traced to {words} and (") and " or " in result.headline


def test_of_what_was_fitted_as_a_set_no_rivals_are_known() -> None:
    """It was not compared with others, and how alike it was to them alone says nothing."""
    result = closed([toy.effect("gravity_tilt", angle_x=0.08, angle_y=0.03), toy.effect("stiffness", ratio=1.1)])
    first, second, *more = result.selection.steps
    assert len(result.rivals[second.added]) == 1
    as_set = replace(result.selection, steps=(first, replace(second, refined={}, reason=TOGETHER), *more))
    of_name = {r.name: r for r in Ranking(toy.SETTINGS, as_set, registered=False).with_later(result.ranking)}
    assert of_name[second.added].indistinguishable_from == ()
    assert not any(second.added in r.indistinguishable_from for r in of_name.values())
