"""The answer of the loop: its values as they are written, what is said of them, and how the graph repeats them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.closed_loop.inference.baselines import Simpler
from livedeform.closed_loop.inference.discrepancy import Remainder, describe
from livedeform.closed_loop.inference.forward_selection import Added, Search
from livedeform.closed_loop.inference.gauss_newton import Fit
from livedeform.closed_loop.inference.next_experiment import Proposal
from livedeform.closed_loop.inference.verdict import Metrics, Verdict
from livedeform.closed_loop.inputs import Inputs
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics

SIZE_ERROR = 0.04  # of a fitted effect's size: what its elements get wrong of it (docs/loop.md, blind test)
PLACE_ERROR = 0.013  # of the elements' size, for a place (the same)


@dataclass(frozen=True)
class Ranked:
    """A candidate of the first step: ``test_rmse`` m on held-out data, ``score`` (minus twice log predictive density
    against the declared model), ``score_gap`` to the best, and those that the data cannot tell from it. ``refined``:
    through the nonlinear model, not by its linearisation only."""

    name: str
    test_rmse: float
    score: float
    score_gap: float
    indistinguishable_from: tuple[str, ...]
    gain: float
    p_value: float
    refined: bool


@dataclass(frozen=True)
class Replay:
    """How the graph predicts a recording with the fitted model: its ``bag``, and the bags that a body with a set went
    through before (``after``, the earliest first)."""

    bag: Path
    after: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """The answer, and what stands behind it."""

    verdict: Verdict
    effects: tuple[EffectValues, ...]
    added: tuple[Added, ...]
    ranking: tuple[Ranked, ...]
    before: Metrics
    after: Metrics
    floor: float
    improvement: tuple[float, float]
    explained: float
    remainder: Remainder
    text: str
    search: Search
    held_out: tuple[Observation, ...]
    test_before: tuple[Run, ...]
    test_after: tuple[Run, ...]
    proposal: Proposal | None = None
    simpler: Simpler | None = None
    notes: tuple[str, ...] = ()
    replays: tuple[Replay, ...] = ()
    seconds: float = 0.0


def elements_share(inputs: Inputs, others: Simpler | None, rmse: float) -> list[str]:
    """What smaller elements would do to the error that is left, if a better mesh was solved."""
    if others is None or not inputs.uncertain.correction.points:
        return []
    return [
        f"of the {1e3 * rmse:.3f} mm that are left on held-out data, elements half as large under the probe leave "
        f"{1e3 * others.finer_after:.3f} mm: mesh the experiment more finely (element_size) if that matters"
    ]


def said_of_held_out(search: Search, taken: float) -> list[str]:
    """How held-out data judge what was found."""
    if not search.added:
        return []
    names = ", ".join(a.candidate.name for a in search.added)
    return [f"on held-out data {names} take {taken:.1f} off chi2"]


def said_of_unsolved(which: str, runs: Sequence[Run]) -> list[str]:
    """At how many moments of the recordings ``which`` the model has no prediction: they are left out."""
    lost = np.concatenate([np.isnan(run.points).all(axis=(1, 2)) for run in runs] or [np.zeros(0, bool)])
    if not lost.any():
        return []
    return [f"{lost.sum()} of {len(lost)} {which} moments are left out: no equilibrium was found there"]


def said_of_convergence(fit: Fit | None) -> list[str]:
    """Whether the last fit was still on its way."""
    if fit is None or fit.converged:
        return []
    return [f"the fit had not settled after {fit.n_runs} runs of the model: its values may be further off than said"]


def replays(inputs: Inputs, held_out: Sequence[Observation], effects: Sequence[EffectValues]) -> tuple[Replay, ...]:
    """Of what was held out, as far as it came from bags."""
    if not inputs.recordings:
        return ()
    declared = Physics() if inputs.forward is None else inputs.forward.setting.physics
    sets = memory_of(apply_effects(declared, [*inputs.declared, *effects])).sets
    out = []
    for o in held_out:
        names: list[str] = []
        earlier = o.before if sets else None
        while earlier is not None:
            if earlier.name not in (o.name, *names):  # a recording's last part goes on from its first
                names.insert(0, earlier.name)
            earlier = earlier.before
        if o.name in inputs.recordings:
            out.append(Replay(inputs.recordings[o.name].path, tuple(inputs.recordings[n].path for n in names)))
    return tuple(out)


def fitted_values(search: Search, element_size: float = 0.0) -> list[EffectValues]:
    """The added effects with values and sigmas of the joint fit, through elements of a size in m."""
    out, at = [], 0
    for a in search.added:
        n = len(a.z)
        sigmas = {}
        if search.joint is not None and len(search.joint.z) >= at + n:
            covariance = search.joint.covariance[at : at + n, at : at + n]
            sigmas = a.candidate.sigmas(a.z, covariance + np.diag(elements_error(a, element_size) ** 2))
        out.append(EffectValues(a.candidate.name, a.values.values, sigmas))
        at += n
    return out


def elements_error(added: Added, element_size: float) -> Array:
    """What (p,) elements of a size in m get wrong of an added effect, which no repeat shows: `SIZE_ERROR` of its size,
    or of a length or a time, and `PLACE_ERROR` of theirs where a place is told. What acts on measuring is not
    theirs."""
    coordinates = added.candidate.coordinates
    if added.candidate.measuring:
        return np.zeros(len(coordinates))
    size = [abs(v) if c.amplitude else float(c.transform == "log") for c, v in zip(coordinates, added.z, strict=True)]
    info = added.candidate.info
    place = [element_size * (c.index in info.parameter(c.parameter).placed_by_elements) for c in coordinates]
    return np.hypot(SIZE_ERROR * np.array(size), PLACE_ERROR * np.array(place))


def describe_left(
    verdict: Verdict, search: Search, left: Remainder, explained: float, held_out: Sequence[Observation], places: Array
) -> str:
    """The paragraph of ``diagnosis.json``."""
    names = [str(i) for i in held_out[0].ids]
    text = describe(left, held_out, places, names)
    if verdict == "none":
        return "The declared model explains the recordings within their noise. " + text
    if verdict == "effect" and np.isfinite(explained):
        return f"The added effects explain {100.0 * explained:.0f} % of the excess over noise on held-out data. " + text
    if verdict == "effect":
        return "What the added effects explain is small against the noise of held-out data. " + text
    if not search.added:
        return "There is a residual that no candidate accounts for. " + text
    nearest = " and ".join(a.candidate.name for a in search.added)
    if np.isnan(explained):
        return (
            f"There is a residual that no candidate accounts for: what {nearest} explains where it was fitted does "
            f"not hold on held-out data. {text}"
        )
    return (
        f"There is a residual that no candidate accounts for: the nearest, {nearest}, takes away only "
        f"{100.0 * explained:.0f} % of the excess over noise on held-out data, and is not given as the cause. " + text
    )
