"""The whole method on a toy recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import toy

from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.progress import TimeBudget
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import EffectValues

PLACES = toy.markers()
LOWER, UPPER = np.array([-0.05, -0.05, 0.0]), np.array([0.05, 0.05, 0.05])


def toy_inputs(
    fit: Observation, test: Observation, names: Sequence[str] = toy.NAMES, settings: Settings = toy.SETTINGS
) -> Inputs:
    """What is known of a toy body, and one recording to fit and one to hold out."""
    return Inputs(
        fitted=(fit,),
        held_out=(test,),
        candidates=toy.candidates(PLACES, names),
        uncertain=toy.uncertain(PLACES),
        places=PLACES,
        settings=settings,
        reach=ProbeReach(LOWER, UPPER, fit.path[0], 0.008),
    )


def recorded(
    effects: list[EffectValues], seed: int = 0, *, sigma: float = 1e-4, detail: float = 0.0
) -> tuple[Observation, Observation]:
    """Record a toy body with these effects twice: to fit, and to hold out."""
    body = toy.ToyBody(PLACES, detail)
    fit = toy.record(effects, seed=seed, body=body, name="fit", n=36, sigma=sigma)
    test = toy.record(effects, seed=seed + 1000, body=body, name="test", n=24, sigma=sigma)
    return fit, test


def closed(
    effects: list[EffectValues],
    seed: int = 0,
    *,
    sigma: float = 1e-4,
    detail: float = 0.0,
    names: Sequence[str] = toy.NAMES,
    settings: Settings = toy.SETTINGS,
    budget: TimeBudget | None = None,
) -> Diagnosis:
    """Diagnose a toy recording with these undeclared effects, and one held out."""
    inputs = toy_inputs(*recorded(effects, seed, sigma=sigma, detail=detail), names, settings)
    return investigate(toy.ToyModel(toy.ToyBody(PLACES)), inputs, seed=seed, budget=budget)
