"""A model that remembers its last runs answers as the model does, and asks it only for what is new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy
import toy_loop

from livedeform.closed_loop import remembered
from livedeform.closed_loop.forward import Column, Run, dictionary_columns
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.remembered import Remembered
from livedeform.common.effect import Form


class Counting(toy.ToyModel):
    """The toy, which counts what it is asked."""

    asked = 0

    def run(self, effects, observations, columns=()):
        self.asked += 1
        return super().run(effects, observations, columns)


WHOLE = Run(
    np.zeros((2, 3, 3)),
    np.zeros((2, 3)),
    np.arange(54.0).reshape(2, 3, 3, 3),
    np.arange(18.0).reshape(2, 3, 3),
    rough=True,
)


class Fixed:
    """A model with one answer, which counts."""

    processes, asked = 1, 0

    def run(self, effects, observations, columns=()):
        self.asked += 1
        return [WHOLE]


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
    others += [replace(o, path=tuple(toy.path(seed=3))), replace(o, forces=np.zeros((o.n_moments, 3)))]
    others += [replace(o, before=replace(o, name="b"))]
    for one in others:
        kept.run([], [one])
    kept.run([], others[:2])
    assert model.asked == len(others) + 1


def test_forms_of_a_candidate_have_columns_of_their_own():
    known = toy.candidates(toy.markers())["viscoelasticity"]
    fixed = Fixed()
    kept = Remembered(fixed)
    for candidate in (known, replace(known, form=Form("other", (), dict)), known):
        kept.run([], [], [Column(candidate, (0.1, 0.2), 0)])
    assert fixed.asked == 3  # the latest is what is kept of one question


def test_what_was_not_asked_for_long_goes_where_all_would_be_too_large(model, o, monkeypatch):
    kept, effects = Remembered(model), [[toy.effect("stiffness", ratio=r)] for r in (1.0, 1.1, 1.2)]
    one = kept.run(effects[0], [o])[0]
    monkeypatch.setattr(remembered, "LARGEST", int(2.5 * one.points.nbytes))
    kept.run(effects[1], [o])
    kept.run(effects[0], [o])  # asked for again
    kept.run(effects[2], [o])  # the second goes
    assert model.asked == 3
    kept.run(effects[0], [o])
    assert model.asked == 3
    kept.run(effects[1], [o])
    assert model.asked == 4


def test_the_last_answer_is_kept_however_large(model, o, monkeypatch):
    monkeypatch.setattr(remembered, "LARGEST", 0)
    kept, columns = Remembered(model), columns_of("stiffness")
    kept.run([], [o], columns)
    kept.run([], [o], columns)
    assert model.asked == 1


def test_what_was_lost_is_asked_again(model, o, monkeypatch):
    lost = toy.ToyModel.run
    monkeypatch.setattr(toy.ToyModel, "run", lambda *a: [replace(r, points=np.nan * r.points) for r in lost(*a)])
    kept = Remembered(model)
    kept.run([], [o])
    kept.run([], [o])
    assert model.asked == 2


def test_forces_and_what_is_rough_go_with_their_columns():
    kept, columns = Remembered(Fixed()), columns_of("stiffness", "time_offset", "softening")[:3]
    kept.run([], [], columns)
    (some,) = kept.run([], [], columns[1:])
    np.testing.assert_array_equal(some.d_forces, WHOLE.d_forces[..., 1:])
    assert some.rough and not kept.run([], [], [])[0].rough


def test_the_search_asks_for_nothing_twice():
    truth, asked = [toy.effect("stiffness", ratio=1.3), toy.effect("viscoelasticity", g=[0.3], tau=[2.0])], []

    class Listening(toy.ToyModel):
        def run(self, effects, observations, columns=()):
            values = [(e.name, [np.asarray(v).tolist() for v in e.values.values()]) for e in effects]
            asked.append(str((values, [o.name for o in observations], [(c.candidate.name, c.z) for c in columns])))
            return super().run(effects, observations, columns)

    fit, test = (toy.record(truth, seed=seed, name=name) for seed, name in ((1, "fit"), (2, "test")))
    body = toy.ToyBody(toy_loop.PLACES)
    investigate(Listening(body), toy_loop.toy_inputs(fit, test, ["stiffness", "viscoelasticity"]))
    assert len(asked) == len(set(asked)) > 5
