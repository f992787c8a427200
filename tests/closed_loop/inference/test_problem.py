"""The rows of a fit."""

from dataclasses import replace

import numpy as np
import toy

from livedeform.closed_loop.inference.fitted_model import FittedModel
from livedeform.closed_loop.inference.problem import ProblemFactory, yielding


def test_a_moment_without_an_equilibrium_gains_nothing():
    places = toy.markers()
    o = toy.record([], seed=1, body=toy.ToyBody(places), n=12)
    model, uncertain = toy.ToyModel(toy.ToyBody(places)), toy.uncertain(places)
    problems = ProblemFactory([o], toy.SETTINGS.allowance)
    problem, _ = problems.at(FittedModel(uncertain), model.run([], [o])[0], [])
    softer = model.run([toy.effect("stiffness", ratio=0.8)], [o])[0]
    points = softer.points.copy()
    points[5] = np.nan
    whole, _ = problems.residual_at(uncertain, problem, softer, [])
    partly, _ = problems.residual_at(uncertain, problem, replace(softer, points=points), [])
    lost = problem.rows.moment == 5
    assert np.abs(whole - problem.residual)[lost].max() > 1e-4
    np.testing.assert_array_equal(partly, np.where(lost, problem.residual, whole))


def test_what_holds_a_body_yields_with_it():
    motion = np.array([[0.0, 0.0, 0.0], [3e-3, 4e-3, 0.0]])
    assert np.allclose(yielding(motion, 1e-5)[:, 2], [0.0, 5e-3 / np.sqrt(2.0)])
    assert np.array_equal(yielding(motion[:, :2], 1e-5), motion[:, :2])  # nothing is held
    assert not yielding(0.0 * motion, 1e-5).any()
