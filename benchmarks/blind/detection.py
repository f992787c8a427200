"""Find how often an effect is named by how large it is over the noise, and how often a diagnosis says that it would see
it.

Each diagnosis states the size of every effect that it would have seen with 95 %. Where that effect is one number, one
that is r times as large is r (c + 1.645) sigma from nothing, c being the level that all candidates together have to
exceed by chance, and is seen with the probability Phi(r (c + 1.645) - c) then. Held-out data must confirm it as well
before it is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.blind.cases import NEUTRAL
from livedeform.closed_loop.candidates import all_effects
from livedeform.closed_loop.settings import Settings

EDGES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, np.inf)  # of the noise of a frame, rms per coordinate
SEVERAL_NUMBERS = ("gravity_tilt", "camera_motion", "probe_offset")  # effects of which no single number is the size
STIFFNESSES = ("base_slip",)  # effects that are the larger the less their number is


def predicted(
    effects: Sequence[Mapping[str, Any]], found: Mapping[str, Any], nothing: Mapping[str, float] = NEUTRAL
) -> float:
    """Return the probability with which a diagnosis says that it would see a single true effect of one number, by how
    far from ``nothing`` it is; NaN if it says nothing of it."""
    rows = found["candidates"]
    visible = {row["name"]: row["detectable"] for row in rows if "detectable" in row}
    if len(effects) != 1 or effects[0]["name"] not in visible or not any(visible.values()):
        return float("nan")
    name = str(effects[0]["name"])
    if name in SEVERAL_NUMBERS:
        return float("nan")
    if not visible[name]:  # null beside others that are not: no size that it can have
        return 0.0
    ratio = times_visible(effects[0], visible[name], nothing)
    settings = Settings()
    alone = 1.0 - (1.0 - settings.selection.alpha) ** (1.0 / len(rows))
    level, power = norm.isf(alone / 2.0), norm.ppf(settings.verdict.power)
    return float(norm.cdf(ratio * (level + power) - level))


def times_visible(effect: Mapping[str, Any], visible: float, nothing: Mapping[str, float] = NEUTRAL) -> float:
    """Return how many times as large a true effect is as the one that is ``visible``, by its first parameter's
    difference from no effect; by that of its logarithm where the search fits that."""
    name = next(key for key in effect if key != "name")
    value, none = float(np.ravel(effect[name])[0]), nothing.get(name, 0.0)
    if effect["name"] in STIFFNESSES:
        return visible / value
    parameter = next(p for p in all_effects()[effect["name"]].parameters if p.name == name)
    if parameter.scale == "log" and none > 0.0:
        return float(abs(np.log(value / none)) / np.log1p(visible / none))
    return abs(value - none) / visible


def curve(measured: Sequence[tuple[float, bool, float]]) -> list[str]:
    """Tabulate how often effects were named right by size: of (size over noise, whether named, predicted probability)
    each."""
    lines = ["size over noise   named right        it would see"]
    for low, high in pairwise(EDGES):
        here = [(right, expected) for size, right, expected in measured if low <= size < high]
        told = [expected for _, expected in here if np.isfinite(expected)]
        named = f"{sum(right for right, _ in here)} of {len(here)}"
        chance = f"{100 * np.mean(told):.0f} % (n {len(told)})" if told else "-"
        lines.append(f"{low:4g} to {high:<4g}      {named:18s} {chance}")
    return lines
