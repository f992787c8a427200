"""Drifts count from the clock's start, whatever it is and a body of which they leave nothing is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import block_space, plane, soft

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import Support, TemperatureCurve

CLOCK_NS = 1_756_000_000_000_000_000
DAY_NS = 86_400_000_000_000
TOP = np.array([[0.01, 0.01, 0.02]])
DRIFTS = [("softening", 2e-4), ("softening", -2e-4), ("softening", 1e-9), ("swelling", 2e-6), ("swelling", -2e-6)]


def _model(name: str = "", rate: float = 0.0, **changes) -> PhantomModel:
    held = replace(soft(0.49, 4000.0, supports=(Support(plane(2, 0.0)),)), **changes)
    values = {"rate": np.array(rate)} | ({"offset": np.array(0.0)} if name == "swelling" else {})
    physics = apply_effects(held, [EffectValues(name, values)] if name else [])
    return PhantomModel(block_space(), physics, markers=TOP)


@pytest.mark.parametrize(("name", "rate"), DRIFTS)
def test_before_a_recording_is_known_the_body_rests_as_at_the_clocks_start(name, rate):
    """Not as in 1970, when it was e^351200 times as stiff or as soft, or had a negative volume."""
    still = _model().rest()
    sag = TOP[0, 2] - still.markers[0, 2]
    assert sag > 2e-4  # measured 4.33e-4 m
    for clock_ns in (None, CLOCK_NS):
        rest = _model(name, rate, clock_start_ns=clock_ns).rest()
        assert rest.converged and rest.stamp_ns == 0
        np.testing.assert_allclose(rest.markers, still.markers, atol=1e-12)  # measured 0


@pytest.mark.parametrize(("name", "rate"), [("softening", 5e-6), ("swelling", -1e-6)])
@pytest.mark.parametrize("later_ns", [0, 2 * DAY_NS])
def test_where_the_recordings_start_is_known_the_body_rests_as_it_begins(name, rate, later_ns):
    model = _model(name, rate, clock_start_ns=CLOCK_NS)
    model.reset(CLOCK_NS + later_ns)
    at_start = model.rest()
    first = model.predict(None, CLOCK_NS + later_ns)
    np.testing.assert_allclose(at_start.markers, first.markers, atol=1e-9)  # measured 7.2e-11 m
    moved = np.abs(at_start.markers - _model().rest().markers).max()
    assert moved > 1e-4 if later_ns else moved == 0.0  # measured 0; 5.65e-4 and 1.46e-3 m
    assert model.rest().stamp_ns == first.stamp_ns  # from then on, of the last prediction


@pytest.mark.parametrize("name", ["swelling", "thermal_expansion"])
def test_a_body_of_which_nothing_is_left_has_no_equilibrium_and_one_line_says_why(name):
    if name == "swelling":
        model = _model(name, -1e-5, clock_start_ns=CLOCK_NS)
        lost, left = model.predict(None, CLOCK_NS + 2 * DAY_NS), "-0.728"
    else:
        curve = TemperatureCurve((0.0,), (20.0,), reference=40.0)
        physics = replace(soft(supports=(Support(plane(2, 0.0)),)), temperature=curve)
        physics = apply_effects(physics, [EffectValues(name, {"alpha": np.array(0.02)})])
        model = PhantomModel(block_space(), physics, markers=TOP)
        lost, left = model.rest(), "-0.2"
    assert not lost.converged and np.isnan(lost.markers).all()
    assert "leaves nothing of the body" in lost.message and f"volume is {left} times" in lost.message
    assert "timeline.clock_start_ns" in lost.message and "\n" not in lost.message


def test_a_rest_that_is_needed_and_cannot_be_found_is_an_error():
    model = _model("swelling", -1e-5, clock_start_ns=CLOCK_NS)
    assert model.rest(needed=True).converged
    model.reset(CLOCK_NS + 2 * DAY_NS)
    before = model.mechanics.x.copy()
    with pytest.raises(ConvergenceError, match=r"^the body at rest: .* leaves nothing of the body"):
        model.rest(needed=True)
    assert not model.rest().converged
    np.testing.assert_array_equal(model.mechanics.x, before)
