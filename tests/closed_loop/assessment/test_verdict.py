"""One rule says verdict and sentence: whatever is found, they agree."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from livedeform.closed_loop.assessment.verdict import Findings, Left, explained_share, headline, judge
from livedeform.closed_loop.settings import VerdictSettings

RULE = VerdictSettings()
FLOOR = 2e-5
P_VALUES = np.geomspace(1e-6, 1.0, 61)
SHARES = (-0.5, 0.0, 0.3, 0.69, 0.7, 0.71, 1.0, float("nan"))
SIZES = (0.0, 0.5, 0.99, 1.01, 3.0)  # of the excess that matters
FOUND = (((), 0.0), (("base_slip",), 40.0), (("base_slip", "stiffness"), 900.0))  # names, and what they gained
TAKEN = (-50.0, -2.1, -1.9, 0.0, 300.0)
NONE, LEFT = "The declared model explains", "is left beyond the measuring noise"
NOBODY, CAUSE = "There is a residual that no candidate accounts for", "the added effects explain"
CANNOT_TELL = "These recordings cannot tell"
QUIET = ("within the noise", "too small to matter", "othing smooth is left")


def left(p: float, size: float) -> Left:
    return Left(float(p), size * RULE.min_excess * FLOOR, 1.0)


def findings(
    p: float,
    share: float,
    size: float,
    names: tuple[str, ...],
    gained: float,
    taken: float,
    declared: Left | None = None,
) -> Findings:
    """What is found where the effects leave so much; the declared model leaves the same if not said otherwise."""
    after = left(p, size)
    return Findings(names, gained, declared or after, after, FLOOR, taken, share)


@pytest.mark.parametrize(("names", "gained"), FOUND, ids=["nothing", "one", "two"])
def test_sentence_and_verdict_never_disagree(names, gained):
    for p, share, size, taken in product(P_VALUES, SHARES, SIZES, TAKEN):
        said = judge(findings(p, share, size, names, gained, taken), RULE)
        text = said.sentence
        begins = {"none": NONE, "effect": CAUSE, "unexplained": NOBODY, "undecided": CANNOT_TELL}
        assert begins[said.verdict].lower() in text.lower(), (p, share, size, taken, text)
        assert sum(b.lower() in text.lower() for b in begins.values()) == 1
        # what is left is either said to be something or said to be nothing, and as the verdict takes it
        assert (LEFT in text) == said.loud
        assert any(q in text for q in QUIET) != said.loud
        if said.verdict in ("none", "undecided"):
            assert not said.loud
        if not names:
            assert (said.verdict == "unexplained") == said.loud


def test_what_was_called_within_the_noise_and_unexplained_at_once_is_one_of_them():
    """At p = 0.001 to 0.01 the text and the verdict had limits of their own, 0.01 and 0.002."""
    for p in (0.0015, 0.0021, 0.005, 0.0099, 0.011):
        said = judge(findings(p, float("nan"), 10.0, (), 0.0, 0.0), RULE)
        assert (said.verdict, "within the noise" in said.sentence) in (("unexplained", False), ("none", True))
        assert said.loud == (p < RULE.p_value)


@pytest.mark.parametrize(("p", "hidden"), [(1e-5, ()), (0.5, ("hidden",)), (0.5, ())])
def test_a_slow_error_is_a_reason_where_something_is_left_alone(p: float, hidden: tuple[str, ...]) -> None:
    found = replace(findings(p, float("nan"), 10.0, (), 0.0, 0.0), slow=("changes slowly",), hidden=hidden)
    said = judge(found, RULE)
    loud = p < RULE.p_value
    assert said.verdict == ("undecided" if loud or hidden else "none")
    assert ("changes slowly" in said.sentence) == loud == (LEFT in said.sentence)
    assert ("hidden" in said.sentence) == bool(hidden)


def test_the_limits_are_those_that_are_handed_in():
    found = findings(0.005, float("nan"), 10.0, (), 0.0, 0.0)
    assert judge(found, RULE).verdict == "none"
    assert judge(found, replace(RULE, p_value=0.01)).verdict == "unexplained"
    assert judge(found, replace(RULE, p_value=0.01, min_excess=10.0)).verdict == "none"
    part = findings(1e-5, 0.5, 10.0, ("density",), 100.0, 100.0)
    assert judge(part, RULE).verdict == "unexplained"
    assert judge(part, replace(RULE, min_explained=0.4)).verdict == "effect"


def test_what_held_out_data_contradict_is_no_cause():
    quiet = findings(0.5, 0.9, 0.5, ("inclusion",), 900.0, -50.0)
    loud = findings(1e-5, 0.9, 10.0, ("inclusion",), 900.0, -50.0)
    for found, verdict in ((quiet, "undecided"), (loud, "unexplained")):
        said = judge(found, RULE)
        assert said.verdict == verdict and "does not hold on held-out data" in said.sentence
    assert judge(replace(quiet, gained=40.0), RULE).verdict == "none"


def test_a_nearest_candidate_that_makes_it_worse_is_no_part_of_the_answer():
    """What was said to be left was left with it (1.763 mm), beside an error of 0.438 mm without it."""
    worse = findings(1e-5, -13.5, 10.0, ("camera_motion",), 900.0, 100.0, declared=left(1e-4, 3.0))
    said = judge(worse, RULE)
    assert said.verdict == "unexplained" and np.isnan(said.explained)
    assert "does not hold on held-out data" in said.sentence and "takes away" not in said.sentence
    assert f"Without it, a smooth residual of {3e3 * RULE.min_excess * FLOOR:.3f} mm rms is left" in said.sentence
    assert judge(replace(worse, declared=left(0.5, 3.0), gained=40.0), RULE).verdict == "none"


@pytest.mark.parametrize(("share", "taken"), [(0.5, 100.0), (0.9, -50.0)])
def test_what_is_left_is_left_by_the_model_that_is_given(share, taken):
    found = findings(1e-5, share, 10.0, ("skin", "density"), 900.0, taken, declared=left(1e-4, 20.0))
    said = judge(found, RULE)
    assert said.verdict == "unexplained"
    assert f"Without them, a smooth residual of {20e3 * RULE.min_excess * FLOOR:.3f} mm" in said.sentence


def test_the_share_is_of_what_there_was_to_explain():
    assert explained_share(100.0, 25.0) == pytest.approx(0.75)
    assert explained_share(100.0, -3.0) == pytest.approx(1.0)
    assert explained_share(10.0, 20.0, taken=80.0) == pytest.approx(0.8)  # what rings, a smooth black box cannot follow
    assert np.isnan(explained_share(0.0, -1.0))


def test_effects_that_held_out_data_do_not_confirm_are_no_cause():
    found = replace(findings(0.8, 1.0, 0.5, ("skin",), 40.0, 4.1), unconfirmed="skin earns nothing: taken out")
    said = judge(found, RULE)
    assert said.verdict == "undecided" and "skin earns nothing: taken out" in said.sentence
    assert np.isnan(said.explained)
    assert judge(replace(found, unconfirmed=""), RULE).verdict == "effect"


def test_what_held_out_data_do_not_confirm_is_not_said_to_be_perhaps_nothing():
    """Beside "A smooth residual of 0.441 mm rms is left (p = 0)" it was said that nobody can tell whether anything is
    missing."""
    found = replace(
        findings(0.8, 1.0, 0.5, ("skin",), 40.0, 4.1, declared=left(1e-9, 20.0)), unconfirmed="skin earns nothing"
    )
    said = judge(found, RULE)
    assert said.verdict == "undecided" and said.loud and LEFT in said.sentence
    assert "cannot tell whether" not in said.sentence and "cannot tell whether" not in headline(said.verdict, {}, ())
