"""The schema of ``experiment.yaml``: frozen objects, and one clear sentence for every mistake in a value.

The models have the file's keys as attributes; lengths are in metres, whatever the unit of the surface file. Any
physical quantity may have a companion ``<key>_sigma`` (one standard deviation), read through ``Experiment.sigma``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    PlainSerializer,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from livedeform.common.experiment.constants import nonsense_of
from livedeform.common.published_effects import EFFECT_PARAMETERS, KEEP_ONE, OPTIONAL_PARAMETERS, doubled, impossible
from livedeform.common.types import Array, EffectValues, Ids

SIGMA = "_sigma"
USED_SIGMAS = (  # what a diagnosis takes as priors, and for how well a release is known
    "phantom.density", "phantom.material.youngs_modulus", "phantom.material.poisson_ratio", "timeline.release",
)  # fmt: skip
SETTINGS = ("version", "clock_start_ns", "element_size", "error")  # numbers that nobody measures
FLOAT_MAX = float(np.finfo(float).max)
ABSOLUTE_ZERO, MOST_APART = -273.15, 200.0  # degrees; Celsius and kelvin beside each other are 273 apart
LONGEST_STAMP = 30  # digits; no float holds those of a stamp in nanoseconds
NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
DEFAULT_GRAVITY = (0.0, 0.0, -9.81)


def problem(what: str, remedy: str) -> PydanticCustomError:
    """A mistake in the file, with its remedy; pydantic adds where."""
    return PydanticCustomError("livedeform", "{what}", {"what": what, "remedy": remedy})


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """The remedy for an unknown name."""
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"


# --- the kinds of values ---------------------------------------------------------------------------------------------


def not_bool(value: Any) -> Any:
    """Return a value; a mistake if it is true or false, which Python takes for 1 and 0."""
    if isinstance(value, bool):
        raise problem(f"'{str(value).lower()}' is not a number", "write a number")
    return value


def _file(value: Any, info: ValidationInfo) -> Any:
    folder = (info.context or {}).get("folder", Path())
    if not isinstance(value, str | Path):
        return value
    path = (folder / Path(value).expanduser()).resolve()
    if not path.is_file():
        here = sorted(p.name for p in path.parent.iterdir() if p.is_file()) if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, here, n=1)
        hint = f"did you mean '{near[0]}'?" if near else "paths are relative to the folder of the experiment file"
        raise problem(f"the file {path} does not exist", hint)
    return path


def _between(lower: float, upper: float, remedy: str) -> AfterValidator:
    """A plausibility check whose point is a unit mistaken by a factor of 1000."""

    def check(value: float) -> float:
        if not lower <= value <= upper:
            raise problem(f"{value:g} is not plausible (between {lower:g} and {upper:g})", remedy)
        return value

    return AfterValidator(check)


def _gravity(value: tuple[float, float, float]) -> tuple[float, float, float]:
    size = float(np.linalg.norm(value))
    if size > 100.0:
        raise problem(f"a gravity of {size:g} m/s2 is not plausible", "give it in m/s2, on earth about 9.81")
    return value


def _near(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if float(np.linalg.norm(value)) > 20.0:
        raise problem(f"{np.linalg.norm(value):g} m away is not plausible", "give the place in metres")
    return value


def _unit_quaternion(value: tuple[float, ...]) -> tuple[float, ...]:
    if abs(float(np.linalg.norm(value)) - 1.0) > 1e-3:
        raise problem(f"the quaternion's norm is {np.linalg.norm(value):.4g}, not 1", "order x, y, z, w, norm 1")
    return value


def as_number(value: Any) -> Any:
    """Return the numbers that a text or a list of texts stands for, others as they are: 4e3 is a text in YAML 1.1."""
    if isinstance(value, list | tuple):
        return [as_number(item) for item in value]
    if not isinstance(value, str) or not re.fullmatch(NUMBER, value):
        return value
    whole = value.lstrip("+-").isdigit() and len(value) < LONGEST_STAMP
    return int(value) if whole else float(value)


Number = Annotated[float, BeforeValidator(not_bool), AllowInfNan(False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Length = Annotated[Positive, _between(1e-6, 3.0, "lengths are in metres: 6 mm is 0.006")]
Vector = tuple[Number, Number, Number]
Gravity = Annotated[Vector, AfterValidator(_gravity)]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_unit_quaternion)]
File = Annotated[Path, BeforeValidator(_file), PlainSerializer(str), WithJsonSchema({"type": "string"})]


class Section(BaseModel):
    """Base of every mapping in the file: unknown keys are refused, ``<key>_sigma`` companions are kept apart."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True, use_attribute_docstrings=True)
    _sigmas: dict[str, float] = PrivateAttr(default_factory=dict)

    @model_validator(mode="wrap")
    @classmethod
    def _read(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, Mapping):
            return handler(data)
        values = {key: as_number(value) if cls._is_of_numbers(key) else value for key, value in data.items()}
        sigmas = {}
        for key in [k for k in values if isinstance(k, str) and k.endswith(SIGMA)]:
            quantity = key.removesuffix(SIGMA)
            if quantity in cls._quantities(values) or (quantity in values and cls._is_wrong_number(quantity, values)):
                sigmas[quantity] = _read_sigma(key, values.pop(key))
            elif quantity in values and quantity in cls.model_fields:
                remedy = f"leave it out; a diagnosis uses those of {', '.join(USED_SIGMAS)}"
                raise problem(f"'{quantity}' is no physical quantity, and has no standard deviation", remedy)
        known = cls._known(values)
        for key in values:
            if known is not None and key not in known:
                raise problem(f"unknown key '{key}'{cls._whose(values)}", did_you_mean(str(key), known))
        section = handler(values)
        section._sigmas.update(sigmas)
        return section

    @classmethod
    def _is_of_numbers(cls, key: Any) -> bool:
        """Return whether a key holds numbers: a field that does, a companion, or a setting of its own."""
        return key not in cls.model_fields or "float" in str(cls.model_fields[key].annotation)

    @classmethod
    def _is_wrong_number(cls, key: str, values: Mapping[str, Any]) -> bool:
        """Return whether a field of numbers has something else, of which it will tell."""
        return key in cls.model_fields and cls._is_of_numbers(key) and isinstance(values[key], str | bool)

    @classmethod
    def _keys(cls) -> list[str]:
        return list(cls.model_fields)

    @classmethod
    def _known(cls, values: Mapping[str, Any]) -> list[str] | None:
        """The keys that these values may have; None where they are checked elsewhere."""
        return cls._keys() if cls.model_config.get("extra") == "forbid" else None

    @classmethod
    def _whose(cls, values: Mapping[str, Any]) -> str:
        """Say whose keys they are, where that is not the section."""
        return ""

    @classmethod
    def _quantities(cls, values: Mapping[str, Any]) -> list[str]:
        """The keys that may have a ``_sigma`` companion."""
        return [k for k, v in values.items() if k not in SETTINGS and _is_quantity(v)]

    @model_serializer(mode="wrap")
    def _write(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in handler(self).items():
            if value is None or value == []:
                continue
            out[key] = value
            if key in self._sigmas:
                out[key + SIGMA] = self._sigmas[key]
        return out

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler.resolve_ref_schema(handler(core_schema))
        for key, entry in list(schema.get("properties", {}).items()):
            if "number" in str(entry) and key not in SETTINGS:
                schema["properties"][key + SIGMA] = {
                    "type": "number",
                    "exclusiveMinimum": 0,
                    "description": f"one standard deviation of {key}",
                }
        return schema


AnySection = TypeVar("AnySection", bound=Section)


def _is_quantity(value: Any) -> bool:
    """A number or numbers in lists, which may be wrong; what has keys of its own, a name or nothing is none."""
    if isinstance(value, list | tuple):
        return bool(value) and all(_is_quantity(item) for item in value)
    return not isinstance(value, str | bool | Mapping | BaseModel)


def _read_sigma(key: str, value: Any) -> float:
    if not _is_number(value) or value <= 0:
        raise problem(f"'{key}' is {value!r}, not a positive number", "give one standard deviation in the key's unit")
    return float(value)


# --- regions ---------------------------------------------------------------------------------------------------------


def _only(section: Section, what: str) -> str:
    """The one key that is given, of a section whose keys exclude each other."""
    given = [key for key in type(section).model_fields if getattr(section, key) is not None]
    if len(given) != 1:
        found = " and ".join(given) if given else "nothing"
        raise problem(f"{what} is given by one key, but here is {found}", f"use one of {', '.join(section._keys())}")
    return given[0]


class Sphere(Section):
    centre: Vector
    """Its middle, m."""
    radius: Length
    """Its radius, m."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius)


class Plane(Section):
    point: Vector
    """Any point of the plane, m."""
    normal: Vector
    """A vector across the plane, of any length."""
    tolerance: Length
    """How far from the plane a point may lie, m."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.linalg.norm(self.normal) == 0:
            raise problem("the normal is zero", "give a vector that points out of the plane")
        return self

    def height(self, points: Array) -> Array:
        """Signed distance (n,) m from the plane."""
        normal = np.array(self.normal) / np.linalg.norm(self.normal)
        return np.asarray((points - np.array(self.point)) @ normal)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        return np.abs(self.height(points)) <= self.tolerance


class Region(Section):
    """A part of space in the surface file's configuration, in metres; exactly one key is given."""

    below_z: Number | None = None
    """Everything up to this height, m."""
    above_z: Number | None = None
    """Everything from this height on, m."""
    box: tuple[Vector, Vector] | None = None
    """Everything between two corners [[x0, y0, z0], [x1, y1, z1]], m."""
    sphere: Sphere | None = None
    """Everything inside a sphere."""
    plane: Plane | None = None
    """Everything near a plane."""

    @property
    def kind(self) -> str:
        return _only(self, "a region")

    @model_validator(mode="after")
    def _check(self) -> Self:
        _only(self, "a region")
        if self.box is not None and not np.all(np.less(self.box[0], self.box[1])):
            raise problem("the box's first corner is not below its second", "write [[x0, y0, z0], [x1, y1, z1]]")
        return self

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which of ``points`` (n, 3) m lie in the region (n,); borders belong to it."""
        if self.below_z is not None:
            return points[:, 2] <= self.below_z
        if self.above_z is not None:
            return points[:, 2] >= self.above_z
        if self.box is not None:
            lower, upper = np.array(self.box)
            return np.asarray(np.all((points >= lower) & (points <= upper), axis=1))
        if self.sphere is not None:
            return self.sphere.contains(points)
        assert self.plane is not None  # _check
        return self.plane.contains(points)


# --- the phantom -----------------------------------------------------------------------------------------------------

MATERIALS = {  # the published models, and the constants that each takes besides the two of small strain
    "linear": (),
    "saint_venant_kirchhoff": (),
    "corotational": (),
    "neo_hookean": (),
    "neo_hookean_log": (),
    "mooney_rivlin": ("ratio", "c10", "c01"),
    "yeoh": ("c1", "c2", "c3", "c2_ratio", "c3_ratio"),
    "exponential": ("b",),
    "ogden": ("mu", "alpha"),
}
TOGETHER = (("c10", "c01"),)  # constants that mean nothing alone


class Material(Section):
    """``model`` and the two small-strain constants; further constants of a model are extra keys (``parameters``)."""

    model_config = ConfigDict(extra="allow")
    model: str
    """The law: linear, saint_venant_kirchhoff, corotational, neo_hookean, neo_hookean_log, mooney_rivlin, yeoh,
    exponential or ogden; docs/items.md has their formulas and constants."""
    youngs_modulus: Annotated[Positive, _between(10.0, 1e12, "moduli are in pascals: 4 kPa is 4000")]
    """Young's modulus at small strain, Pa: 4 kPa is 4000."""
    poisson_ratio: NonNegative
    """Poisson's ratio at small strain, below 0.5: 0.49 for nearly incompressible bodies."""

    @classmethod
    def _known(cls, values: Mapping[str, Any]) -> list[str] | None:
        own = MATERIALS.get(str(values.get("model")))
        return None if own is None else [*cls._keys(), *own]

    @classmethod
    def _whose(cls, values: Mapping[str, Any]) -> str:
        return f" of the model {values['model']}"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.poisson_ratio >= 0.5:
            raise problem(
                f"poisson_ratio is {self.poisson_ratio:g}, and must be below 0.5",
                "for a nearly incompressible body write 0.49 or 0.499",
            )
        if self.model not in MATERIALS:
            raise problem(f"unknown material model '{self.model}'", did_you_mean(self.model, list(MATERIALS)))
        known = MATERIALS[self.model]
        for key, value in self.parameters.items():
            if key not in known:
                remedy = did_you_mean(key, [*type(self).model_fields, *known])
                raise problem(f"unknown key '{key}' of the model {self.model}", remedy)
            if not _are_numbers(value):
                raise problem(f"'{key}' is {value!r}", "write a number or a list of numbers")
        wrong, remedy = nonsense_of(self.model, self.parameters)
        if wrong:
            raise problem(wrong, remedy)
        for pair in TOGETHER:
            if len(set(pair) & set(self.parameters)) == 1:
                raise problem(f"only one of {' and '.join(pair)} is given", "give both, or neither")
        return self

    @property
    def parameters(self) -> dict[str, Any]:
        """The model's own constants (extra keys of the file)."""
        return dict(self.model_extra or {})


def _are_numbers(value: Any) -> bool:
    items = value if isinstance(value, list | tuple) else [value]
    return bool(items) and all(_is_number(x) for x in items)


def _is_number(value: Any) -> bool:
    """A finite int or float; true and false are none, nor is an integer beyond the range of floats."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FLOAT_MAX


class Support(Section):
    """A support of the phantom: ``fixed``, or ``sliding`` (held along the normal only)."""

    region: Region
    """The part of the surface that is held, in the configuration of the surface file."""
    type: Literal["fixed", "sliding"] = "fixed"
    """fixed: does not move at all; sliding: held along the normal only."""


class Lesion(Section):
    """A ball inside the body, m in ``phantom``, whose predicted place is published."""

    name: str
    """What it is called in reports and topics."""
    centre: Vector
    """Its middle, m, in the configuration of the surface file."""
    diameter: Length
    """Its diameter, m."""


class Phantom(Section):
    """The body. Exactly one of ``surface`` and ``mesh`` is given."""

    surface: File | None = None
    """File of a closed triangle surface (stl, obj, ply), beside this file."""
    mesh: File | None = None
    """File of tetrahedra (VTK or gmsh), instead of a surface."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the surface or mesh file; all other lengths are in metres."""
    configuration: Literal["loaded", "unloaded"]
    """loaded: the surface was scanned while gravity acted, and the unloaded shape is recovered; unloaded: it was
    not."""
    element_size: Length | None = None
    """Target edge length of the tetrahedra, m; needed with a surface."""
    density: Annotated[Positive, _between(50.0, 25000.0, "densities are in kg/m3: 1 g/cm3 is 1000")]
    """kg/m3: water has 1000."""
    material: Material
    """How the body resists deformation."""
    gravity: Gravity = DEFAULT_GRAVITY
    """Direction and size during the recording, m/s2, in the frame of the surface file."""
    scan_gravity: Gravity = DEFAULT_GRAVITY
    """Direction and size while the surface was scanned, m/s2; the same as gravity where it is absent."""
    support: tuple[Support, ...] = Field(min_length=1)
    """Where the body is held; at least one."""
    markers: File | None = None
    """CSV file id,x,y,z and optionally sigma and kind, in metres, in the configuration of the surface file; may be
    absent where only points without ids are measured."""
    lesions: tuple[Lesion, ...] = ()
    """Places inside the body whose motion is predicted and published."""

    @model_validator(mode="before")
    @classmethod
    def _defaults(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "gravity" in data and "scan_gravity" not in data:
            return {**data, "scan_gravity": data["gravity"]}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.surface is None) == (self.mesh is None):
            found = "neither is given" if self.surface is None else "both are given"
            raise problem(f"the body is a 'surface' or a 'mesh', but {found}", "name one file")
        if self.surface is not None and self.element_size is None:
            raise problem("key 'element_size' is missing", "give the tetrahedra's edge length in metres, as 0.006")
        names = [lesion.name for lesion in self.lesions]
        for name in names:
            if names.count(name) > 1:
                raise problem(f"two lesions are called '{name}'", "give each its own name")
        return self


# --- probe, cameras, loads -------------------------------------------------------------------------------------------


class ProbeShape(Section):
    """``box`` length x width of the contact face and height; ``cylinder`` radius and height; ``mesh`` a closed surface
    in metres in the frame ``probe``."""

    box: tuple[Length, Length, Length] | None = None
    """Length (along x) and width (along y) of the contact face and height, m."""
    cylinder: tuple[Length, Length] | None = None
    """Radius and height, m; the contact face is its end."""
    sphere: Length | None = None
    """Radius of a ball, m; the origin is its lowest point."""
    mesh: File | None = None
    """File of a closed surface in metres, in the frame probe: origin in the contact face, +z out of it."""

    @property
    def kind(self) -> str:
        return _only(self, "the probe's shape")

    @model_validator(mode="after")
    def _check(self) -> Self:
        _only(self, "the probe's shape")
        return self


class Contact(Section):
    formulation: Literal["lagrange", "penalty", "prescribed"] = "lagrange"
    """lagrange: the surfaces do not overlap; penalty: they overlap a little, which is faster; prescribed: what the
    probe touches moves with it."""
    friction: Annotated[NonNegative, _between(0.0, 10.0, "a coefficient of friction is about 0 to 1")] = 0.0
    """Coulomb's coefficient between probe and body; 0 slides freely."""


class Probe(Section):
    """The rigid probe: its shape, the radius that rounds its edges (m), and how it touches the body."""

    shape: ProbeShape
    """One of box, cylinder, sphere and mesh."""
    edge_radius: Annotated[NonNegative, _between(0.0, 0.5, "lengths are in metres: 2 mm is 0.002")] = 0.0
    """Radius that rounds the shape's edges, m."""
    contact: Contact = Contact()
    """How it touches the body."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        sides = self.shape.box or (self.shape.cylinder and (2 * self.shape.cylinder[0], self.shape.cylinder[1])) or ()
        if sides and 2 * self.edge_radius > min(sides):
            raise problem(
                f"edge_radius {self.edge_radius:g} is more than half of the probe's shortest side ({min(sides):g} m)",
                "make it smaller",
            )
        return self


class CameraPose(Section):
    """T_phantom_left."""

    position: Annotated[Vector, AfterValidator(_near)]
    """Origin of the left optical frame in the frame phantom, m."""
    orientation_xyzw: Quaternion
    """Unit quaternion x, y, z, w of the left optical frame (z forward, x right, y down)."""


class Detector(Section):
    """``type`` and the detector's own settings as extra keys (``settings``)."""

    model_config = ConfigDict(extra="allow")
    type: Literal["blob", "circle_grid", "checkerboard", "aruco", "apriltag"] = "blob"
    """The kind of marker; its own settings stand beside it (docs/experiment.md)."""

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Stereo(Section):
    """The cameras; where the calibration files are not named, the recording's CameraInfo is used."""

    left: File | None = None
    """ROS camera_calibration file of the left camera."""
    right: File | None = None
    """ROS camera_calibration file of the right camera."""
    pose: Literal["registered"] | CameraPose = "registered"
    """registered: found from the markers at rest; or a position and orientation, T_phantom_left."""
    detector: Detector = Detector()
    """How markers are found in the pictures."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.left is None) != (self.right is None):
            raise problem("only one camera has a calibration file", "name 'left' and 'right', or neither")
        return self


class Load(Section):
    """A dead load: ``force`` (3,) N in all, spread over the surface inside ``region``."""

    name: str
    """What it is called in messages."""
    region: Region
    """The part of the surface that it is spread over."""
    force: Vector
    """N in all."""


class Timeline(Section):
    """``release``: s after the recording's start from which gravity and loads act. ``clock_start_ns``: the stamp from
    which drifts count (a diagnosis writes it, so that they go on into later recordings); the recording's start if
    absent."""

    release: NonNegative = 0.0
    """Seconds after the recording's start from which gravity and loads act; 0: throughout."""
    clock_start_ns: int | None = None
    """Stamp (ns) from which drifts count; the recording's start where it is absent."""


def _newtons(force: Sequence[float]) -> str:
    return " ".join(f"{v:g}" for v in force) + " N"


class Override(Section):
    """Say what acts on the body in some recordings, in place of what the experiment declares."""

    loads: tuple[Load, ...] | None = None
    """Forces instead of the experiment's; [] for none."""
    gravity: Gravity | None = None
    """Gravity during these recordings instead of the phantom's, m/s2."""
    release: NonNegative | None = None
    """Seconds after these recordings' start from which gravity and loads act."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.text:
            raise problem("nothing is said of these recordings", "give loads, gravity or release, or leave it out")
        return self

    @property
    def text(self) -> str:
        """Put in words what is said; empty where nothing is."""
        said = []
        if self.loads is not None:
            said.append("loads " + (", ".join(f"{x.name} {_newtons(x.force)}" for x in self.loads) or "none"))
        if self.gravity is not None:
            said.append("gravity " + " ".join(f"{v:g}" for v in self.gravity) + " m/s2")
        if self.release is not None:
            said.append(f"release {self.release:g} s")
        return ", ".join(said)


class Temperature(Section):
    """The body's temperature: a ``file`` with the columns time,temperature, or the lists ``time`` (s on the clock of
    the drifts: from ``timeline.clock_start_ns``, or else from the recording's start) and ``value``. ``reference``: at
    which the surface was scanned. All in degrees Celsius, or all in kelvin. Linear in between; the ends hold on."""

    file: File | None = None
    """CSV file time,temperature."""
    time: tuple[Number, ...] | None = None
    """Seconds on the drifts' clock, rising."""
    value: tuple[Number, ...] | None = None
    """Temperatures at these times, all in degrees Celsius or all in kelvin."""
    reference: Number
    """Temperature at which the surface was scanned."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        listed = self.time is not None and self.value is not None
        if listed == (self.file is not None) or (self.time is None) != (self.value is None):
            raise problem("a temperature is given by 'file', or by 'time' and 'value'", "give one of the two")
        if self.time is not None and self.value is not None:
            check_curve(self.time, self.value, self.reference)
        return self


def check_curve(time: Sequence[float], value: Sequence[float], reference: float) -> None:
    """Raise a `problem` unless ``value`` is a curve over rising ``time``, in the unit of ``reference``."""
    if len(time) != len(value) or not time:
        raise problem(f"{len(time)} times but {len(value)} temperatures", "give one temperature per time")
    if any(b <= a for a, b in pairwise(time)):
        raise problem("the times do not rise", "sort them, each once")
    if min(*value, reference) < ABSOLUTE_ZERO:
        raise problem(f"{min(*value, reference):g} degrees Celsius is below absolute zero", "correct the temperature")
    apart = max(value, key=lambda degrees: abs(degrees - reference))
    if abs(apart - reference) > MOST_APART:
        what = f"a temperature of {apart:g} is {abs(apart - reference):g} degrees from the reference {reference:g}"
        raise problem(what, "give all in degrees Celsius, or all in kelvin")


class Thresholds(Section):
    """``error``: m, the verdict of a run."""

    error: Length = 0.005
    """m; a run is OK if its rmse and 95th percentile are below it."""


def _read_effect(value: Any, info: ValidationInfo) -> Any:
    """``{name: .., parameter: value(s), parameter_sigma: ..}`` as ``EffectValues``."""
    if isinstance(value, EffectValues):
        return value
    if not isinstance(value, Mapping) or not isinstance(value.get("name"), str):
        raise problem("an effect is a mapping with a 'name'", "write {name: stiffness, ratio: 1.2}")
    known: Mapping[str, Mapping[str, int | None]] = (info.context or {}).get("effects", EFFECT_PARAMETERS)
    name = value["name"]
    if name not in known:
        raise problem(f"unknown effect '{name}'", did_you_mean(name, list(known)))
    sizes = {**known[name], **OPTIONAL_PARAMETERS.get(name, {})}
    parameters = {k: as_number(v) for k, v in value.items() if k != "name"}
    values: dict[str, Array] = {}
    sigmas: dict[str, Array] = {}
    for key, entry in parameters.items():
        target, parameter = (sigmas, key.removesuffix(SIGMA)) if key.endswith(SIGMA) else (values, key)
        if parameter not in sizes:
            raise problem(f"effect '{name}' has no parameter '{key}'", did_you_mean(key, list(sizes)))
        if not _are_numbers(entry):
            raise problem(f"'{key}' of effect '{name}' is {entry!r}", "write a number or a list of numbers")
        target[parameter] = _shaped(name, key, entry, sizes[parameter])
    missing = [p for p in known[name] if p not in values]
    if missing:
        raise problem(f"effect '{name}' lacks {', '.join(missing)}", "give every parameter a value")
    if without := [p for p in sigmas if p not in values]:
        raise problem(
            f"'{without[0]}{SIGMA}' of effect '{name}' is of a value that is not given", "give both or neither"
        )
    if wrong := impossible(name, values):
        raise problem(wrong, "correct the value, or leave the effect out")
    for key, sigma in sigmas.items():
        if not np.all(sigma > 0.0):
            raise problem(f"'{key}{SIGMA}' of effect '{name}' is {sigma.tolist()}", "give positive standard deviations")
    return EffectValues(name, values, sigmas)


def _shaped(name: str, key: str, entry: Any, size: int | None) -> Array:
    """A scalar as shape (), a vector as (size,), a list of any length (size -1) as (n,)."""
    value = np.array(entry, float)
    if size == -1:
        return np.atleast_1d(value)
    if value.shape != (() if size is None else (size,)):
        wanted = "one number" if size is None else f"a list of {size} numbers"
        raise problem(f"'{key}' of effect '{name}' is {entry!r}", f"write {wanted}")
    return value


def _write_effect(effect: EffectValues) -> dict[str, Any]:
    out: dict[str, Any] = {"name": effect.name}
    for key, value in effect.values.items():
        out[key] = np.asarray(value).tolist()
        if key in effect.sigmas:
            out[key + SIGMA] = np.asarray(effect.sigmas[key]).tolist()
    return out


def _each_once(effects: tuple[EffectValues, ...]) -> tuple[EffectValues, ...]:
    if wrong := doubled(effects):
        raise problem(wrong, KEEP_ONE)
    return effects


def _named(recordings: dict[str, Override]) -> dict[str, Override]:
    """Refuse a name that no recording can have: a name is no path."""
    for pattern in recordings:
        if "/" in pattern:
            raise problem(f"'{pattern}' is a path", "write the recording's own name, without its folders")
    return recordings


Effect = Annotated[
    EffectValues,
    BeforeValidator(_read_effect),
    PlainSerializer(_write_effect),
    WithJsonSchema({"type": "object", "required": ["name"], "properties": {"name": {"enum": list(EFFECT_PARAMETERS)}}}),
]
Effects = Annotated[tuple[Effect, ...], AfterValidator(_each_once)]


# --- the whole -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Markers:
    """Reference markers, in the surface file's configuration.

    ``ids`` (n,); ``points`` (n, 3) m; ``sigmas`` (n,) m, NaN where the file gives none; ``kinds`` (n,) surface,
    internal or support ("surface" where the file gives none); ``kinds_stated``: it has a column of kinds.
    """

    ids: Ids
    points: Array
    sigmas: Array
    kinds: NDArray[np.str_]
    kinds_stated: bool = False


class Experiment(Section):
    """An experiment, read by ``common.experiment.yaml_file.load_experiment``."""

    version: Literal[1]
    """Of this format: 1."""
    name: str
    """What reports call the experiment."""
    phantom: Phantom
    """The body: its shape, its material, where it is held, its markers."""
    probe: Probe | None = None
    """What presses on it; leave it out where nothing does."""
    stereo: Stereo | None = None
    """The cameras; leave it out where another tracker measures."""
    loads: tuple[Load, ...] = ()
    """Forces that act besides the body's weight."""
    timeline: Timeline = Timeline()
    """When gravity and loads begin to act."""
    recordings: Annotated[dict[str, Override], AfterValidator(_named)] = {}
    """What acts otherwise in some recordings: {NAME or GLOB: {loads: [..], gravity: [..], release: s}}. A recording's
    name is its file's, with or without .mcap, or its folder's; of several that fit, the later line decides."""
    temperature: Temperature | None = None
    """How warm the body is over time; needed for thermal_expansion."""
    effects: Effects = ()
    """What the model has beyond all this, as [{name: viscoelasticity, g: [0.3], tau: [2.0]}]; docs/effects.md lists
    them."""
    thresholds: Thresholds = Thresholds()
    """What decides the verdict of a run."""
    _path: Path = PrivateAttr(default=Path())
    _markers: Markers | None = PrivateAttr(default=None)
    _temperatures: tuple[tuple[float, ...], tuple[float, ...]] | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.stereo is not None and self.phantom.markers is None:
            raise problem("key 'phantom.markers' is missing", "name the markers.csv of what the cameras see")
        lets_go = self.timeline.release > 0.0 or any(o.release for o in self.recordings.values())
        released = [(e.name, p) for e in self.effects for p in OPTIONAL_PARAMETERS.get(e.name, ()) if p in e.values]
        if released and not lets_go:
            name, parameter = released[0]
            raise problem(
                f"'{parameter}' of effect '{name}' acts only where a body is let go",
                "leave it out, or give timeline.release",
            )
        if self.temperature is None and any(effect.name == "thermal_expansion" for effect in self.effects):
            raise problem(
                "effect 'thermal_expansion' needs to know how warm the body was",
                "declare 'temperature', or leave the effect out",
            )
        return self

    @property
    def path(self) -> Path:
        """The file that it was read from."""
        return self._path

    @property
    def folder(self) -> Path:
        """The folder of the file that it was read from."""
        return self._path.parent

    @property
    def markers(self) -> Markers:
        """The markers of ``phantom.markers``; none where it is absent."""
        assert self._markers is not None  # set by load_experiment
        return self._markers

    @property
    def temperatures(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """The times (s on the drifts' clock) and the temperatures of ``temperature``; None where it is not declared."""
        return self._temperatures

    @property
    def lesions(self) -> tuple[Lesion, ...]:
        return self.phantom.lesions

    def sigma(self, key_path: str) -> float | None:
        """One standard deviation that the file gives for a quantity, as ``phantom.material.youngs_modulus`` or
        ``loads.0.force``; None where it gives none."""
        *parents, key = key_path.split(".")
        section: Any = self
        for name in parents:
            section = section[int(name)] if isinstance(section, tuple) else getattr(section, name)
            if section is None:
                return None
        sigma: float | None = section._sigmas.get(key)
        return sigma

    def of_recording(self, name: str) -> Experiment:
        """The same experiment with what acts in the recording of that name declared for all."""
        out = self
        for override in self.overrides(name):
            out = out.under(override)
        return out

    @property
    def sigmas(self) -> dict[str, float]:
        """Every standard deviation that the file gives, by the quantity's key with dots."""
        return dict(_sigmas_in(self, ""))

    def overrides(self, name: str) -> list[Override]:
        """Return what is said of the recording of that name, the last to decide last; empty where no line fits it."""
        return [said for key, said in self.recordings.items() if fnmatchcase(name, key.removesuffix(".mcap"))]

    @property
    def acting(self) -> Override:
        """Return loads, gravity and release as they are declared here."""
        return Override(loads=self.loads, gravity=self.phantom.gravity, release=self.timeline.release)

    def under(self, acting: Override) -> Experiment:
        """The same experiment with what is said in ``acting`` declared for all recordings."""
        update: dict[str, Any] = {}
        if acting.loads is not None:
            update["loads"] = acting.loads
        if acting.gravity is not None:
            update["phantom"] = _with(self.phantom, "gravity", acting)
        if acting.release is not None:
            update["timeline"] = _with(self.timeline, "release", acting)
        return self.model_copy(update=update) if update else self

    def with_effects(self, effects: Sequence[EffectValues]) -> Experiment:
        """The same experiment with another list of effects."""
        return self.model_copy(update={"effects": tuple(effects)})


def _with(section: AnySection, key: str, said: Section) -> AnySection:
    """Return a section with what another says of a key, and with its standard deviation where one is given."""
    out = section.model_copy(update={key: getattr(said, key)})
    out._sigmas = section._sigmas | {k: sigma for k, sigma in said._sigmas.items() if k == key}
    return out


def _sigmas_in(value: Any, place: str) -> Iterator[tuple[str, float]]:
    """Give the standard deviations of a section and of all in it."""
    parts: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Section):
        yield from ((f"{place}{key}", sigma) for key, sigma in value._sigmas.items())
        parts = value
    elif isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, tuple):
        parts = enumerate(value)
    for key, part in parts:
        yield from _sigmas_in(part, f"{place}{key}.")
