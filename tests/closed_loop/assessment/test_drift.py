"""A drift while the body is held is told by itself: small beside the motion, and named where it is missed."""

from __future__ import annotations

import numpy as np
import pytest
import ringing
import toy

from livedeform.closed_loop.assessment.drift import drift_of, longest
from livedeform.closed_loop.loop import investigate

SWINGS = [toy.effect("inertia", rayleigh_beta=0.004)]
CREEPS = [*SWINGS, toy.effect("viscoelasticity", g=[0.03], tau=[2.0])]  # some 0.1 mm of 7 mm, after the swing


def _drift(truth, model, seed=1, sigma=5e-6):
    o = ringing.record(truth, seed=seed, name="take", sigma=sigma)
    return drift_of([o], ringing.model().run(model, [o]))


def test_creep_that_the_model_lacks_is_missed_and_one_that_it_has_is_not():
    lacking, having = _drift(CREEPS, SWINGS), _drift(CREEPS, CREEPS)
    assert lacking.is_missed(toy.SETTINGS) and not having.is_missed(toy.SETTINGS)
    assert lacking.left == pytest.approx(lacking.measured, rel=0.1)
    assert having.left < 3.0 * having.sigma and having.measured > 5.0 * having.sigma


def test_of_a_body_that_does_not_creep_none_is_missed():
    assert not any(_drift(SWINGS, SWINGS, seed=s, sigma=2e-5).is_missed(toy.SETTINGS) for s in range(20))


def test_the_verdict_names_the_creep_and_does_not_say_that_everything_is_explained():
    """Without a relaxation among the candidates the swing is explained, the creep is not."""
    names = ("inertia", "stiffness", "density")
    fit, test = (ringing.record(CREEPS, seed=s, name=f"take {s}", sigma=5e-6) for s in (1, 2))
    found = investigate(ringing.model(), ringing.inputs(fit, test, names), max_effects=2)
    assert found.verdict == "effect"
    assert "What goes on while the body is held is not explained" in found.text
    assert "less than the" in found.text  # a tenth of the motion is more
    assert "explain 100 %" not in found.text and found.explained <= 0.99


def test_the_longest_stretch():
    assert longest(np.array([True, False, True, True, True, False, True])).tolist() == [2, 3, 4]
    assert len(longest(np.zeros(3, bool))) == 0
