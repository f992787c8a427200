"""The published effects: names, parameters, and the values that are physically possible at all.

An experiment is checked against `PUBLISHED` as it is read, before anything of the solver is imported, and so are the
values that reach the solver from elsewhere. The bounds within which a fit looks are narrower, and stand on the effects'
cards (`common.effect`). A new effect is one row here, besides its file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array, EffectValues

__all__ = [
    "EFFECT_PARAMETERS",
    "KEEP_ONE",
    "OPTIONAL_PARAMETERS",
    "PUBLISHED",
    "Limits",
    "Published",
    "Value",
    "doubled",
    "impossible",
    "is_last",
    "refuse_doubled",
    "with_others",
]

INFINITE = float("inf")
KEEP_ONE = "keep one, with all that it is to say (viscoelasticity takes several terms)"


@dataclass(frozen=True)
class Limits:
    """The interval from ``lower`` to ``upper``; ``closed`` says which ends belong to it: "lower", "upper" or "both"."""

    lower: float = -INFINITE
    upper: float = INFINITE
    closed: str = ""

    def allow(self, values: Array) -> bool:
        """Return whether every one of the values is finite and in the interval."""
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


ANY, POSITIVE, NOT_NEGATIVE = Limits(), Limits(0.0), Limits(0.0, closed="lower")
SHARE, BELOW_ONE = Limits(0.0, 1.0, "both"), Limits(0.0, 1.0, "lower")
ANGLE = Limits(-np.pi, np.pi, "both")


@dataclass(frozen=True)
class Value:
    """The values that a parameter can have; ``size`` as in `common.effect.Parameter`.

    ``off``: a value beyond the limits that only means that the effect is absent. No file can hold an infinite one.
    """

    limits: Limits = ANY
    size: int | None = None
    off: float | None = None


Rule = Callable[[Mapping[str, Array], float, float], str]
"""Says what is wrong with an effect's values together, so many s after the start of the drifts' clock and in a body so
many m high (0 where not known); "" if nothing."""


def _no_rule(values: Mapping[str, Array], seconds: float, height: float) -> str:
    return ""


@dataclass(frozen=True)
class Published:
    """An effect as users name it: its parameters, those that need not be given (``optional``), and a ``rule`` for what
    their limits alone do not tell. ``several``: a body may have several, each in a region of its own.
    ``goes_with``: the part of an experiment that it belongs to, and stays with where others change."""

    parameters: Mapping[str, Value]
    rule: Rule = _no_rule
    optional: Mapping[str, Value] = field(default_factory=dict)
    several: bool = False
    goes_with: Literal["phantom", "probe", "stereo"] = "phantom"


def _relaxation(values: Mapping[str, Array], seconds: float, height: float) -> str:
    g, tau = np.atleast_1d(values["g"]), np.atleast_1d(values["tau"])
    if len(g) != len(tau):
        return f"effect 'viscoelasticity' has {len(g)} weights g and {len(tau)} times tau: each term has one of both"
    if g.sum() >= 1.0:
        return f"the weights g of effect 'viscoelasticity' add up to {g.sum():g}, and must stay below 1"
    return ""


def _volume(values: Mapping[str, Array], seconds: float, height: float) -> str:
    if 1.0 + float(values["offset"]) + float(values["rate"]) * seconds > 0.0:
        return ""
    when = f"{abs(seconds):.3g} s {'after' if seconds >= 0.0 else 'before'} the drifts' clock starts"
    return f"the effect 'swelling' leaves nothing of the body {when}"


def _modulus_by_height(values: Mapping[str, Array], seconds: float, height: float) -> str:
    if abs(float(values["slope"])) * height / 2.0 < 1.0:
        return ""
    return (
        f"'slope' of effect 'stiffness_gradient' makes the modulus negative within the body's height of {height:.3g} m"
    )


PUBLISHED: Mapping[str, Published] = {
    "stiffness": Published({"ratio": Value(POSITIVE)}),
    "poisson_ratio": Published({"value": Value(Limits(-1.0, 0.5))}),
    "strain_stiffening": Published({"b": Value(NOT_NEGATIVE)}),
    "viscoelasticity": Published(
        {"g": Value(BELOW_ONE, -1), "tau": Value(POSITIVE, -1)}, _relaxation, {"held": Value(NOT_NEGATIVE)}
    ),
    "plastic_set": Published({"fraction": Value(BELOW_ONE), "threshold": Value(NOT_NEGATIVE)}),
    "softening": Published({"rate": Value()}),
    "swelling": Published({"rate": Value(), "offset": Value(Limits(-1.0))}, _volume),
    "thermal_expansion": Published({"alpha": Value()}),
    "inclusion": Published(
        {"centre": Value(size=3), "radius": Value(POSITIVE), "ratio": Value(POSITIVE)}, several=True
    ),
    "skin": Published({"thickness": Value(POSITIVE), "ratio": Value(POSITIVE)}, several=True),
    "stiffness_gradient": Published({"slope": Value()}, _modulus_by_height),
    "base_slip": Published({"stiffness": Value(NOT_NEGATIVE, off=INFINITE)}),
    "base_debonding": Published({"direction": Value(), "fraction": Value(BELOW_ONE)}),
    "probe_friction": Published({"mu": Value(NOT_NEGATIVE)}, goes_with="probe"),
    "probe_adhesion": Published({"strength": Value(NOT_NEGATIVE)}, goes_with="probe"),
    "gravity_tilt": Published({"angle_x": Value(ANGLE), "angle_y": Value(ANGLE)}),
    "density": Published({"ratio": Value(POSITIVE)}),
    "scan_gravity": Published({"fraction": Value(SHARE)}),
    "late_load": Published({"delay": Value(NOT_NEGATIVE)}),
    "load_friction": Published({"ratio": Value(NOT_NEGATIVE), "give": Value(POSITIVE)}),
    "stereo_scale": Published({"scale": Value(POSITIVE)}, goes_with="stereo"),
    "camera_motion": Published(
        {"translation": Value(size=3), "rotation": Value(size=3), "onset": Value(NOT_NEGATIVE)}, goes_with="stereo"
    ),
    "lens_distortion": Published({"k1": Value()}, goes_with="stereo"),
    "refraction": Published(  # of any transparent body against air
        {"index": Value(Limits(1.0, 4.0, "both"))}, goes_with="stereo"
    ),
    "time_offset": Published({"seconds": Value()}, goes_with="probe"),
    "probe_offset": Published({"translation": Value(size=3)}, goes_with="probe"),
    "reference_pose": Published({"translation": Value(size=3), "rotation": Value(size=3)}, goes_with="stereo"),
    "inertia": Published({"rayleigh_beta": Value(NOT_NEGATIVE)}),
}

EFFECT_PARAMETERS: dict[str, dict[str, int | None]] = {
    name: {parameter: value.size for parameter, value in effect.parameters.items()}
    for name, effect in PUBLISHED.items()
}
"""The published names with their parameters' ``size``, which an experiment's ``effects`` are checked against; the
registries of the upper layers must agree."""

OPTIONAL_PARAMETERS: dict[str, dict[str, int | None]] = {
    name: {parameter: value.size for parameter, value in effect.optional.items()}
    for name, effect in PUBLISHED.items()
    if effect.optional
}
"""The same of the parameters that need not be given, and act only where a body is let go."""


def doubled(effects: Iterable[EffectValues]) -> str:
    """Say which effect is listed more than once and can only be there once, as its values are of the whole body, rig or
    probe; "" if none is."""
    count = Counter(effect.name for effect in effects)
    may = {name for name, effect in PUBLISHED.items() if effect.several}
    twice = [name for name, n in count.items() if n > 1 and name not in may]
    return f"effect '{twice[0]}' is listed {count[twice[0]]} times, and can be there only once" if twice else ""


def refuse_doubled(effects: Iterable[EffectValues]) -> None:
    """Raise ``InputError`` for effects of which one is `doubled`, wherever they come from."""
    if wrong := doubled(effects):
        raise InputError(wrong, where="effects", remedy=KEEP_ONE)


def is_last(name: str, parameter: str, value: float) -> bool:
    """Return whether a value of an effect's parameter is the last that is physically possible on its side; not so of
    one that is not published, as a form's own."""
    known = PUBLISHED[name].parameters.get(parameter)
    return known is not None and value in (known.limits.lower, known.limits.upper)


def with_others(declared: Sequence[EffectValues], others: Sequence[EffectValues]) -> list[EffectValues]:
    """Return the ``declared`` effects with ``others``, each of which takes the place of any of its name."""
    new = {effect.name for effect in others}
    return [*(effect for effect in declared if effect.name not in new), *others]


def impossible(name: str, values: Mapping[str, Array], seconds: float = 0.0, height: float = 0.0) -> str:
    """Say what is physically impossible about an effect's values; "" if nothing, or if it is no published effect.

    ``seconds`` s is a time on the drifts' clock and ``height`` m that of the body, 0 where they are not known.
    """
    if name not in PUBLISHED:
        return ""
    effect = PUBLISHED[name]
    for parameter, value in values.items():
        known = effect.parameters.get(parameter, effect.optional.get(parameter, Value()))
        if not known.limits.allow(np.atleast_1d(value)) and not np.all(value == known.off):
            return f"'{parameter}' of effect '{name}' is {np.asarray(value).tolist()}, and can only be {known.limits}"
    return effect.rule(values, seconds, height)
