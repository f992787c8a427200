"""Experiments of a foreign truth: three bodies, three probes, two trackers, two rates, three element sizes.

Sizes of effects count noise as on the standard block (`benchmarks.blind.cases`): a poor tracker has larger effects. All
cases of a body and a probe press alike, so that those with measuring effects alone share the solved body.
"""

from __future__ import annotations

import copy
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

from benchmarks.blind.cases import STANDARD, Case, declare_sigmas, sized

GOOD, POOR_TRACKER = 0.08, 0.24  # px
ONSET = 4.0  # s, of what moves a camera: between the presses of recording a
BODIES: dict[str, dict[str, Any]] = {
    "cuboid": {"shape": "block", "size": [0.08, 0.06, 0.045], "elements": [8, 6, 5], "focus": 1.0},
    "dome": {"shape": "hemi_ellipsoid", "semi_axes": [0.05, 0.05, 0.045], "elements": [6, 2], "focus": 1.0},
    "slab": {"shape": "bent_slab", "size": [0.1, 0.05, 0.03], "radius": 0.1, "elements": [10, 5, 4], "focus": 1.0},
}
PROBES: dict[str, dict[str, Any]] = {
    "ball": {"shape": {"sphere": 0.03}, "edge_radius": 0.0, "friction": 0.0},
    "cylinder": {"shape": {"cylinder": [0.014, 0.04]}, "edge_radius": 0.004, "friction": 0.0},
    "box": {"shape": {"box": [0.03, 0.02, 0.04]}, "edge_radius": 0.004, "friction": 0.0},
}
# (x, y) m of the two presses of recording a and that of b, and their depths m
PLACES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "cuboid": ((0.002, -0.003, 0.004), (0.016, 0.006, 0.006), (-0.012, 0.007, 0.006)),
    "dome": ((0.001, -0.002, 0.004), (0.005, 0.006, 0.006), (-0.005, 0.004, 0.005)),
    "slab": ((0.002, -0.002, 0.003), (0.022, -0.002, 0.005), (-0.018, 0.001, 0.004)),
}


@dataclass(frozen=True)
class ForeignCase(Case):
    """One experiment; ``body`` and ``probe`` by name, ``noise`` px, ``rate`` Hz, ``element`` m of the user's model."""

    probe: str = "ball"
    noise: float = GOOD
    rate: float = 10.0
    element: float = 0.014
    wrench: bool = True

    def scenario(self) -> dict[str, Any]:
        """Return the scenario of the case."""
        spec = copy.deepcopy(STANDARD)
        spec |= {"name": f"experiment-{self.seed:04d}", "body": BODIES[self.body], "probe": PROBES[self.probe]}
        spec["truth"] = [{**e, **({"onset": ONSET} if "onset" in e else {})} for e in self.effects]
        spec["declared"]["element_size"] = self.element
        spec["measuring"] = {"kind": "markers", "rate": self.rate, "noise_px": self.noise}
        spec["wrench"] = {"noise": 0.005} if self.wrench else None
        spec["path_step"] = 0.0025
        (xa, ya, shallow), (xb, yb, deep), (xc, yc, other) = PLACES[self.body]
        stroke = {"hold": 1.5, "retreat_speed": 0.05, "pause": 1.5}
        spec["recordings"] = {
            "a": [
                {"at": [xa, ya], "depth": shallow, "hold": 1.5},
                {"at": [xb, yb], "depth": deep, "stroke": [0.005, 0.0], **stroke},
            ],
            "b": [{"at": [xc, yc], "depth": other, "stroke": [-0.004, 0.003], **stroke}],
        }
        declare_sigmas(spec, self.truth, self.seed)
        return spec

    @property
    def distinct(self) -> Hashable:
        """Return what tells it from those that are pressed alike and measured by other means."""
        return self.truth, self.size, self.body, self.probe


# name, body, probe, tracker, rate, element: first those that share a body with others, so that a part is worth most
_PLAN: tuple[tuple[str, str, str, float, float, float], ...] = (
    ("none", "cuboid", "ball", GOOD, 10.0, 0.014),
    ("none", "slab", "cylinder", GOOD, 10.0, 0.014),
    ("none", "dome", "box", GOOD, 30.0, 0.014),
    ("time_offset", "cuboid", "ball", GOOD, 10.0, 0.014),
    ("probe_offset", "slab", "cylinder", GOOD, 10.0, 0.014),
    ("stereo_scale", "dome", "box", GOOD, 30.0, 0.014),
    ("stiffness", "cuboid", "box", GOOD, 10.0, 0.014),
    ("none", "cuboid", "ball", POOR_TRACKER, 30.0, 0.014),
    ("base_slip", "slab", "ball", GOOD, 10.0, 0.014),
    ("none", "slab", "cylinder", POOR_TRACKER, 30.0, 0.014),
    ("stiffness_gradient", "cuboid", "cylinder", GOOD, 10.0, 0.014),
    ("none", "dome", "box", POOR_TRACKER, 10.0, 0.014),
    ("gravity_tilt", "dome", "ball", GOOD, 10.0, 0.014),
    ("none", "cuboid", "ball", GOOD, 10.0, 0.008),
    ("density", "slab", "box", GOOD, 10.0, 0.014),
    ("none", "slab", "cylinder", GOOD, 10.0, 0.008),
    ("poisson_ratio", "dome", "cylinder", GOOD, 10.0, 0.014),
    ("camera_motion", "cuboid", "ball", GOOD, 30.0, 0.014),
    ("probe_offset", "cuboid", "ball", POOR_TRACKER, 10.0, 0.014),
    ("stereo_scale", "slab", "cylinder", POOR_TRACKER, 10.0, 0.008),
    ("time_offset", "dome", "box", GOOD, 30.0, 0.014),
    ("inclusion", "cuboid", "ball", GOOD, 10.0, 0.014),
    ("skin", "dome", "ball", GOOD, 10.0, 0.014),
    ("swelling", "slab", "ball", GOOD, 10.0, 0.014),
    ("none", "dome", "box", GOOD, 10.0, 0.008),
    ("none", "cuboid", "ball", GOOD, 30.0, 0.005),
    ("none", "slab", "cylinder", GOOD, 30.0, 0.005),
    ("stiffness", "slab", "cylinder", POOR_TRACKER, 30.0, 0.014),
    ("base_slip", "cuboid", "box", POOR_TRACKER, 10.0, 0.008),
    ("stiffness_gradient", "slab", "ball", GOOD, 30.0, 0.008),
    ("gravity_tilt", "cuboid", "cylinder", POOR_TRACKER, 10.0, 0.005),
    ("stiffness", "dome", "box", GOOD, 10.0, 0.005),
)


def foreign() -> list[Case]:
    """Return the cases in the order of what tells most first; every effect is twice the noise."""
    cases: list[Case] = []
    for k, (name, body, probe, noise, rate, element) in enumerate(_PLAN):
        none = name == "none"
        effects: tuple[Mapping[str, Any], ...] = () if none else (sized(name, 2.0 * noise / GOOD),)
        label = f"foreign-{name}-{body}-{probe}-{1e3 * element:.0f}-{k:02d}"
        kind, size = ("none", 0.0) if none else ("single", 2.0)
        cases.append(
            ForeignCase(label, kind, effects, size, 20_000 + k, body, probe, noise, rate, element, wrench=k % 2 == 0)
        )
    return cases
