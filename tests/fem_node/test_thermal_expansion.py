"""Thermal expansion: exact for a free body, and on top of swelling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import block_space, soft, solve, symmetry

from livedeform.common.errors import InputError
from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import TemperatureCurve

WARMING = TemperatureCurve((0.0, 100.0), (20.0, 40.0), reference=20.0)
EXPANSION = EffectValues("thermal_expansion", {"alpha": np.array(3e-4)})
SWELLING = EffectValues("swelling", {"rate": np.array(0.0), "offset": np.array(0.02)})


@pytest.mark.parametrize(("effects", "J"), [([EXPANSION], 1.009), ([EXPANSION, SWELLING], 1.009 * 1.02)])
def test_a_free_body_grows_by_exactly_that_without_stress(effects, J):
    """Half way to 40 degrees: 3 alpha 10 K = 0.9 %."""
    free = replace(soft(), supports=symmetry(0, 1, 2), temperature=WARMING)
    mechanics = solve(block_space(), apply_effects(free, effects), time=50.0)
    np.testing.assert_allclose(mechanics.u, (J ** (1 / 3) - 1.0) * mechanics.space.nodes, atol=1e-14)
    _, stress = mechanics.continuum.stress(mechanics.x)
    np.testing.assert_allclose(stress, 0.0, atol=1e-8)  # Pa


def test_it_drifts_only_where_the_temperature_does():
    for temperature, drifts in ((WARMING, True), (TemperatureCurve((0.0,), (30.0,), 20.0), False)):
        memory = memory_of(apply_effects(replace(soft(), temperature=temperature), [EXPANSION]))
        assert bool(memory.drifts) == drifts and not memory.path_dependent


def test_it_needs_a_temperature():
    with pytest.raises(InputError, match="how warm") as caught:
        apply_effects(soft(), [EXPANSION])
    assert "temperature" in caught.value.remedy
