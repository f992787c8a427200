"""Effects by name, applied to the truth's physics and measuring: what is really the matter with a synthetic phantom.

Written from the definitions of the interfaces, not from the project's model of the same effects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic.measuring.measure import MeasuringTruth
from livedeform.synthetic.truth.hexmesh import HexMesh, surface_triangles
from livedeform.synthetic.truth.physics import Field, TruthPhysics

RAMP = 0.0015  # m, half width of the edge of an inclusion or a skin


@dataclass(frozen=True)
class Warmth:
    """Say how warm the body is: ``values`` at ``times`` s, straight lines between them, constant before and after.

    ``reference`` is the temperature of the scan. All in degrees Celsius, or all in kelvin; time counts from the start
    of the first recording.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]
    reference: float

    @classmethod
    def of(cls, section: Mapping[str, Any] | None) -> Warmth | None:
        """Read a scenario's ``temperature``; raises InputError unless it has time, value and reference."""
        if section is None:
            return None
        if set(section) != {"time", "value", "reference"} or len(section["time"]) != len(section["value"]):
            raise InputError(
                "a temperature needs a value per time, and a reference",
                where="temperature",
                remedy="write time: [...], value: [...] and reference",
            )
        times, values = (tuple(map(float, section[key])) for key in ("time", "value"))
        return cls(times, values, float(section["reference"]))

    def above_reference(self, t: float) -> float:
        """Return by how many kelvin the body is warmer at ``t`` s than when it was scanned."""
        return float(np.interp(t, self.times, self.values)) - self.reference


@dataclass(frozen=True)
class World:
    """Hold everything true: body, measuring chain, the probe's pose and clock, the scan, and the temperature."""

    mesh: HexMesh
    physics: TruthPhysics
    measuring: MeasuringTruth = field(default_factory=MeasuringTruth)
    scan_fraction: float = 0.0
    probe_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset: float = 0.0
    warmth: Warmth | None = None

    @property
    def height(self) -> float:
        """The mesh's height, m."""
        return float(np.ptp(self.mesh.nodes[:, 2]))

    def body(self, **changes: Any) -> World:
        """Return the world with some values of the body's physics replaced."""
        return replace(self, physics=self.physics.changed(**changes))

    def modulus(self, one: Field) -> World:
        """Return the world with another field by which the moduli are multiplied."""
        return self.body(modulus=(*self.physics.modulus, one))

    def grown(self, one: Field) -> World:
        """Return the world with another stress-free volume ratio."""
        return self.body(growth=(*self.physics.growth, one))

    def measured(self, **changes: Any) -> World:
        """Return the world with some values of the measuring chain replaced."""
        return replace(self, measuring=replace(self.measuring, **changes))


