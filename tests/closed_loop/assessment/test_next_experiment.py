"""The experiment that would tell two explanations apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import toy
from toy_loop import toy_inputs

from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Run
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import EffectValues

SMOOTH = (EffectValues("probe_friction", {"mu": np.array(0.0)}),)


class Noting(toy.ToyModel):
    """A model that notes which effects motions that were not recorded are predicted with."""

    def __init__(self) -> None:
        super().__init__(toy.ToyBody(toy.markers()))
        self.planned: list[tuple[list[str], int]] = []

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        if not any(o.name in ("fit", "test") for o in observations):
            self.planned.append(([e.name for e in effects], len(observations)))
        return super().run(effects, observations, columns)


def proposed(names: Sequence[str], model: Noting) -> Diagnosis:
    """Diagnose a body that is heavier than declared, under a probe that is declared to rub."""
    effects = [toy.effect("density", ratio=1.3)]
    fit, test = (toy.record(effects, seed=s, name=n, n=36) for s, n in ((0, "fit"), (1, "test")))
    inputs = toy_inputs(fit, test, names)
    return investigate(model, replace(inputs, reach=replace(inputs.reach, smooth=SMOOTH)))


def test_all_motions_are_planned_at_once_under_a_probe_that_slides_freely() -> None:
    model = Noting()
    result = proposed(("density", "stiffness", "probe_offset"), model)
    assert result.proposal is not None and len(result.proposal.separation) == 6
    assert [names[0] for names, _ in model.planned] == ["probe_friction"] * 2
    assert {n for _, n in model.planned} == {6}


@pytest.mark.parametrize("asked", [("density", "probe_friction"), ("stiffness",)])
def test_a_probe_whose_friction_is_asked_for_is_planned_as_declared(asked: Sequence[str]) -> None:
    reach = ProbeReach(np.zeros(3), np.ones(3), smooth=SMOOTH)
    assert reach.planned_with(asked) == ([] if "probe_friction" in asked else list(SMOOTH))
