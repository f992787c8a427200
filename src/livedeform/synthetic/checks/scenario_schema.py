"""The schema of a scenario: every key and value that has no sense is one line, with the place and the remedy.

A scenario is checked as it is given, and used as it is given: nothing here changes a value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from livedeform.common.errors import InputError
from livedeform.common.experiment.mistakes import first_mistake, in_words
from livedeform.common.experiment.schema import (
    Effects,
    Length,
    Material,
    NonNegative,
    Number,
    Positive,
    Probe,
    Vector,
    check_curve,
    did_you_mean,
    not_bool,
    problem,
)
from livedeform.common.frames import MAKE_A_FRAME
from livedeform.synthetic.checks.effect_values import check_effects
from livedeform.synthetic.solved_motion import truth_probe
from livedeform.synthetic.trajectory import CLEARANCE
from livedeform.synthetic.true_effects import known_effect

MOST_HZ = 10_000.0
LONGEST_STEP = 0.1  # m of the path between solved states
LONGEST_NAME = 200  # bytes of a name of a recording, which is that of a folder
NOT_IN_NAMES = re.compile(r'[/\\:*?"<>|\x00-\x1f]')
RIGHT_ANGLE = 90.0


def _whole(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise problem(f"{value!r} is not a whole number", "write a whole number")
    return value


def _plain_name(name: str) -> str:
    if not name or name.startswith(".") or len(name.encode()) > LONGEST_NAME or NOT_IN_NAMES.search(name):
        raise problem(f"'{name}' is no name for a recording", "give a plain name of a folder, as a or take-01")
    return name


def _or_none(value: Any) -> Any:
    return None if value is False else value


Count = Annotated[int, BeforeValidator(_whole), Field(ge=1, le=10_000)]
Few = Annotated[int, BeforeValidator(not_bool), Field(ge=0)]
Share = Annotated[Number, Field(ge=0.0, lt=1.0)]
Rate = Annotated[Positive, Field(le=MOST_HZ)]
Place = tuple[Number, Number]
Angle = Annotated[Number, Field(gt=-np.pi / 2, lt=np.pi / 2)]
Name = Annotated[str, Field(min_length=1)]
RecordingName = Annotated[str, AfterValidator(_plain_name)]


class Part(BaseModel):
    """Base of every mapping in a scenario: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)  # arrays of effects

    @model_validator(mode="before")
    @classmethod
    def _know(cls, data: Any) -> Any:
        for key in data if isinstance(data, Mapping) else ():
            if key not in cls.model_fields:
                raise problem(f"unknown key '{key}'", did_you_mean(str(key), list(cls.model_fields)))
        return data


class BallWithin(Part):
    centre: Vector
    radius: Length


class Block(Part):
    shape: Literal["block"]
    size: tuple[Length, Length, Length]
    elements: tuple[Count, Count, Count]
    focus: Positive = 1.0
    ball: BallWithin | None = None


class HemiEllipsoid(Part):
    shape: Literal["hemi_ellipsoid"]
    semi_axes: tuple[Length, Length, Length]
    elements: tuple[Count, Count]
    focus: Positive = 1.0


class BentSlab(Part):
    shape: Literal["bent_slab"]
    size: tuple[Length, Length, Length]
    elements: tuple[Count, Count, Count]
    radius: Length
    focus: Positive = 1.0


class Sigmas(Part):
    """One-sigma uncertainties of what is declared, in its units."""

    youngs_modulus: Positive = 1.0
    poisson_ratio: Positive = 1.0
    density: Positive = 1.0
    gravity: Positive = 1.0


class Declared(Part):
    youngs_modulus: Number
    poisson_ratio: Number
    density: Positive
    configuration: Literal["unloaded", "loaded"]
    element_size: Length
    ship_mesh: Annotated[bool, Field(strict=True)]
    sigmas: Sigmas
    effects: Effects


class OneProbe(Part):
    """A kind with its sizes, of which `truth_probe` knows more."""

    shape: dict[str, Number | tuple[Number, ...]]
    edge_radius: Number
    friction: Number