def _vector(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


Apply = Callable[[World, Mapping[str, Any]], World]


def _inside(distance: Array) -> Array:
    return np.clip(0.5 - 0.5 * distance / RAMP, 0.0, 1.0)


def _ball(values: Mapping[str, Any]) -> Field:
    """Return a ball's modulus. Across an edge that is not sharp, that of a stiffer one changes by equal factors: with
    equal steps it would be as one that is larger."""
    centre, radius, ratio = np.asarray(values["centre"], float), float(values["radius"]), float(values["ratio"])
    sharp = "edge" in values
    if sharp and values["edge"] != "sharp":
        raise InputError(f"no inclusion has the edge '{values['edge']}'", where="truth", remedy="use sharp, or none")

    def factor(X: Array, t: float) -> Array:
        distance = np.linalg.norm(X - centre, axis=1) - radius
        share = (distance < 0.0).astype(float) if sharp else _inside(distance)
        return np.asarray(ratio**share if ratio > 1.0 else 1.0 + (ratio - 1.0) * share)

    return factor


def _skin(world: World, values: Mapping[str, Any]) -> World:
    weights, faces, _ = surface_triangles(world.mesh, 12)
    points = np.einsum("pa,pad->pd", weights, world.mesh.nodes[world.mesh.faces[faces]])
    tree = cKDTree(points[points[:, 2] > 1e-6])
    thickness, ratio = float(values["thickness"]), float(values["ratio"])
    return world.modulus(lambda X, t: 1.0 + (ratio - 1.0) * _inside(tree.query(X)[0] - thickness))


def _gradient(world: World, values: Mapping[str, Any]) -> World:
    slope, middle = float(values["slope"]), 0.5 * world.height
    return world.modulus(lambda X, t: np.maximum(1.0 + slope * (X[:, 2] - middle), 0.02))


def _debonding(world: World, values: Mapping[str, Any]) -> World:
    """Free the nodes towards ``direction`` until as nearly as they allow ``fraction`` of the base is free.

    What lies between nodes that hold and free ones is free, as far as it yields: all of a cell of which two corners
    are free, half of one of which a corner is.
    """
    angle, fraction = float(values["direction"]), float(values["fraction"])
    e = np.array([np.cos(angle), np.sin(angle)])
    corners = world.mesh.nodes[world.mesh.faces]
    base = corners[(np.abs(corners[:, :, 2]) < 1e-9).all(1)].reshape(-1, 3, 3, 3)[..., :2]
    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    p = np.stack([base[:, i : 2 + i, j : 2 + j].reshape(-1, 2) for i, j in around], axis=1)  # cells from node to node
    (ax, ay), (bx, by) = (p[:, 2] - p[:, 0]).T, (p[:, 3] - p[:, 1]).T
    area, along = 0.5 * np.abs(ax * by - ay * bx), np.round(p @ e, 9)
    places = np.unique(along)
    edges = 0.5 * (places[1:] + places[:-1])
    free = [(area * np.minimum(0.5 * (along > edge).sum(axis=1), 1.0)).sum() / area.sum() for edge in edges]
    edge = float(edges[np.argmin(np.abs(np.array(free) - fraction))])
    return world.body(base_free=lambda X: X[:, :2] @ e > edge)


def _tilt(world: World, values: Mapping[str, Any]) -> World:
    turn = Rotation.from_rotvec([float(values["angle_x"]), float(values["angle_y"]), 0.0])
    return world.body(gravity=tuple(turn.apply(world.physics.gravity)))


def _drift(world: World, values: Mapping[str, Any]) -> World:
    rate = float(values["rate"])
    return world.modulus(lambda X, t: np.full(len(X), np.exp(-rate * t)))


def _swelling(world: World, values: Mapping[str, Any]) -> World:
    rate, offset = float(values.get("rate", 0.0)), float(values.get("offset", 0.0))
    return world.grown(lambda X, t: np.full(len(X), 1.0 + offset + rate * t))


def _thermal_expansion(world: World, values: Mapping[str, Any]) -> World:
    """Each length grows by alpha per kelvin: to first order the volume does by three times that."""
    alpha, warmth = float(values["alpha"]), world.warmth
    if warmth is None:
        raise InputError(
            "thermal_expansion without a temperature", where="truth", remedy="add 'temperature' to the scenario"
        )
    return world.grown(lambda X, t: np.full(len(X), 1.0 + 3.0 * alpha * warmth.above_reference(t)))


def _viscoelasticity(world: World, values: Mapping[str, Any]) -> World:
    if "held" in values:
        raise InputError(
            "synthetic recordings have no release, so how long a body was held cannot act",
            where="viscoelasticity: held",
            remedy="leave it out",
        )
    return world.body(prony=tuple(zip(map(float, values["g"]), map(float, values["tau"]), strict=True)))


def _camera_motion(world: World, values: Mapping[str, Any]) -> World:
    motion = (np.asarray(values["translation"], float), np.asarray(values["rotation"], float), float(values["onset"]))
    return world.measured(camera_motion=motion)


EFFECTS: dict[str, Apply] = {
    "stiffness": lambda w, v: w.body(youngs_modulus=w.physics.youngs_modulus * float(v["ratio"])),
    "poisson_ratio": lambda w, v: w.body(poisson_ratio=float(v["value"])),
    "strain_stiffening": lambda w, v: w.body(stiffening=float(v["b"])),
    "viscoelasticity": _viscoelasticity,
    "plastic_set": lambda w, v: w.body(plastic=(float(v["fraction"]), float(v["threshold"]))),
    "softening": _drift,
    "swelling": _swelling,
    "thermal_expansion": _thermal_expansion,
    "inclusion": lambda w, v: w.modulus(_ball(v)),
    "skin": _skin,
    "stiffness_gradient": _gradient,
    "base_slip": lambda w, v: w.body(base_stiffness=float(v["stiffness"])),
    "base_debonding": _debonding,
    "probe_friction": lambda w, v: w.body(friction=float(v["mu"])),
    "probe_adhesion": lambda w, v: w.body(adhesion=float(v["strength"])),
    "gravity_tilt": _tilt,
    "density": lambda w, v: w.body(density=w.physics.density * float(v["ratio"])),
    "scan_gravity": lambda w, v: replace(w, scan_fraction=float(v["fraction"])),
    "stereo_scale": lambda w, v: w.measured(stereo_scale=float(v["scale"])),
    "camera_motion": _camera_motion,
    "lens_distortion": lambda w, v: w.measured(k1=float(v["k1"])),
    "refraction": lambda w, v: w.measured(index=float(v["index"])),
    "time_offset": lambda w, v: replace(w, time_offset=float(v["seconds"])),
    "probe_offset": lambda w, v: replace(w, probe_offset=_vector(v["translation"])),
}


def _cavity(world: World, values: Mapping[str, Any]) -> World:
    """A fluid-filled ball whose volume swings by ``amplitude`` with ``period`` s: pressed from outside by a syringe."""
    centre, radius = np.asarray(values["centre"], float), float(values["radius"])
    amplitude, period = float(values["amplitude"]), float(values["period"])

    def share(X: Array) -> Array:
        return _inside(np.linalg.norm(X - centre, axis=1) - radius)

    soft = world.modulus(lambda X, t: 1.0 - 0.5 * share(X))
    return soft.grown(lambda X, t: 1.0 + amplitude * share(X) * 0.5 * (1.0 - np.cos(2 * np.pi * t / period)))


def _fibres(world: World, values: Mapping[str, Any]) -> World:
    a = np.asarray(values["direction"], float)
    a = a / np.linalg.norm(a)
    return world.body(fibre=(float(values["stiffness"]), (float(a[0]), float(a[1]), float(a[2]))))


def _tether(world: World, values: Mapping[str, Any]) -> World:
    place, end = np.asarray(values["place"], float), np.asarray(values["end"], float)
    string = (place, float(values["radius"]), end, float(values["stiffness"]), float(values.get("slack", 0.0)))
    return world.body(tether=string)


OUTSIDE: dict[str, Apply] = {"anisotropy": _fibres, "tether": _tether, "cavity": _cavity}


def known_effect(name: str) -> Apply:
    """Return what applies the effect of this name; InputError if no truth has it."""
    function = EFFECTS.get(name) or OUTSIDE.get(name)
    if function is None:
        known = ", ".join([*EFFECTS, *OUTSIDE])
        raise InputError(f"the scenario knows no effect '{name}'", where="truth", remedy=f"use one of {known}")
    return function


def apply_all(world: World, effects: list[Mapping[str, Any]]) -> World:
    """Apply effects {name, values...} of the catalogue or from outside it, in their order."""
    for effect in effects:
        name = effect["name"]
        function = known_effect(name)
        try:
            world = function(world, effect)
        except KeyError as error:
            raise InputError(f"effect '{name}' needs the value {error}", remedy="add it to the scenario") from error
    return world
