"""Mechanical effects make the same body in whatever order they are listed."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from itertools import combinations

import numpy as np
import pytest
from bodies import block_space, plane, soft, solve

from livedeform.common.types import EffectValues
from livedeform.fem_node.contact.probe_shapes import Sphere
from livedeform.fem_node.effects import EFFECTS, apply_effects
from livedeform.fem_node.physics.record import DeadLoad, Probe, Support, TemperatureCurve

LOAD = DeadLoad("weight", plane(2, 0.02), np.array([0.0, 0.0, -0.1]))
BONDED = soft(
    supports=(Support(plane(2, 0.0), "fixed"),),
    loads=(LOAD,),
    probe=Probe(Sphere(0.01)),
    temperature=TemperatureCurve((0.0, 1.0), (20.0, 30.0), 20.0),
)
HANGING = [9.81 * 0.3, 0.0, 0.0]


def acting(name):
    """The effect with values at which it does something."""
    values = {}
    for p in EFFECTS[name].INFO.parameters:
        size = () if p.size is None else max(p.size, np.size(p.start))
        start = np.broadcast_to(np.asarray(p.start, float), size)
        values[p.name] = np.clip(1.1 * start + 0.01, p.lower, 0.99 * p.upper)
    return EffectValues(name, values)


def described(physics):
    """Each field in words, numbers to nine digits; of several things in a field (factors, loads) the order is none."""

    def words(x):
        return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.9g}", repr(x))

    values = {f.name: getattr(physics, f.name) for f in fields(physics)}
    return {name: sorted(map(words, x)) if isinstance(x, tuple) else words(x) for name, x in values.items()}


@pytest.mark.parametrize(("one", "other"), list(combinations(sorted(EFFECTS), 2)))
def test_two_effects_are_the_same_in_either_order(one, other):
    both = [acting(one), acting(other)]
    found = described(apply_effects(BONDED, both))
    assert found == described(apply_effects(BONDED, both[::-1]))
    for effect in both:  # and neither takes the other away
        assert found != described(apply_effects(BONDED, [effect]))


def cut_and_slipping(fraction, stiffness, *, slip_first=False, n=2):
    """A block that hangs over from what is left of its base, on springs (None: bonded): its displacements (n, 3) m."""
    values = {"direction": np.array(0.0), "fraction": np.array(fraction)}
    effects = [EffectValues("base_debonding", values)]
    if stiffness is not None:
        effects.insert(0 if slip_first else 1, EffectValues("base_slip", {"stiffness": np.array(stiffness)}))
    body = replace(soft(0.45, 2e3), supports=BONDED.supports)
    return solve(block_space(n=n), apply_effects(body, effects), HANGING).u


def test_a_base_that_slips_comes_free_as_well():
    """In either order; listed first, the slip left nothing that could come free."""
    slips, both = (cut_and_slipping(fraction, 3e5) for fraction in (0.0, 0.3))
    np.testing.assert_array_equal(cut_and_slipping(0.3, 3e5, slip_first=True), both)
    assert np.abs(both).max() > 1.3 * np.abs(slips).max()  # measured 1.49


def test_what_is_left_of_a_base_is_a_bond_again_as_its_springs_stiffen():
    bonded = cut_and_slipping(0.3, None, n=4)
    away = [np.abs(cut_and_slipping(0.3, k, n=4) - bonded).max() / np.abs(bonded).max() for k in (3e5, 3e6, 1e9)]
    assert away[0] > away[1] > away[2]  # measured 0.127, 0.021, 0.0064
    assert away[2] < 0.02


def test_springs_come_free_smoothly():
    """As a bond does: its edge passes through the elements, so that a fit has something to go down."""
    found = [np.abs(cut_and_slipping(fraction, 3e5)).max() for fraction in np.linspace(0.1, 0.5, 17)]
    rise = np.diff(np.log(found))
    assert rise.min() > 0.0  # measured 0.017
    assert rise.max() < 3.0 * rise.mean()  # measured 2.57
