"""All candidates: every effect's parameters in coordinates that suit fitting, and the shapes that are tried at first.

An effect's parameters are mapped to coordinates z: logarithms of ratios and times, the compliance of a spring, plain
values elsewhere. *Amplitudes* are shifted so that z = 0 is the declared model; the other coordinates (places, times,
thicknesses) say what shape the effect has, and a list of their values, ``shapes``, is tried before any is refined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.errors import InputError
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.physics.record import Physics

# minus twice the log of how often a stated value is wrong beyond its sigma, once in twenty times
DOUBT = 6.0
RINGING = 1e-3  # m; of the probe, by which a body lags behind or overshoots: its markers move by a fraction of that
Transform = Literal["linear", "log", "inverse"]
TRANSFORMS: Mapping[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "linear": (float, float),
    "log": (lambda v: float(np.log(v)), lambda z: float(np.exp(z))),
    "inverse": (lambda v: 1.0 / v, lambda z: 1.0 / z if z != 0.0 else float("inf")),
}


@dataclass(frozen=True)
class Coordinate:
    """One number of a candidate. ``amplitude``: z = 0 switches the effect off. ``sigma``, ``lower``, ``upper`` of z;
    ``centre`` of the prior; ``step`` is a size of z that is small but well above a solver's tolerance; ``edges``: of
    values between which nothing changes, as an onset between two moments (none: it is known better)."""

    parameter: str
    index: int | None
    transform: Transform
    amplitude: bool
    neutral: float  # in the parameter's unit; NaN unless an amplitude
    centre: float
    sigma: float
    lower: float
    upper: float
    step: float
    edges: tuple[float, ...] = ()

    def value(self, z: float) -> float:
        forward, back = TRANSFORMS[self.transform]
        return back(z + forward(self.neutral)) if self.amplitude else back(z)

    def z(self, value: float) -> float:
        forward, _ = TRANSFORMS[self.transform]
        return forward(value) - (forward(self.neutral) if self.amplitude else 0.0)

    def slope(self, z: float) -> float:
        """d value / d z."""
        value = self.value(z)
        return {"linear": 1.0, "log": value, "inverse": -(value**2)}[self.transform]


@dataclass(frozen=True)
class Candidate:
    """An effect ready to be fitted: ``shapes`` (s, p) starting coordinates, the amplitudes among them at ``kick``
    where columns cannot be had at zero; ``tangent``: columns at z = 0 exist, so that a linear screening makes sense;
    ``stated`` (p,): sigmas that the experiment states of the declared values, infinite where it does not."""

    info: EffectInfo
    coordinates: tuple[Coordinate, ...]
    shapes: Array
    tangent: bool
    kick: Array
    stated: Array

    @property
    def name(self) -> str:
        return self.info.name

    @property
    def measuring(self) -> bool:
        return self.info.acts_on == "measuring"

    @property
    def amplitudes(self) -> np.ndarray:
        """Columns of ``shapes`` that are amplitudes."""
        return np.flatnonzero([c.amplitude for c in self.coordinates])

    def array(self, attribute: str) -> Array:
        return np.array([getattr(c, attribute) for c in self.coordinates], float)

    def values(self, z: Array) -> EffectValues:
        """The effect at coordinates ``z`` (p,), as an experiment holds it."""
        out: dict[str, Array] = {}
        for parameter in self.info.parameters:
            mine = [(c, v) for c, v in zip(self.coordinates, z, strict=True) if c.parameter == parameter.name]
            numbers = np.array([c.value(float(v)) for c, v in mine])
            out[parameter.name] = numbers if parameter.size is not None else numbers[0]
        return EffectValues(self.name, {k: np.asarray(v) for k, v in out.items()})

    def sigmas(self, z: Array, covariance: Array) -> dict[str, Array]:
        """One sigma of each parameter by the delta method; a vector parameter has a vector."""
        sigma = np.sqrt(np.diag(covariance))
        for i, c in enumerate(self.coordinates):
            if c.edges:
                after = int(np.clip(np.searchsorted(c.edges, z[i]), 1, len(c.edges) - 1))
                sigma[i] = (c.edges[after] - c.edges[after - 1]) / np.sqrt(12.0)  # of anywhere between two moments
        out: dict[str, Array] = {}
        for parameter in self.info.parameters:
            mine = [i for i, c in enumerate(self.coordinates) if c.parameter == parameter.name]
            numbers = np.array([abs(self.coordinates[i].slope(float(z[i]))) * sigma[i] for i in mine])
            out[parameter.name] = numbers if parameter.size is not None else numbers[0]
        return {k: np.asarray(v) for k, v in out.items()}

    def coordinates_of(self, values: Mapping[str, Array]) -> Array:
        """z (p,) of given values."""
        z = []
        for c in self.coordinates:
            value = np.atleast_1d(values[c.parameter])[c.index or 0]
            z.append(c.z(float(value)))
        return np.array(z)


@dataclass(frozen=True)
class Surroundings:
    """What the catalogue must know of an experiment: the declared ``physics``, the body's corners ``lower``,
    ``upper`` (3,) m, ``markers`` (m, 3) at rest, whether some are ``internal``, ``duration`` s of the recordings,
    whether the probe moves or is recorded at all, ``contacts`` (c, 3) m where it pressed, whether there are
    cameras, and when the key ``moments`` (k,) s after the clock's start are."""

    physics: Physics
    lower: Array
    upper: Array
    markers: Array
    internal: bool
    duration: float
    has_probe: bool
    contacts: Array
    has_cameras: bool
    has_release: bool
    jolt: float = 0.0  # m/s2, the highest acceleration of the probe
    moments: tuple[float, ...] = ()

    @property
    def times(self) -> Array:
        """The key moments, or a tenth of the recording each where they are not known."""
        return np.unique(self.moments) if len(self.moments) > 1 else np.linspace(0.0, self.duration, 11)


