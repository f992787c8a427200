"""What one press alone shows is no effect, and no reason to say that nothing is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.assessment.next_experiment import once_more
from livedeform.closed_loop.diagnosis import Diagnosis, one_press_reasons
from livedeform.closed_loop.inference.forward_selection import ForwardSelection, Refined
from livedeform.closed_loop.loop import investigate


def diagnosed(monkeypatch: pytest.MonkeyPatch, block_scores: Sequence[float]) -> Diagnosis:
    """Diagnose a toy body that is softer where it is fitted, and not where it is held out, as if the blocks of time
    spoke for it so."""
    body, refine = toy.ToyBody(PLACES), ForwardSelection.refine
    softer = toy.effect("stiffness", ratio=0.9)
    fit, test = (toy.record(e, seed=s, body=body, n=36, name=n) for e, s, n in (([softer], 0, "a"), ([], 1000, "b")))

    def refined(method: ForwardSelection, *how: object) -> tuple[dict[str, Refined], frozenset[str]]:
        found, small = refine(method, *how)
        return {n: replace(r, block_scores=np.array(block_scores)) for n, r in found.items()}, small

    monkeypatch.setattr(ForwardSelection, "refine", refined)
    names = ["stiffness", "gravity_tilt", "skin"]
    return investigate(toy.ToyModel(body), toy_inputs(fit, test, names), seed=0)


def test_what_one_press_alone_speaks_for_is_named_and_leaves_it_undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was `none`, as "no candidate predicts unseen blocks better", where a probe's friction did by 228."""
    result = diagnosed(monkeypatch, [16.0, 32.0, -245.0, -31.0, 20.0])
    assert result.verdict == "undecided" and not result.effects
    last = result.selection.steps[-1]
    assert "stiffness" in last.by_one_press and last.reason.startswith("one press alone speaks for ")
    (reason,) = one_press_reasons(result.selection.steps)
    assert "stiffness" in reason and reason in result.text
    proposal, (fitted,) = result.proposal, result.selection.observations
    assert proposal is not None and proposal.best is not None and proposal.names[0] in last.by_one_press
    # the motion as it was made, and when in it the third block is, which speaks for it
    assert [p.stamp_ns for p in proposal.best.poses] == [p.stamp_ns - fitted.path[0].stamp_ns for p in fitted.path]
    t = fitted.seconds[fitted.blocks == 2]
    assert (
        proposal.advice.startswith("record a once more") and f"between {t[0]:.1f} and {t[-1]:.1f} s" in proposal.advice
    )


def test_what_several_presses_speak_for_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    result = diagnosed(monkeypatch, [-80.0, -90.0, -70.0, -60.0])
    assert result.selection.steps[0].added == "stiffness" and not one_press_reasons(result.selection.steps)
    assert result.proposal is None or result.proposal.names[0] == "stiffness"


def test_the_press_that_is_asked_for_is_the_one_that_speaks_for_it() -> None:
    """Where there are more presses than key moments, some have none; they were counted all the same."""
    o = toy.record([], seed=0, body=toy.ToyBody(PLACES), n=36, name="a")
    numbers = np.array([0, 3, 5, 8])
    o = replace(o, blocks=numbers[o.blocks])
    for place, block in enumerate(numbers):
        scores = np.where(np.arange(4) == place, -50.0, 1.0)
        refined = {"skin": SimpleNamespace(score=-40.0, block_scores=scores)}
        step = SimpleNamespace(by_one_press=("skin",), refined=refined)
        proposal = once_more(SimpleNamespace(steps=[step], observations=[o], last=None))  # type: ignore[arg-type]
        t = o.seconds[o.blocks == block]
        assert proposal is not None and f"between {t[0]:.1f} and {t[-1]:.1f} s" in proposal.advice
