"""What an effect's parameters can be at all. Narrower bounds, within which a fit looks, are on the effects' cards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array

INFINITE = float("inf")


@dataclass(frozen=True)
class Limits:
    """Between ``lower`` and ``upper``, which belong to it where ``closed`` says so: "lower", "upper" or "both"."""

    lower: float
    upper: float = INFINITE
    closed: str = ""

    def allow(self, values: Array) -> bool:
        """Return whether every one of the values is possible."""
        above = values >= self.lower if self.closed in ("lower", "both") else values > self.lower
        below = values <= self.upper if self.closed in ("upper", "both") else values < self.upper
        return bool(np.all(np.isfinite(values) & above & below))

    def __str__(self) -> str:
        if self.lower == -INFINITE:
            return "finite"
        if self.upper == INFINITE:
            return f"{'at least' if self.closed else 'above'} {self.lower:g}"
        ends = {"lower": f", {self.lower:g} included", "upper": f", {self.upper:g} included", "both": " inclusive"}
        return f"between {self.lower:g} and {self.upper:g}{ends.get(self.closed, '')}"


POSITIVE, NOT_NEGATIVE = Limits(0.0), Limits(0.0, closed="lower")
SHARE = Limits(0.0, 1.0, "both")
BELOW_ONE = Limits(0.0, 1.0, "lower")
ANGLE = Limits(-np.pi, np.pi, "both")

LIMITS: dict[tuple[str, str], Limits] = {
    ("stiffness", "ratio"): POSITIVE,
    ("poisson_ratio", "value"): Limits(-1.0, 0.5),
    ("strain_stiffening", "b"): NOT_NEGATIVE,
    ("viscoelasticity", "g"): BELOW_ONE,
    ("viscoelasticity", "tau"): POSITIVE,
    ("plastic_set", "fraction"): BELOW_ONE,
    ("plastic_set", "threshold"): NOT_NEGATIVE,
    ("swelling", "offset"): Limits(-1.0),
    ("inclusion", "radius"): POSITIVE,
    ("inclusion", "ratio"): POSITIVE,
    ("skin", "thickness"): POSITIVE,
    ("skin", "ratio"): POSITIVE,
    ("base_slip", "stiffness"): NOT_NEGATIVE,
    ("base_debonding", "fraction"): BELOW_ONE,
    ("probe_friction", "mu"): NOT_NEGATIVE,
    ("probe_adhesion", "strength"): NOT_NEGATIVE,
    ("gravity_tilt", "angle_x"): ANGLE,
    ("gravity_tilt", "angle_y"): ANGLE,
    ("density", "ratio"): POSITIVE,
    ("scan_gravity", "fraction"): SHARE,
    ("stereo_scale", "scale"): POSITIVE,
    ("camera_motion", "onset"): NOT_NEGATIVE,
    ("refraction", "index"): Limits(1.0, 4.0, "both"),  # of any transparent body against air
    ("inertia", "rayleigh_beta"): NOT_NEGATIVE,
}


def nonsense(name: str, values: Mapping[str, Array]) -> str:
    """Return what is physically impossible about an effect's values, in words; empty where nothing is."""
    for parameter, value in values.items():
        limits = LIMITS.get((name, parameter), Limits(-INFINITE))
        if not limits.allow(np.atleast_1d(value)):
            return f"'{parameter}' of effect '{name}' is {np.asarray(value).tolist()}, and can only be {limits}"
    if name == "viscoelasticity" and {"g", "tau"} <= values.keys():
        g, tau = np.atleast_1d(values["g"]), np.atleast_1d(values["tau"])
        if len(g) != len(tau):
            return f"effect '{name}' has {len(g)} weights g and {len(tau)} times tau: each term has one of both"
        if g.sum() >= 1.0:
            return f"the weights g of effect '{name}' add up to {g.sum():g}, and must stay below 1"
    return ""


def drift_nonsense(name: str, values: Mapping[str, Array], seconds: float, height: float) -> str:
    """The same for what depends on a recording's length (s) and the body's height (m); empty where nothing is."""
    if name == "swelling":
        ratio = 1.0 + float(values["offset"]) + float(values["rate"]) * seconds
        if ratio <= 0.0:
            return f"the effect '{name}' shrinks the body to nothing within {seconds:.3g} s"
    if name == "stiffness_gradient" and abs(float(values["slope"])) * height / 2.0 >= 1.0:
        return f"'slope' of effect '{name}' makes the modulus negative within the body's height of {height:.3g} m"
    return ""
