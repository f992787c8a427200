"""The closed loop finds a stated rest that was not at rest, where support markers tell it from the tracker's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import phantom
import pytest
import toy
from scipy.spatial.transform import Rotation
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.model.fem_model import Body, Setting
from livedeform.closed_loop.model.workers import FemModel
from livedeform.common.types import Array

SHIFT, TURN = np.array([3e-4, 0.0, 4e-4]), np.array([3e-3, -4e-3, 0.0])  # m and rad, by which the stated rest is off
NAMES = ("reference_pose", "gravity_tilt")
RECORDINGS = ("fit", "test")


def with_markers(places: Array, support: int, n: int) -> Setting:
    """Return a body of finite elements with markers there, the first of them on its support."""
    setting = phantom.setting(n, RECORDINGS)
    kinds = np.array(["support"] * support + ["surface"] * (len(places) - support))
    views = {name: replace(view, rest=places, kinds=kinds) for name, view in setting.views.items()}
    return replace(setting, markers=places, views=views, still=kinds == "support")


def stated(support: int) -> Array:
    """Return where the experiment has the markers (m, 3) m: the body was held off its rest, its support was not."""
    off = Rotation.from_rotvec(TURN).apply(PLACES) + SHIFT
    return np.where((np.arange(len(PLACES)) < support)[:, None], PLACES, off)


def measured(body: Body, seed: int, name: str) -> Observation:
    """Return what a tracker that knows its frame sees of the body as it is: a toy's recording, its motion replaced."""
    o = toy.record([], seed=seed, name=name, n=14)
    run = body.simulate([], o, [])
    more = run.points - toy.ToyBody(PLACES).points([], o.seconds, np.array([p.position for p in o.poses]))
    return replace(o, points=o.points + more, single=o.single + more)


def diagnosed(support: int, n: int = 2, names: Sequence[str] = NAMES, *, off: bool = True) -> Diagnosis:
    """Diagnose with the stated places what was measured of a body with the true ones."""
    truth = Body(with_markers(PLACES, support, n))
    fit, test = (measured(truth, seed, name) for seed, name in zip((1, 2), RECORDINGS, strict=True))
    with FemModel(with_markers(stated(support) if off else PLACES, support, n), 1) as model:
        return investigate(model, toy_inputs(fit, test, names))


def check_named(said: Diagnosis) -> None:
    """Assert that it is named alone with its values, and that nothing but noise is left."""
    assert said.verdict == "effect" and [e.name for e in said.effects] == ["reference_pose"], said.text
    found = said.effects[0]
    for name, true in (("translation", SHIFT), ("rotation", TURN)):
        assert np.abs(found.values[name] - true).max() < 4.0 * found.sigmas[name].max()
    assert said.before.rmse > 1.5 * said.floor and said.after.rmse < 1.1 * said.floor


def test_a_stated_rest_that_was_none_is_named_with_its_motion():
    check_named(diagnosed(support=6))


def test_a_rest_that_was_at_rest_is_not_named():
    assert not diagnosed(support=6, off=False).effects


def test_without_support_markers_it_is_said_that_the_registration_hides_it():
    """It is within what is allowed for the tracker's frame; 0.5 mm of it beside 0.17 mm of noise were passed over."""
    said = diagnosed(support=0)
    assert said.verdict == "undecided" and not said.effects
    assert "one rigid motion of all markers all the time, which is allowed for as registration" in said.text
    assert said.before.rmse > 2.0 * said.floor
    at_rest = diagnosed(support=0, off=False)
    assert at_rest.verdict == "none" and "rigid motion" not in at_rest.text


@pytest.mark.slow
def test_a_stated_rest_that_was_none_is_named_among_more_candidates():
    names = (*NAMES, "density", "stiffness_gradient", "probe_offset")
    check_named(diagnosed(support=6, n=4, names=names))
