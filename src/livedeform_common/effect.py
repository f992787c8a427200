"""What an effect declares of itself, and the registry that the packages fill with one row per effect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from livedeform_common.errors import InputError

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
    """An effect's identity card. ``equation`` and ``source`` are printed in reports and docs; ``shown_by`` says which
    recordings can show it; ``confused_with`` names the effects that it is easily taken for."""

    name: str
    acts_on: ActsOn
    summary: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    shown_by: str = ""
    confused_with: tuple[str, ...] = ()

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name; ``InputError`` if there is none."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        known = ", ".join(p.name for p in self.parameters)
        raise InputError(f"effect '{self.name}' has no parameter '{name}'", remedy=f"its parameters are {known}")


EFFECT_PARAMETERS: dict[str, tuple[str, ...]] = {
    "stiffness": ("ratio",),
    "poisson_ratio": ("value",),
    "strain_stiffening": ("b",),
    "viscoelasticity": ("g", "tau"),
    "plastic_set": ("fraction", "threshold"),
    "softening": ("rate",),
    "swelling": ("rate", "offset"),
    "inclusion": ("centre", "radius", "ratio"),
    "skin": ("thickness", "ratio"),
    "stiffness_gradient": ("slope",),
    "base_slip": ("stiffness",),
    "base_debonding": ("direction", "fraction"),
    "probe_friction": ("mu",),
    "probe_adhesion": ("strength",),
    "gravity_tilt": ("angle_x", "angle_y"),
    "density": ("ratio",),
    "scan_gravity": ("fraction",),
    "stereo_scale": ("scale",),
    "camera_motion": ("translation", "rotation", "onset"),
    "lens_distortion": ("k1",),
    "refraction": ("index",),
    "time_offset": ("seconds",),
    "probe_offset": ("translation",),
    "inertia": ("rayleigh_beta",),
}
"""The published names, which an experiment's ``effects`` are checked against; the registries above must agree."""
