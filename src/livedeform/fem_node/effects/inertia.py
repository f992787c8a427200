"""The body moves dynamically."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Inertia, Physics

RINGING = 1e-3  # m; of the probe, by which a body lags behind or overshoots: its markers move by a fraction of that


def _possible(around: Surroundings) -> bool:
    """Return whether the body is let go, or the probe jerks it."""
    return around.has_release or (around.has_probe and lag(around) > RINGING)


def lag(around: Surroundings) -> float:
    """Return by how much (m) the body does not follow the probe: its acceleration over the square of the first
    frequency, that of the body shearing on its base, pi/2 sqrt(G / rho) / height."""
    height = max(float(around.upper[2] - around.lower[2]), 1e-6)
    wave = around.physics.material.shear_modulus / around.physics.density
    return float(around.jolt * (2.0 / np.pi * height) ** 2 / wave)


def _starts(around: Surroundings) -> list[Start]:
    return [{"rayleigh_beta": beta} for beta in (0.002, 0.01)]


INFO = EffectInfo(
    name="inertia",
    acts_on="body",
    summary="the body moves dynamically: it rings after fast moves and releases",
    equation="M a + C v + r(u) = f, C = rayleigh_beta K; M holds the body, and each load along gravity as a hung mass",
    source="Hilber, Hughes & Taylor 1977; Bathe 1996, section 9.3",
    parameters=(Parameter("rayleigh_beta", "s", start=0.003, lower=0.0, upper=0.2, sigma=1.0, scale="log"),),
    shown_by="fast stops; a release",
    confused_with=("time_offset", "viscoelasticity"),
    possible=_possible,
    starts=_starts,
    tangent=False,
    rings=True,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with implicit dynamics, and damping in proportion to the stiffness."""
    return replace(physics, inertia=Inertia(rayleigh_beta=float(values["rayleigh_beta"])))
