"""A model that remembers its last runs answers as the model does, and asks it only for what is new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.closed_loop import toy

from livedeform.closed_loop import remembered
from livedeform.closed_loop.forward import dictionary_columns
from livedeform.closed_loop.remembered import Remembered


class Counting(toy.ToyModel):
    """The toy, which counts what it is asked."""

    asked = 0

    def run(self, effects, observations, columns=()):
        self.asked += 1
        return super().run(effects, observations, columns)


@pytest.fixture(name="model")
def _model():
    return Counting(toy.ToyBody(toy.markers()))


@pytest.fixture(name="o", scope="module")
def _o():
    return toy.record([], seed=1)


def columns_of(*names):
    known = toy.candidates(toy.markers())
    return dictionary_columns([known[name] for name in names])


def test_what_was_asked_is_not_asked_again(model, o):
    kept, effects, columns = Remembered(model), [toy.effect("stiffness", ratio=1.1)], columns_of("stiffness")
    first = kept.run(effects, [o], columns)
    again = kept.run([toy.effect("stiffness", ratio=1.1)], [o], columns)
    assert model.asked == 1
    assert np.array_equal(first[0].points, again[0].points)


def test_some_of_the_columns_are_those_of_the_model(model, o):
    kept, columns = Remembered(model), columns_of("stiffness", "time_offset", "viscoelasticity")
    kept.run([], [o], columns)
    for wanted in (columns[1:2], [columns[2], columns[0]], []):
        own, asked = toy.ToyModel(model.body).run([], [o], wanted)[0], kept.run([], [o], wanted)[0]
        assert np.array_equal(own.d_points, asked.d_points)
        assert np.array_equal(own.points, asked.points)
    assert model.asked == 1


def test_columns_that_are_new_are_asked_for(model, o):
    kept = Remembered(model)
    kept.run([], [o], columns_of("stiffness"))
    kept.run([], [o], columns_of("stiffness", "time_offset"))
    assert model.asked == 2


@pytest.mark.parametrize("effect", [{"ratio": 1.1 + 1e-15}, {"ratio": 1.2}])
def test_other_values_are_other_questions(model, o, effect):
    kept = Remembered(model)
    kept.run([toy.effect("stiffness", ratio=1.1)], [o])
    kept.run([toy.effect("stiffness", **effect)], [o])
    kept.run([], [o])
    assert model.asked == 3


def test_other_moments_recordings_and_budgets_are_other_questions(model, o):
    kept, half = Remembered(model), np.arange(o.n_moments) % 2 == 0
    others = [o, o.take(half), o.take(~half), replace(o, name="b"), replace(o, patience=3.0), replace(o, before=o)]
    for one in others:
        kept.run([], [one])
    kept.run([], others[:2])
    assert model.asked == len(others) + 1


def test_only_the_last_are_kept(model, o):
    kept = Remembered(model)
    ratios = [1.0 + 0.01 * k for k in range(remembered.MOST_RUNS + 1)]
    for ratio in ratios:
        kept.run([toy.effect("stiffness", ratio=ratio)], [o])
    kept.run([toy.effect("stiffness", ratio=ratios[-1])], [o])
    assert model.asked == len(ratios)
    kept.run([toy.effect("stiffness", ratio=ratios[0])], [o])
    assert model.asked == len(ratios) + 1


def test_what_is_too_large_is_not_kept(model, o, monkeypatch):
    monkeypatch.setattr(remembered, "LARGEST", 0)
    kept, columns = Remembered(model), columns_of("stiffness")
    kept.run([], [o], columns)
    kept.run([], [o], columns)
    assert model.asked == 2
