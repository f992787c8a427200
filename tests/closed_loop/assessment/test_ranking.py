"""Which candidates the data cannot tell apart."""

from __future__ import annotations

import pytest
import toy
from toy_loop import closed

from livedeform.closed_loop.diagnosis import Diagnosis

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
