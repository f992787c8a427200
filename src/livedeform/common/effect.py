"""What an effect declares of itself, and the registry that the packages fill with one row per effect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from livedeform.common.errors import InputError

ActsOn = Literal["body", "support", "load", "probe", "measuring"]


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect; ``size`` None is a scalar, an integer a vector's length, -1 a list of any length.

    ``neutral`` is the value at which the effect vanishes (None: this parameter alone cannot switch it off, as a
    position); ``start``, ``lower``, ``upper`` and the wide default prior ``sigma`` are in ``unit``.
    """

    name: str
    unit: str
    start: float | tuple[float, ...]
    lower: float
    upper: float
    sigma: float
    neutral: float | None = None
    size: int | None = None


@dataclass(frozen=True)
class EffectInfo:
    """An effect's identity card.

    ``equation`` and ``source`` are printed in reports and docs; ``shown_by`` says which recordings can show it;
    ``confused_with`` names the effects that it is easily taken for.
    """

    name: str
    acts_on: ActsOn
    summary: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    shown_by: str = ""
    confused_with: tuple[str, ...] = ()

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of that name; ``InputError`` if there is none."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        known = ", ".join(p.name for p in self.parameters)
        raise InputError(f"effect '{self.name}' has no parameter '{name}'", remedy=f"its parameters are {known}")


EFFECT_PARAMETERS: dict[str, dict[str, int | None]] = {
    "stiffness": {"ratio": None},
    "poisson_ratio": {"value": None},
    "strain_stiffening": {"b": None},
    "viscoelasticity": {"g": -1, "tau": -1},
    "plastic_set": {"fraction": None, "threshold": None},
    "softening": {"rate": None},
    "swelling": {"rate": None, "offset": None},
    "inclusion": {"centre": 3, "radius": None, "ratio": None},
    "skin": {"thickness": None, "ratio": None},
    "stiffness_gradient": {"slope": None},
    "base_slip": {"stiffness": None},
    "base_debonding": {"direction": None, "fraction": None},
    "probe_friction": {"mu": None},
    "probe_adhesion": {"strength": None},
    "gravity_tilt": {"angle_x": None, "angle_y": None},
    "density": {"ratio": None},
    "scan_gravity": {"fraction": None},
    "stereo_scale": {"scale": None},
    "camera_motion": {"translation": 3, "rotation": 3, "onset": None},
    "lens_distortion": {"k1": None},
    "refraction": {"index": None},
    "time_offset": {"seconds": None},
    "probe_offset": {"translation": 3},
    "inertia": {"rayleigh_beta": None},
}
"""The published names with their parameters' ``size`` (as in `Parameter`), which an experiment's ``effects`` are
checked against; the registries of the upper layers must agree."""