def catalogue(around: Surroundings, names: Iterable[str] | None = None) -> dict[str, Candidate]:
    """The candidates that the experiment can have; with ``names``, those only (``InputError`` for unknown ones)."""
    infos = all_effects()
    wanted = list(infos) if names is None else list(names)
    for name in wanted:
        if name not in infos:
            raise InputError(f"unknown effect '{name}'", where="--candidates", remedy=f"known are {', '.join(infos)}")
    built = {name: _candidate(infos[name], around) for name in wanted}
    return {name: candidate for name, candidate in built.items() if candidate is not None}


def all_effects() -> dict[str, EffectInfo]:
    """Every effect of both registries."""
    import livedeform.stereo_node.effects

    measuring = getattr(livedeform.stereo_node.effects, "EFFECTS", {})
    return {name: module.INFO for name, module in (*MECHANICAL.items(), *measuring.items())}


# --- how each effect is looked for
# -------------------------------------------------------------------------------------

LOG = {"stiffness.ratio", "density.ratio", "inclusion.ratio", "inclusion.radius", "skin.ratio", "skin.thickness"}
LOG |= {"viscoelasticity.tau", "inertia.rayleigh_beta", "plastic_set.threshold"}
INVERSE = {"base_slip.stiffness"}
# natural smallness of an amplitude: columns are taken over this step
STEPS = {
    "stiffness.ratio": 0.02,
    "poisson_ratio.value": 0.002,
    "strain_stiffening.b": 0.1,
    "viscoelasticity.g": 0.05,
    "plastic_set.fraction": 0.03,
    "softening.rate": 5e-4,
    "swelling.rate": 5e-5,
    "swelling.offset": 2e-3,
    "inclusion.ratio": 0.2,
    "skin.ratio": 0.1,
    "stiffness_gradient.slope": 0.5,
    "base_slip.stiffness": 3e-7,
    "base_debonding.fraction": 0.05,
    "probe_friction.mu": 0.05,
    "probe_adhesion.strength": 50.0,
    "gravity_tilt.angle_x": 0.01,
    "gravity_tilt.angle_y": 0.01,
    "density.ratio": 0.02,
    "scan_gravity.fraction": 0.05,
    "stereo_scale.scale": 1e-3,
    "camera_motion.translation": 1e-4,
    "camera_motion.rotation": 5e-4,
    "camera_motion.onset": 1e-6,  # nothing changes until the next moment
    "lens_distortion.k1": 2e-3,
    "refraction.index": 0.02,
    "time_offset.seconds": 5e-3,
    "probe_offset.translation": 1e-4,
}
# where the model changes its kind at the neutral value (a bond becomes a spring, a strip comes free, a contact slips or
# sticks): the column at zero is worked out from the support's traction, or by a run at this coordinate (`workers`), and
# the nonlinear fit starts no nearer to zero than half of it
KICKS = {"base_debonding.fraction": 0.12, "probe_friction.mu": 0.05, "probe_adhesion.strength": 2000.0}
SLIP_KICK = 0.4  # of height over modulus: springs under the base about as soft as the body, whose first bit of slip
# relaxes the singular edge of a bonded base and says nothing of the rest
NONLINEAR = {
    "base_slip",
    "base_debonding",
    "probe_friction",
    "probe_adhesion",
    "inertia",
}  # tangents at zero say little of the size


