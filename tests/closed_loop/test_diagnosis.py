"""What the diagnosis says, and how sure it is."""

from dataclasses import replace

import numpy as np
import toy

from livedeform.closed_loop.diagnosis import elements_error, unsolved_notes
from livedeform.closed_loop.forward import Run
from livedeform.closed_loop.inference.fitted_model import Added


def run(lost: int) -> Run:
    points = np.zeros((5, 3, 3))
    points[:lost] = np.nan
    return Run(points, None, np.zeros((5, 3, 3, 0)), None)


def test_moments_that_could_not_be_solved_are_counted():
    said = unsolved_notes("fitted", [run(0), run(2)])
    assert said == ["2 of 10 fitted moments are left out: no equilibrium was found there"]


def test_the_reason_is_said():
    said = unsolved_notes("held-out", [replace(run(1), reasons=("solver: more than one equilibrium",))])
    assert said[0].endswith("(solver: more than one equilibrium)")


def test_nothing_is_said_where_all_are_solved():
    assert unsolved_notes("fitted", [run(0)]) == unsolved_notes("held-out", []) == []


def test_elements_place_a_probe_less_well_sideways():
    """At an offset of 0.22 mm along x and 0.82 mm deep, elements of 14 mm: noise-free fits were 0.2 mm off sideways."""
    candidate = toy.candidates(toy.markers(), ["probe_offset"])["probe_offset"]
    error = elements_error(Added(candidate, np.array([2.2e-4, 0.0, 8.2e-4])), toy.SETTINGS.fit, 0.014)
    np.testing.assert_allclose(error, [1.82e-4, 1.82e-4, 3.3e-5], rtol=0.01)