class HowMany(Part):
    surface: Few
    internal: Few
    support: Annotated[Few, Field(le=4)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.surface + self.support < MAKE_A_FRAME:
            what = f"{self.surface + self.support} markers on the surface and the support are too few"
            raise problem(what, "cameras are registered by three or more: ask for more of them")
        return self


class OneLesion(Part):
    name: Name
    centre: Vector
    diameter: Length


class HowWarm(Part):
    time: tuple[Number, ...]
    value: tuple[Number, ...]
    reference: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_curve(self.time, self.value, self.reference)
        return self


class HowMeasured(Part):
    kind: Literal["markers", "pictures"]
    rate: Rate
    noise_px: NonNegative
    dropout: Share
    jitter: Annotated[Number, Field(ge=0.0, le=1.0)]


class CameraPair(Part):
    distance: Length | None = None
    elevation_deg: Annotated[Number, Field(gt=-RIGHT_ANGLE, lt=RIGHT_ANGLE)] | None = None
    baseline: Length | None = None
    f: Positive | None = None
    size: tuple[Count, Count] | None = None
    k: Place | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key in self.model_fields_set:
            if getattr(self, key) is None:
                raise problem(f"'{key}' is empty", "give it a value, or leave it out")
        return self


class WrenchNoise(Part):
    noise: NonNegative


class Painted(Part):
    """The fields of `render.Paint`."""

    body: Number = 0.0
    marker: Number = 0.0
    probe: Number = 0.0
    background: Number = 0.0
    radius: Length = 1.0
    texture: Number = 0.0
    blur_px: Positive = 1.0
    noise: NonNegative = 0.0


class OnePress(Part):
    """The fields of `trajectory.Press`."""

    at: Place
    depth: Annotated[Number, Field(gt=-CLEARANCE, le=3.0)]
    hold: NonNegative = 1.0
    stroke: Place = (0.0, 0.0)
    speed: Positive = 1.0
    retreat_speed: Positive = 1.0
    tilt: tuple[Angle, Angle] = (0.0, 0.0)
    pause: NonNegative = 1.0


class Scenario(Part):
    """A scenario with its defaults filled in."""

    version: Annotated[Literal[1], BeforeValidator(not_bool)]
    name: Name
    body: Annotated[Block | HemiEllipsoid | BentSlab, Field(discriminator="shape")]
    declared: Declared
    probe: OneProbe
    markers: HowMany
    lesions: tuple[OneLesion, ...]
    temperature: HowWarm | None
    measuring: HowMeasured
    rig: CameraPair
    pose_rate: Rate
    wrench: Annotated[WrenchNoise | None, BeforeValidator(_or_none)]
    gap: NonNegative
    path_step: Annotated[Length, Field(le=LONGEST_STEP)]
    time_step: Positive
    truth: tuple[dict[str, Any], ...]
    paint: Painted
    threshold: Length
    recordings: dict[RecordingName, Annotated[tuple[OnePress, ...], Field(min_length=1)]]


def check_scenario(spec: Mapping[str, Any], source: str) -> None:
    """Raise ``InputError`` at the first key or value of a whole scenario, read from ``source``, that has no sense."""
    _validated(Scenario, spec, source, "")
    for i, effect in enumerate(spec["truth"]):
        if not isinstance(effect.get("name"), str):
            raise InputError("an effect has a name", where=f"{source}: truth.{i}", remedy="write name: stiffness, ...")
        known_effect(effect["name"])
    check_effects(spec["truth"])
    declared, probe = spec["declared"], spec["probe"]
    material = {key: declared[key] for key in ("youngs_modulus", "poisson_ratio")}
    _validated(Material, {"model": "neo_hookean", **material}, source, "declared")
    truth_probe(probe["shape"], float(probe["edge_radius"]))
    if "sphere" not in probe["shape"]:
        rounded = {"shape": probe["shape"], "edge_radius": probe["edge_radius"]}
        _validated(Probe, rounded, source, "probe")
    _validated(Probe, {"shape": probe["shape"], "contact": {"friction": probe["friction"]}}, source, "probe")


def _validated(model: type[BaseModel], values: Mapping[str, Any], source: str, under: str) -> None:
    try:
        model.model_validate(values)
    except ValidationError as error:
        raise _explained(error, values, source, under) from error


def _explained(error: ValidationError, values: Mapping[str, Any], source: str, under: str) -> InputError:
    """Return the first mistake as one line."""
    first = first_mistake(error)
    keys = [*([under] if under else []), *_place(values, first["loc"])]
    what, remedy = in_words(first, "add it")
    return InputError(what, where=f"{source}: {'.'.join(keys)}".removesuffix(": "), remedy=remedy)


def _place(values: Any, loc: Sequence[int | str]) -> list[str]:
    """Return the keys of ``loc`` that are in the scenario: pydantic's has names of alternatives as well."""
    keys: list[str] = []
    for part in loc:
        if isinstance(values, Mapping) and part in values:
            values = values[part]
        elif isinstance(values, Sequence) and not isinstance(values, str) and isinstance(part, int):
            values = values[part] if part < len(values) else None
        else:
            continue
        keys.append(str(part))
    return keys