def _candidate(info: EffectInfo, around: Surroundings) -> Candidate | None:
    if not _possible(info, around):
        return None
    coordinates = tuple(c for p in info.parameters for c in _coordinates(info, p, around))
    shapes = _shapes(info, coordinates, around)
    kick = np.array([_kick(info, c, around) if c.amplitude else 0.0 for c in coordinates])
    stated = np.full(len(coordinates), np.inf)
    return Candidate(info, coordinates, shapes, info.name not in NONLINEAR, kick, stated)


def _kick(info: EffectInfo, coordinate: Coordinate, around: Surroundings) -> float:
    if info.name == "base_slip":
        return float(SLIP_KICK * (around.upper[2] - around.lower[2]) / around.physics.material.youngs_modulus)
    return KICKS.get(f"{info.name}.{coordinate.parameter}", 0.0)


def _possible(info: EffectInfo, around: Surroundings) -> bool:
    """Effects without the thing that they act on are no candidates."""
    physics = around.physics
    if info.acts_on == "probe":
        return around.has_probe
    if info.name == "refraction":
        return around.internal and around.has_cameras
    if info.name == "lens_distortion":
        return around.has_cameras
    if info.name in ("base_slip", "base_debonding"):
        return any(s.type == "fixed" for s in physics.supports)
    if info.name == "strain_stiffening":
        return physics.material.model in ("neo_hookean", "exponential")
    if info.name in ("density", "gravity_tilt", "scan_gravity"):
        return bool(np.linalg.norm(physics.gravity) > 0.1)
    if info.name == "inertia":
        return around.has_release or (around.has_probe and _ringing(around) > RINGING)
    return True


def _ringing(around: Surroundings) -> float:
    """By how much (m) the body does not follow the probe: its acceleration over the square of the first frequency, that
    of the body shearing on its base, pi/2 sqrt(G / rho) / height."""
    height = max(float(around.upper[2] - around.lower[2]), 1e-6)
    wave = around.physics.material.shear_modulus / around.physics.density
    return float(around.jolt * (2.0 / np.pi * height) ** 2 / wave)


def _coordinates(info: EffectInfo, parameter: Parameter, around: Surroundings) -> list[Coordinate]:
    key = f"{info.name}.{parameter.name}"
    transform: Transform = "log" if key in LOG else "inverse" if key in INVERSE else "linear"
    neutral = _neutral(info, parameter, around)
    amplitude = neutral is not None
    forward = TRANSFORMS[transform][0]
    count = 1 if parameter.size in (None, -1) else int(parameter.size)
    starts = np.broadcast_to(np.asarray(parameter.start, float), (count,))
    shift = forward(neutral) if neutral is not None else 0.0
    ends = sorted(_end(forward, v) - shift for v in (parameter.lower, parameter.upper))
    sigma = parameter.sigma
    if transform == "inverse":
        sigma = 1e-5  # m/Pa: a body of 4 kPa and 5 cm has a compliance of about 1e-5 m/Pa itself
    if transform == "log" and not amplitude:
        sigma = 1.0
    step = STEPS.get(key, 0.05 * sigma)
    return [
        Coordinate(
            parameter.name,
            i if parameter.size is not None else None,
            transform,
            amplitude,
            float(neutral) if neutral is not None else float("nan"),
            0.0 if amplitude else forward(float(starts[i])),
            sigma,
            ends[0],
            ends[1],
            step,
            tuple(around.times.tolist()) if key == "camera_motion.onset" else (),
        )
        for i in range(count)
    ]


def _end(forward: Callable[[float], float], value: float) -> float:
    """A bound in coordinates; the logarithm of zero is a very small number."""
    return forward(max(value, 1e-6)) if forward is TRANSFORMS["log"][0] else forward(value)


