"""What holds a body is as stiff as the body that is there, by whatever effect it is stiffer than declared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, solve

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.effects.base_debonding import StillBonded
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.mesh.structured import ball_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.physics.fields import Drift, HeightGradient, Skin, Uniform
from livedeform.fem_node.physics.record import Physics, Support

E, TIME = 4000.0, 100.0
SPACE, BALL = block_space(), make_space(ball_mesh(0.02, 2))
BASE = plane(2, 0.0)
CAP = lambda X: X[:, 2] < -0.012  # noqa: E731
SUPPORTS = {
    "bond": (SPACE, Support(StillBonded(BASE, 0.3, 0.25), "fixed")),
    "springs": (SPACE, Support(StillBonded(BASE, 0.3, 0.25), "spring", stiffness=3e5)),
    "cap": (BALL, Support(StillBonded(CAP, 0.3, 0.25), "spring", stiffness=3e5)),
    "whole cap": (BALL, Support(CAP, "spring", stiffness=3e5)),
    "friction": (SPACE, Support(BASE, "friction", mu=0.5)),
}


def body(support: Support, ratio: float, modulus: float = E) -> Physics:
    """A body ``ratio`` times as heavy as usual, on springs ``ratio`` times as stiff."""
    held = replace(support, stiffness=ratio * support.stiffness)
    return soft(0.45, modulus, supports=(held,), density=1000.0 * ratio)


@pytest.mark.parametrize(("kind", "ratio"), [*((kind, 0.1) for kind in SUPPORTS), ("bond", 10.0)])
def test_a_softer_and_lighter_body_has_the_same_shape_by_whatever_it_is_softer(kind, ratio):
    """The springs at a bond's edge went by the declared modulus: on a bond of which a quarter is loose this body was
    off by 67 and 167 % of its largest displacement, on friction by 1.9 %, on a whole cap by 0.1 %."""
    space, support = SUPPORTS[kind]
    pulled = [1.0, 0.0, -9.81]
    declared = solve(space, body(support, ratio, ratio * E), pulled).u
    drift = Drift(-np.log(ratio) / TIME)
    for fields in ((Uniform(0.5 * ratio), Uniform(2.0)), (drift,)):
        found = solve(space, replace(body(support, ratio), modulus_fields=fields), pulled, time=TIME).u
        assert np.abs(found - declared).max() < 1e-6 * np.abs(declared).max(), fields


@pytest.mark.parametrize(("kind", "scanned"), [("bond", 0.0), ("springs", 1.0)])
def test_columns_know_that_what_holds_the_body_stiffens_too(kind, scanned):
    space, support = SUPPORTS[kind]
    markers = np.array([[0.02, 0.015, 0.004], [0.01, 0.01, 0.02], [0.02, 0.005, 0.015]])
    pulled = np.array([2.0, 0.0, -9.81])
    still = replace(body(support, 1.0), gravity=pulled, scan_gravity=pulled, scan_fraction=scanned)
    if scanned:
        still = replace(still, gravity=0.5 * pulled)

    def stiffer(h):
        return replace(still, modulus_fields=(Uniform(1.0 + h), HeightGradient(8.0 * h), Skin(0.002, 1.5 + h)))

    def at_rest(h, directions=()):
        model = PhantomModel(space, stiffer(h), markers=markers, settings=EXACT)
        return model.simulate([], [0], directions, start_ns=0)

    found = at_rest(0.0, [Direction("stiffness", stiffer(1e-5), 1e-5)]).d_markers[0, ..., 0]
    ends = [at_rest(h).predictions[0].markers for h in (0.002, -0.002)]
    difference = (ends[0] - ends[1]) / 0.004
    assert np.abs(found - difference).max() < 1e-4 * np.abs(difference).max()  # measured 1.9e-5


@pytest.mark.parametrize("ratio", [0.2, 5.0])
def test_a_bond_begins_to_give_way_by_the_modulus_that_is_there(ratio):
    markers, pulled = np.array([[0.02, 0.015, 0.004], [0.01, 0.01, 0.02]]), np.array([2.0, 0.0, -9.81])
    loose = [EffectValues("base_debonding", {"direction": np.array(0.0), "fraction": np.array(0.1)})]

    def begun(modulus, fields):
        whole = replace(body(Support(BASE), ratio, modulus), gravity=pulled, modulus_fields=fields)
        model = PhantomModel(SPACE, whole, markers=markers, settings=EXACT)
        found = model.simulate([], [0], [Direction("fraction", apply_effects(whole, loose), 0.1)], start_ns=0)
        return found.d_markers[0, ..., 0]

    np.testing.assert_allclose(begun(E, (Uniform(ratio),)), begun(ratio * E, ()), rtol=1e-6)


def test_the_modulus_behind_a_facet_is_that_of_its_element():
    base = np.flatnonzero(BASE(SPACE.facet_centres))
    top = np.flatnonzero(plane(2, 0.02)(SPACE.facet_centres))
    graded = Continuum(SPACE, replace(body(Support(BASE), 1.0), modulus_fields=(HeightGradient(50.0),)))
    graded.prepare(moment())
    assert graded.modulus_behind(base).max() < 0.9 * E < 1.1 * E < graded.modulus_behind(top).min()
