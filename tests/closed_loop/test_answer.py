"""What the answer says of moments without a prediction."""

import numpy as np

from closed_loop.answer import said_of_unsolved
from closed_loop.forward import Run


def run(lost: int) -> Run:
    points = np.zeros((5, 3, 3))
    points[:lost] = np.nan
    return Run(points, None, np.zeros((5, 3, 3, 0)), None)


def test_moments_that_could_not_be_solved_are_counted():
    said = said_of_unsolved("fitted", [run(0), run(2)])
    assert said == ["2 of 10 fitted moments are left out: no equilibrium was found there"]


def test_nothing_is_said_where_all_are_solved():
    assert said_of_unsolved("fitted", [run(0)]) == said_of_unsolved("held-out", []) == []