def _neutral(info: EffectInfo, parameter: Parameter, around: Surroundings) -> float | None:
    if parameter.neutral is not None:
        return parameter.neutral
    module = MECHANICAL.get(info.name)
    if module is not None and hasattr(module, "declared"):
        return float(module.declared(around.physics)[parameter.name])
    return None


def _shapes(info: EffectInfo, coordinates: tuple[Coordinate, ...], around: Surroundings) -> Array:
    """Starting coordinates (s, p): amplitudes at zero."""
    base = np.array([0.0 if c.amplitude else c.centre for c in coordinates])
    at = {(c.parameter, c.index): i for i, c in enumerate(coordinates)}

    def variants(changes: Sequence[Mapping[tuple[str, int | None], float]]) -> Array:
        out = np.repeat(base[None], len(changes), axis=0)
        for row, change in zip(out, changes, strict=True):
            for key, value in change.items():
                row[at[key]] = value
        return out

    span = around.upper - around.lower
    if info.name == "viscoelasticity":
        longest = max(around.duration, 2.0)
        taus = np.geomspace(0.1, 1.5 * longest, 7)
        return variants([{("tau", 0): float(np.log(t))} for t in taus])
    if info.name == "plastic_set":
        return variants([{("threshold", None): float(np.log(v))} for v in (0.02, 0.1, 0.25)])
    if info.name == "skin":
        return variants([{("thickness", None): float(np.log(v))} for v in (0.002, 0.005)])
    if info.name == "inclusion":
        radius = float(np.clip(0.16 * span.min(), 0.004, 0.02))
        return variants(
            [
                {("centre", 0): x, ("centre", 1): y, ("centre", 2): z, ("radius", None): float(np.log(radius))}
                for x, y, z in inclusion_grid(around, 1.6 * radius)
            ]
        )
    if info.name == "base_debonding":
        return variants([{("direction", None): a} for a in np.arange(-3, 3) * np.pi / 3])
    if info.name == "camera_motion":
        t = around.times
        return variants([{("onset", None): float(v)} for v in 0.5 * (t[1:] + t[:-1])])
    if info.name == "inertia":
        return variants([{("rayleigh_beta", None): float(np.log(b))} for b in (0.002, 0.01)])
    return base[None]


def inclusion_grid(around: Surroundings, spacing: float) -> Array:
    """Centres (n, 3) on a grid inside the markers' hull, nearest to the presses first, never more than 16."""
    inside = around.lower + 0.5 * spacing, around.upper - 0.4 * spacing
    axes = [np.linspace(a, max(b, a), max(round((b - a) / spacing) + 1, 1)) for a, b in zip(*inside, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    near_marker = np.linalg.norm(grid[:, None] - around.markers[None], axis=2).min(axis=1)
    grid = grid[near_marker < 2.5 * spacing]
    if len(around.contacts):
        near = np.linalg.norm(grid[:, None] - around.contacts[None], axis=2).min(axis=1)
        grid = grid[np.argsort(near)]
    return grid[:16]


def with_start(candidate: Candidate, shape: int, theta: Array) -> Array:
    """Coordinates (p,) of shape number ``shape`` with its amplitudes at ``theta``."""
    z = candidate.shapes[shape].copy()
    z[candidate.amplitudes] = theta
    return z


def narrowed(candidate: Candidate, sigma: Mapping[str, float]) -> Candidate:
    """The candidate with the sigmas that an experiment states, in the parameters' coordinates, as its prior's; a tenth
    of the default one is added, see `doubt`."""
    coordinates = tuple(
        replace(c, sigma=float(np.hypot(sigma[c.parameter], 0.1 * c.sigma))) if c.parameter in sigma else c
        for c in candidate.coordinates
    )
    stated = [sigma.get(c.parameter, np.inf) if c.amplitude else np.inf for c in coordinates]
    return replace(candidate, coordinates=coordinates, stated=np.array(stated))


def doubt(theta: Array, stated: Array) -> float:
    """What it costs, in twice the log of odds, to say that stated values are off by ``theta`` (p,): a data sheet can be
    wrong by more than it says, but of two explanations the one that it allows is preferred."""
    return float(min(np.sum((theta / stated) ** 2), DOUBT))
