"""A time budget: the best answer so far, with what was not tried, and never "none" for want of time."""

from __future__ import annotations

import pytest
import toy
from toy_loop import closed

from livedeform.closed_loop.progress import TimeBudget
from livedeform.closed_loop.write import effect_json

TILT = [toy.effect("gravity_tilt", angle_x=0.06, angle_y=0.02)]
NAMES = ("gravity_tilt", "stiffness")


class Counted(TimeBudget):
    """A budget that is used up after so many questions, however fast the machine is."""

    def __init__(self, questions: int) -> None:
        super().__init__(60.0)
        self._questions = questions

    def allows(self, what: str, share: float = 1.0) -> bool:
        self._questions -= 1
        if self._questions < 0:
            self.left_out.append(what)
        return self._questions >= 0


@pytest.mark.parametrize("effects", [[], TILT], ids=["without an effect", "with one"])
def test_nothing_is_concluded_where_nothing_was_tried(effects):
    result = closed(effects, names=NAMES, budget=Counted(0))
    if result.doubts:
        assert result.verdict == "undecided"
        assert "the time budget of 60 s was used up" in result.text
        assert "not done: fitting" in result.doubts[-1]
    else:  # the screening alone had found nothing worth a fit
        assert not effects and result.verdict == "none"
    assert not result.effects


def test_what_was_found_in_time_is_given_with_what_was_left_out():
    whole = closed(TILT, names=NAMES)
    tried = next(step for step in whole.selection.steps if step.refined)
    cut = closed(TILT, names=NAMES, budget=Counted(2 * len(tried.refined)))
    assert cut.verdict == "effect"
    assert [e.name for e in cut.effects] == [e.name for e in whole.effects] == ["gravity_tilt"]
    assert cut.effects[0].values["angle_x"] == pytest.approx(0.06, abs=0.005)
    assert "not done" in cut.doubts[-1]
    assert "with doubts" in cut.headline


def test_a_part_of_the_time_may_be_kept_for_what_comes_last():
    budget = TimeBudget(1e-6)
    assert budget.allows("the last thing", share=1e9) and not budget.left_out
    assert not budget.allows("one more", share=0.5) and budget.left_out == ["one more"]
    assert budget.notes == ["the time budget of 1e-06 s is kept in part for what comes last; not done: one more"]
    assert not budget.allows("the end") and "was used up; not done: one more, the end" in budget.notes[0]


@pytest.mark.slow
def test_a_budget_that_suffices_changes_nothing():
    whole, within = closed(TILT, names=NAMES), closed(TILT, names=NAMES, budget=TimeBudget(1e6))
    assert [effect_json(e) for e in within.effects] == [effect_json(e) for e in whole.effects]
    assert within.verdict == whole.verdict
    assert within.doubts == whole.doubts
