"""Find how often an effect is named by how large it is over the noise, and how often a diagnosis says that it would be.

Each diagnosis states the size of every effect that it would have seen with 95 %. An effect that is r times as large is
r (c + 1.645) sigma from nothing, c being the level that all candidates together have to exceed by chance, and is seen
with the probability Phi(r (c + 1.645) - c) then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.blind.cases import NEUTRAL
from livedeform.closed_loop.settings import Settings

EDGES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, np.inf)  # of the noise of a frame, rms per coordinate
TOGETHER = {"gravity_tilt": ("angle_x", "angle_y")}  # two parameters that are one amplitude
THE_LESS_THE_MORE = ("base_slip",)  # its stiffness is infinite where there is none


def size_of(effect: Mapping[str, Any]) -> float:
    """Return how far a true effect's first parameter is from no effect; of a base that slips, the stiffness."""
    first = next(key for key in effect if key != "name")
    values = [np.asarray(effect[key], float) for key in TOGETHER.get(effect["name"], (first,))]
    return float(np.linalg.norm(np.concatenate([np.atleast_1d(v - NEUTRAL.get(first, 0.0)) for v in values])))


def predicted(effects: Sequence[Mapping[str, Any]], found: Mapping[str, Any]) -> float:
    """Return the probability with which a diagnosis says that it would see a single true effect; NaN if it says
    nothing of it."""
    if len(effects) != 1:
        return float("nan")
    name, rows = effects[0]["name"], found["candidates"]
    visible = [row["detectable"] for row in rows if row["name"] == name and "detectable" in row]
    if not visible:
        return float("nan")
    if not visible[0]:  # null: no size that it can have
        return 0.0
    ratio = size_of(effects[0]) / visible[0]
    if name in THE_LESS_THE_MORE:
        ratio = 1.0 / ratio
    settings = Settings()
    alone = 1.0 - (1.0 - settings.selection.alpha) ** (1.0 / len(rows))
    level, power = norm.isf(alone / 2.0), norm.ppf(settings.verdict.power)
    return float(norm.cdf(ratio * (level + power) - level))


def curve(measured: Sequence[tuple[float, bool, float]]) -> list[str]:
    """Tabulate how often effects were named right by size: of (size over noise, whether named, predicted probability)
    each."""
    lines = ["size over noise   named right        predicted"]
    for low, high in pairwise(EDGES):
        here = [(right, expected) for size, right, expected in measured if low <= size < high]
        told = [expected for _, expected in here if np.isfinite(expected)]
        named = f"{sum(right for right, _ in here)} of {len(here)}"
        chance = f"{100 * np.mean(told):.0f} % (n {len(told)})" if told else "-"
        lines.append(f"{low:4g} to {high:<4g}      {named:18s} {chance}")
    return lines
