"""What is solved is found again by the effects with which it was solved, or else with the most of them."""

import numpy as np

from livedeform.fem_node.path.start import MOST_KINDS, SolvedMoment, SolvedMoments

AT = ("a", 5)
STIFFNESS, SLIP, TILT = "stiffness", "base_slip", "gravity_tilt"


def solution(x: float) -> SolvedMoment:
    return SolvedMoment(np.array([x]), None, None, {}, {("stiffness", 0): np.ones(1)})


def solved(*of: tuple[tuple[str, ...], float]) -> SolvedMoments:
    moments = SolvedMoments()
    for effects, x in of:
        moments.of(frozenset(effects))[AT] = solution(x)
    return moments


def test_another_effect_s_solution_is_not_in_the_way():
    moments = solved(((), 1.0), ((SLIP,), 2.0))
    assert moments.of(frozenset())[AT].x == 1.0
    assert moments.of(frozenset([STIFFNESS]))[AT].x == 1.0
    assert moments.of(frozenset([SLIP]))[AT].x == 2.0
    assert AT not in solved(((SLIP,), 2.0)).of(frozenset([STIFFNESS]))


def test_the_solution_with_the_most_of_the_effects_is_read():
    moments = solved(((), 1.0), ((SLIP,), 2.0), ((SLIP, STIFFNESS), 3.0))
    assert moments.of(frozenset([TILT, STIFFNESS, SLIP]))[AT].x == 3.0
    assert moments.of(frozenset([TILT, SLIP]))[AT].x == 2.0


def test_the_kinds_that_were_used_last_are_kept_and_the_declared_model():
    names = [f"{k}" for k in range(MOST_KINDS + 2)]
    moments = SolvedMoments()
    moments.of(frozenset())[AT] = solution(0.0)
    moments.hear({(frozenset([n]), AT): solution(1.0) for n in names})
    moments.of(frozenset([STIFFNESS]))
    kinds = {kind for kind, _ in moments.known}
    assert frozenset() in kinds and frozenset([names[-1]]) in kinds and frozenset([names[0]]) not in kinds


def test_another_process_is_told_what_it_does_not_know_without_slopes():
    moments = solved(((), 1.0), ((SLIP,), 2.0))
    news = moments.news({(frozenset(), AT)})
    assert list(news) == [(frozenset(["base_slip"]), AT)]
    assert not news[frozenset(["base_slip"]), AT].slopes
    other = solved(((SLIP,), 7.0))
    other.hear(news)
    assert other.of(frozenset([SLIP]))[AT].x == 7.0  # its own is nearer to what it does
    other.follow(news)
    assert other.of(frozenset([SLIP]))[AT].x == 2.0
