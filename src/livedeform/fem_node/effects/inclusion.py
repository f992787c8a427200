"""A region has another stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings, Together, Usual
from livedeform.common.types import Array
from livedeform.fem_node.physics.fields import Ball
from livedeform.fem_node.physics.record import Physics

MOST_CENTRES = 16  # that are tried
REACH = 2.5  # spacings of the grid that a centre may be from a marker


def _starts(around: Surroundings) -> list[Start]:
    """Return balls on a grid, sized by the body."""
    radius = float(np.clip(0.16 * (around.upper - around.lower).min(), 0.004, 0.02))
    return [{"centre": centre, "radius": radius} for centre in grid(around, 1.6 * radius)]


def grid(around: Surroundings, spacing: float) -> Array:
    """Return centres (n, 3) m on a grid near the markers, at most ``MOST_CENTRES``: of each height in turn the one
    that is nearest to the presses, as what lies deep is seen too."""
    inside = around.lower + 0.5 * spacing, around.upper - 0.4 * spacing
    axes = [np.linspace(a, max(b, a), max(round((b - a) / spacing) + 1, 1)) for a, b in zip(*inside, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    near_marker = np.linalg.norm(centres[:, None] - around.markers[None], axis=2).min(axis=1)
    centres = centres[near_marker < REACH * spacing]
    if len(around.contacts):
        near = np.linalg.norm(centres[:, None] - around.contacts[None], axis=2).min(axis=1)
        centres = centres[np.argsort(near, kind="stable")]
        level = np.unique(centres[:, 2].round(9), return_inverse=True)[1]
        turn = np.array([np.count_nonzero(level[:i] == level[i]) for i in range(len(level))])
        centres = centres[np.argsort(turn, kind="stable")]
    return np.asarray(centres[:MOST_CENTRES])


def _strength(values: Mapping[str, Array]) -> Array:
    """Return what is seen of a ball from some radii away, up to a factor (Eshelby 1957; nothing changes its volume)."""
    return np.asarray(values["radius"] ** 3 * _contrast(values["ratio"]))


def _contrast(ratio: Array) -> Array:
    """Return what is seen of a ball over what is seen of a rigid one of its size: -2/3 of a hole."""
    return np.asarray((ratio - 1.0) / (ratio + 1.5))


def _share(ratio: float) -> float:
    """Return what is seen of a ball over what is seen of a rigid one, or of a hole, of its size, 0 to 1."""
    return float(abs(_contrast(np.asarray(ratio)))) * (1.0 if ratio > 1.0 else 1.5)


INFO = EffectInfo(
    name="inclusion",
    acts_on="body",
    summary="a region has another stiffness",
    equation="E(X) = ratio E inside |X - centre| < radius (unloaded places)",
    source="definition; tumours are 2 to 20 times as stiff as their surroundings (Krouskop 1998)",
    parameters=(
        Parameter(
            "centre",
            "m",
            start=(0.0, 0.0, 0.0),
            lower=-1.0,
            upper=1.0,
            sigma=0.05,
            size=3,
            placed_by_elements=(0, 1, 2),
            in_body=True,
        ),
        Parameter("radius", "m", start=0.01, lower=0.002, upper=0.1, sigma=1.0, scale="log"),
        Parameter(
            "ratio",
            "1",
            start=1.0,
            lower=0.05,
            upper=50.0,
            sigma=1.5,
            neutral=1.0,
            scale="log",
            step=0.2,
            usual=Usual(_share, centre=0.68, sigma=0.8),  # of a ratio of 6.3, the middle of 2 to 20
        ),
    ),
    shown_by="a raster of presses",
    starts=_starts,
    together=Together("radius^3 x (ratio - 1) / (ratio + 1.5)", "m3", _strength),
    proved=(48, 50),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a ball of another modulus."""
    centre = np.asarray(values["centre"], float)
    ball = Ball((centre[0], centre[1], centre[2]), float(values["radius"]), float(values["ratio"]))
    return replace(physics, modulus_fields=(*physics.modulus_fields, ball))
