"""The body relaxes and creeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics, Prony

SHORTEST, N_TIMES = 0.1, 7  # s, and how many times from it to beyond the recording are tried


def _starts(around: Surroundings) -> list[Start]:
    """Return relaxation times from a tenth of a second to beyond the recording."""
    longest = max(around.duration, 2.0)
    return [{"tau": float(t)} for t in np.geomspace(SHORTEST, 1.5 * longest, N_TIMES)]


INFO = EffectInfo(
    name="viscoelasticity",
    acts_on="body",
    summary="the body relaxes under a held press and creeps under a held load",
    equation="G(t) = G_0 (1 - sum g_i (1 - exp(-t/tau_i))), isochoric; the declared modulus is the relaxed one, "
    "G_0 (1 - sum g_i)",
    source="Simo 1987; Holzapfel 2000, section 6.10",
    parameters=(
        Parameter("g", "1", start=0.2, lower=0.0, upper=0.95, sigma=0.3, neutral=0.0, size=-1, step=0.05),
        Parameter("tau", "s", start=2.0, lower=0.02, upper=1000.0, sigma=1.0, size=-1, scale="log"),
    ),
    shown_by="press, hold, fast retreat, wait; a release",
    confused_with=("softening", "plastic_set", "time_offset"),
    starts=_starts,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a Prony series; terms with g = 0 are left out."""
    g, tau = np.atleast_1d(values["g"]), np.atleast_1d(values["tau"])
    keep = [i for i in np.argsort(tau) if g[i] != 0.0]
    if not keep:
        return replace(physics, prony=None)
    return replace(physics, prony=Prony(tuple(float(g[i]) for i in keep), tuple(float(tau[i]) for i in keep)))
