"""The cards on which effects declare what they are, for the solver, the search and the docs, and the published names.

A new effect is one file in ``fem_node/effects`` (or ``stereo_node/effects``) with its card ``INFO``, one row in
`common.published_effects.PUBLISHED` and a test. Everything that the search must know of it stands on the card, so that
nothing in the closed loop asks for an effect's name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from livedeform.common.errors import InputError
from livedeform.common.published_effects import EFFECT_PARAMETERS
from livedeform.common.types import Array

__all__ = [
    "EFFECT_PARAMETERS",
    "STEP",
    "ActsOn",
    "EffectInfo",
    "Form",
    "Parameter",
    "Scale",
    "Start",
    "Starts",
    "Surroundings",
    "Together",
    "always",
    "effects_in",
    "is_filmed",
    "one_start",
    "significant",
]

ActsOn = Literal["body", "support", "load", "probe", "measuring"]
Scale = Literal["linear", "log", "inverse"]
MOST_DIGITS = 15  # of a number: a float has no more
STEP = 0.05  # of a coordinate's prior sigma: its step where the card gives none


@dataclass(frozen=True)
class Surroundings:
    """The means that an experiment and its recordings offer to show an effect.

    ``physics`` is the declared `fem_node.physics.record.Physics` (a higher layer's, hence untyped). ``lower``,
    ``upper`` (3,) m are the body's corners, ``markers`` (m, 3) m its markers at rest, some of them ``internal`` or not,
    and those on the support make a frame (``support_makes_a_frame``) if they leave no turn open. Cameras whose place is
    known are there if it ``has_cameras``; it is ``filmed`` if there are any. The recordings last ``duration`` s; the
    probe touched at ``contacts`` (c, 3) m and was accelerated by ``jolt`` m/s2 at most; ``moments`` (k,) s are the key
    moments after the drifts' clock's start. The body ``has_loads`` if something besides its weight loads it in some
    recording. ``bare``: the physics without the effects that the experiment has (None: it has none).
    """

    physics: Any
    lower: Array
    upper: Array
    markers: Array
    internal: bool
    duration: float
    has_probe: bool
    contacts: Array
    has_cameras: bool
    has_release: bool
    jolt: float = 0.0
    moments: tuple[float, ...] = ()
    filmed: bool = True
    has_loads: bool = False
    support_makes_a_frame: bool = False
    bare: Any = None

    @property
    def times(self) -> Array:
        """The key moments, or a tenth of the recording each where they are not known."""
        return np.unique(self.moments) if len(self.moments) > 1 else np.linspace(0.0, self.duration, 11)


Start = Mapping[str, float | Sequence[float]]  # by parameter, in its unit
Starts = Callable[[Surroundings], Sequence[Start]]
Alike = Callable[[Mapping[str, Mapping[str, Array]], float], dict[str, Mapping[str, Array]]]  # see `Form`


def always(around: Surroundings) -> bool:
    """Return True: the effect needs nothing that an experiment may lack."""
    return True


def is_filmed(around: Surroundings) -> bool:
    """Return whether cameras measure the markers."""
    return around.filmed


def is_let_go_loaded(around: Surroundings) -> bool:
    """Return whether a body that carries something is let go."""
    return around.has_release and around.has_loads


def one_start(around: Surroundings) -> list[Start]:
    """Return one start: the parameters' own."""
    return [{}]


@dataclass(frozen=True)
class Usual:
    """A prior of an effect that is there: a number ``of`` a parameter's value is about ``centre``, and its logarithm
    normal with ``sigma``."""

    of: Callable[[float], float]
    centre: float
    sigma: float


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect; ``size`` None is a scalar, an integer a vector's length, -1 a list of any length.

    ``neutral`` is the value at which the effect vanishes, of each number or of all (None: this parameter alone cannot
    switch it off, as a position); ``start``, ``lower``, ``upper`` are in ``unit``. The rest is for the search, which
    fits a coordinate z of each number: the number itself, its logarithm or its inverse (``scale``), counted from the
    neutral one. In units of z: ``sigma`` of the wide default prior; ``step``, small but well above the solver's
    tolerance (None: a share of sigma); ``kick``, where the model changes its kind at the neutral value (a bond becomes
    a spring, a contact begins to slide), so that columns are taken there and fits begin no nearer than half of it, and
    the power by which what it does ``grows`` up to there.
    ``known_to``: one sigma in ``unit`` to which the neutral value is never known better in any experiment.
    ``stated_by``: the experiment's key whose ``_sigma`` is this parameter's; one whose neutral value is 1 is relative
    to the key's value.
    ``placed_by_elements``: the components whose place is only as good as the elements are small. ``wrong_by_elements``:
    the share of the size that elements get wrong, where that is more than usual.
    ``in_body``: a place between the body's corners, whatever the bounds. ``between_moments``: nothing changes with it
    between two key moments. ``usual``: its prior in a fit, if that is another one than of ``sigma`` about neutral.
    """

    name: str
    unit: str
    start: float | tuple[float, ...]
    lower: float
    upper: float
    sigma: float
    neutral: float | tuple[float, ...] | None = None
    size: int | None = None
    scale: Scale = "linear"
    step: float | None = None
    kick: float | Callable[[Surroundings], float] = 0.0
    grows: float = 1.0
    known_to: float = 0.0
    stated_by: str = ""
    placed_by_elements: tuple[int, ...] = ()
    wrong_by_elements: float | None = None
    in_body: bool = False
    between_moments: bool = False
    usual: Usual | None = None


@dataclass(frozen=True)
class Form:
    """Another way to number an effect, for the search: ``expand`` makes the effect's parameters of the ``parameters``
    that are fitted instead, which begin at ``starts``.

    ``alike``: of the effects in a model of a body that swings, by name, and the swing's rate in rad/s, the values by
    effect and parameter (the form's own for itself) at which the body swings as it does; what it names that is not in
    the model has to be fitted with it. ``released``: likewise the values of all that a body which was let go shows
    together, and where they begin (nothing: where the card says); without the ``spare`` effects, the last first, where
    they would be too many.
    """

    name: str
    parameters: tuple[Parameter, ...]
    expand: Callable[[Mapping[str, Array]], dict[str, Array]]
    starts: Starts = one_start
    alike: Alike | None = None
    released: Alike | None = None
    spare: tuple[str, ...] = ()


@dataclass(frozen=True)
class Together:
    """A number that a length and the amplitude of an effect make together, which recordings tell better than each of
    them: its ``name``, its ``unit``, and what it is ``of`` the values (of any shape), by parameter. It rises with the
    amplitude."""

    name: str
    unit: str
    of: Callable[[Mapping[str, Array]], Array]


@dataclass(frozen=True)
class EffectInfo:
    """An effect's card.

    ``equation`` and ``source`` are printed in reports and docs; ``shown_by`` says which recordings can show it;
    ``confused_with`` names the effects that it is easily taken for.

    The rest is for the search. ``possible``: whether an experiment can have it (the probe's and the cameras' own need
    these anyway). ``starts``: values of the parameters that switch nothing off, to be tried before any is refined.
    ``tangent``: the derivative at zero says how large it is. ``switched``: it is on or off, and its column at zero is a
    run of its own. ``rubs``: it makes the probe rub on the surface or stick to it. ``model_error``: the share of what
    it does that its law leaves out, where that is more than usual. ``like_mesh``: coarse elements under the probe look
    like it, in each press anew. ``told_apart_by``: by another effect's name, what besides a motion of the probe tells
    the two apart. ``order``: in which measuring effects act on the way from the true point to the reported one,
    and mechanical ones on the physics (those of one number as they are listed: it makes no difference).
    ``rings``: the body swings with it, so that fits begin roughly. ``forms``: other ways to number it, from few to
    many, of which the data choose once it is in the model. ``together``: what its values make together.
    ``proved``: of how many blind values the stated 95 % interval held the truth, and of how many there were
    (``python -m benchmarks.coverage table --half proof``; none: it was not measured). ``optional``: parameters that an
    experiment need not give, that only a form has, and that act only where a body is let go. ``once``: it happens at
    one moment, and cameras that are registered later do not know of it.
    """

    name: str
    acts_on: ActsOn
    summary: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    shown_by: str = ""
    confused_with: tuple[str, ...] = ()
    possible: Callable[[Surroundings], bool] = always
    starts: Starts = one_start
    tangent: bool = True
    switched: bool = False
    rubs: bool = False
    model_error: float | None = None
    like_mesh: bool = False
    told_apart_by: Mapping[str, str] = field(default_factory=dict)
    order: int = 0
    rings: bool = False
    forms: tuple[Form, ...] = ()
    together: Together | None = None
    proved: tuple[int, int] = (0, 0)
    optional: tuple[Parameter, ...] = ()
    once: bool = False

    @property
    def lasts(self) -> bool:
        """Tell whether it is there in every recording with the same probe and support, whether it shows or not."""
        return self.acts_on in ("probe", "support")

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of that name; ``InputError`` if there is none."""
        for parameter in (*self.parameters, *self.optional):
            if parameter.name == name:
                return parameter
        known = ", ".join(p.name for p in (*self.parameters, *self.optional))
        raise InputError(f"effect '{self.name}' has no parameter '{name}'", remedy=f"its parameters are {known}")

    def in_words(self, name: str, value: ArrayLike, sigma: ArrayLike | None = None) -> str:
        """Return the value of a parameter, a number or a list, as text, with one sigma where it has one, and its
        unit."""
        values = np.asarray(value, float)
        sigmas = np.broadcast_to(np.nan if sigma is None else np.asarray(sigma, float), values.shape)
        pairs = zip(values.ravel(), sigmas.ravel(), strict=True)
        parts = [
            f"{v:.{significant(abs(v), s, 4)}g} ± {s:.2g}" if np.isfinite(s) and s > 0.0 else f"{v:.4g}"
            for v, s in pairs
        ]
        unit = self.parameter(name).unit
        text = parts[0] if values.ndim == 0 else "(" + ", ".join(parts) + ")"
        return text if unit in ("", "-", "1") else f"{text} {unit}"


def significant(size: float, width: float, least: int) -> int:
    """Return how many significant digits numbers up to ``size`` need, so that what is ``width`` has two of them."""
    if not 0.0 < width < np.inf or not 0.0 < size < np.inf:
        return least
    return int(np.clip(2 + np.ceil(np.log10(size / width)), least, MOST_DIGITS))


def effects_in(package: str, path: Iterable[str]) -> dict[str, ModuleType]:
    """Import the modules of a folder (``__name__`` and ``__path__`` of its package) that have a card, by name."""
    modules = [import_module(f"{package}.{module.name}") for module in iter_modules(path)]
    cards = [module for module in modules if hasattr(module, "INFO")]
    return {module.INFO.name: module for module in sorted(cards, key=lambda m: (m.INFO.order, m.INFO.name))}
