"""The published names, which experiments are checked against, are those that the packages register."""

from dataclasses import fields

import numpy as np
import pytest

from livedeform.common.effect import EFFECT_PARAMETERS
from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import MATERIALS as PUBLISHED_MATERIALS
from livedeform.common.published_effects import OPTIONAL_PARAMETERS, PUBLISHED, doubled, impossible
from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.materials import MATERIALS
from livedeform.fem_node.physics.record import Physics, TemperatureCurve
from livedeform.stereo_node.effects import EFFECTS as MEASURING
from livedeform.stereo_node.effects import View, distort_all


def test_effects():
    registered = {**MECHANICAL, **MEASURING}
    assert {
        name: {p.name: p.size for p in effect.INFO.parameters} for name, effect in registered.items()
    } == EFFECT_PARAMETERS
    optional = {name: {p.name: p.size for p in effect.INFO.optional} for name, effect in registered.items()}
    assert {name: sizes for name, sizes in optional.items() if sizes} == OPTIONAL_PARAMETERS
    assert not set(MECHANICAL) & set(MEASURING)


REGISTERED = {**MECHANICAL, **MEASURING}


@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_an_effect_goes_with_the_part_of_an_experiment_that_it_acts_on(name: str):
    """A fitted model takes those of the body to other probes and cameras, and no others."""
    parts = {"probe": "probe", "measuring": "stereo"}
    assert PUBLISHED[name].goes_with == parts.get(REGISTERED[name].INFO.acts_on, "phantom")


@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_a_fit_looks_only_where_values_are_possible(name: str):
    published = {**PUBLISHED[name].parameters, **PUBLISHED[name].optional}
    for parameter in (*REGISTERED[name].INFO.parameters, *REGISTERED[name].INFO.optional):
        limits = published[parameter.name].limits
        assert limits.lower <= parameter.lower and parameter.upper <= limits.upper, parameter.name


def acting(name: str, by: float = 1.0) -> EffectValues:
    start = {p.name: np.asarray(p.start if p.size is None else np.broadcast_to(p.start, max(p.size, 1)), float)
             for p in REGISTERED[name].INFO.parameters}  # fmt: skip
    return EffectValues(name, {parameter: by * value + 1e-3 for parameter, value in start.items()})


@pytest.mark.parametrize("name", sorted(REGISTERED))
def test_an_effect_is_there_once_or_acts_each_time(name: str):
    """Of most the last one listed took the place of the first in silence: a body with two terms of relaxation had one
    that relaxes as the second says."""
    twice = [acting(name), acting(name, 1.1)]
    if PUBLISHED[name].several:
        both, one = (apply_effects(Physics(), effects) for effects in (twice, twice[:1]))
        for field in fields(both):
            a, b = getattr(both, field.name), getattr(one, field.name)
            if isinstance(a, tuple):
                assert a[: len(b)] == b
        assert doubled(twice) == "" and len(both.modulus_fields) == 2
        return
    assert f"'{name}' is listed 2 times" in doubled(twice)
    with pytest.raises(InputError, match=f"'{name}' is listed 2 times") as error:
        if name in MECHANICAL:
            apply_effects(Physics(temperature=TemperatureCurve((0.0, 1.0), (20.0, 30.0), 20.0)), twice)
        else:
            points = np.zeros((1, 3))
            distort_all(points, 0, twice, View(np.eye(4), None, points, np.ones(1), np.array(["surface"]), 0))
    assert "\n" not in str(error.value) and "keep one" in str(error.value)


@pytest.mark.parametrize("name", sorted(MECHANICAL))
def test_the_solver_refuses_what_is_impossible_too(name: str):
    """Values need not come from a file that was checked as it was read."""
    start = {p.name: np.asarray(p.start if p.size is None else np.broadcast_to(p.start, max(p.size, 1)), float)
             for p in MECHANICAL[name].INFO.parameters}  # fmt: skip
    assert impossible(name, start) == ""
    for parameter, value in start.items():
        limits = PUBLISHED[name].parameters[parameter].limits
        beyond = [np.nan, *(end for end in (limits.lower - 0.1, limits.upper + 0.1) if np.isfinite(end))]
        for one in beyond:
            wrong = EffectValues(name, {**start, parameter: np.full_like(value, one)}, {})
            with pytest.raises(InputError, match=f"'{parameter}' of effect '{name}'"):
                apply_effects(Physics(), [wrong])


def test_materials():
    assert set(MATERIALS) == set(PUBLISHED_MATERIALS)
