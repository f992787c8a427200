"""What is solved is found again by the effects with which it was solved, or else with the most of them."""

import numpy as np

from livedeform.closed_loop.model.guesses import MOST_KINDS, Guess, Guesses
from livedeform.common.types import EffectValues

AT = ("a", 5)
STIFFNESS, SLIP, TILT = (EffectValues(n, {}) for n in ("stiffness", "base_slip", "gravity_tilt"))


def guess(x: float) -> Guess:
    return Guess(np.array([x]), None, None, {}, {("stiffness", 0): np.ones(1)})


def solved(*of: tuple[tuple[EffectValues, ...], float]) -> Guesses:
    guesses = Guesses()
    for effects, x in of:
        guesses.of(effects)[AT] = guess(x)
    return guesses


def test_another_effect_s_solution_is_not_in_the_way():
    guesses = solved(((), 1.0), ((SLIP,), 2.0))
    assert guesses.of(())[AT].x == 1.0
    assert guesses.of((STIFFNESS,))[AT].x == 1.0
    assert guesses.of((SLIP,))[AT].x == 2.0
    assert AT not in solved(((SLIP,), 2.0)).of((STIFFNESS,))


def test_the_solution_with_the_most_of_the_effects_is_read():
    guesses = solved(((), 1.0), ((SLIP,), 2.0), ((SLIP, STIFFNESS), 3.0))
    assert guesses.of((TILT, STIFFNESS, SLIP))[AT].x == 3.0
    assert guesses.of((TILT, SLIP))[AT].x == 2.0
    assert guesses.of((EffectValues("stereo_scale", {}), SLIP))[AT].x == 2.0  # a camera's effect moves no body


def test_the_kinds_that_were_used_last_are_kept_and_the_declared_model():
    names = [f"{k}" for k in range(MOST_KINDS + 2)]
    guesses = Guesses()
    guesses.of(())[AT] = guess(0.0)
    guesses.hear({(frozenset([n]), AT): guess(1.0) for n in names})
    guesses.of((STIFFNESS,))
    kinds = {kind for kind, _ in guesses.known}
    assert frozenset() in kinds and frozenset([names[-1]]) in kinds and frozenset([names[0]]) not in kinds


def test_another_process_is_told_what_it_does_not_know_without_slopes():
    guesses = solved(((), 1.0), ((SLIP,), 2.0))
    news = guesses.news({(frozenset(), AT)})
    assert list(news) == [(frozenset(["base_slip"]), AT)]
    assert not news[frozenset(["base_slip"]), AT].slopes
    other = solved(((SLIP,), 7.0))
    other.hear(news)
    assert other.of((SLIP,))[AT].x == 7.0  # its own is nearer to what it does
    other.follow(news)
    assert other.of((SLIP,))[AT].x == 2.0
