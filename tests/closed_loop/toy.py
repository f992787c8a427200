"""A cheap body with effects: closed formulas for sag and dimples, enough to test statistics without any finite
elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.signal import lfilter

from livedeform.closed_loop.assessment.held_out import RecordingErrors
from livedeform.closed_loop.candidates import Candidate, catalogue
from livedeform.closed_loop.evidence.noise import ModelErrors
from livedeform.closed_loop.evidence.observation import Observation, observe, poses_at
from livedeform.closed_loop.evidence.track import track
from livedeform.closed_loop.forward import Column, Run
from livedeform.closed_loop.inference.fitted_model import Uncertain
from livedeform.closed_loop.settings import Settings
from livedeform.common.effect import Surroundings
from livedeform.common.frames import PosePath
from livedeform.common.published_effects import with_others
from livedeform.common.types import Array, EffectValues, MarkerFrame, Pose
from livedeform.fem_node.physics.record import Physics, Probe, Support, TemperatureCurve

SETTINGS = Settings()
RADIUS, HEIGHT = 0.05, 0.05
TEMPERATURE = TemperatureCurve((0.0, 10.0, 30.0), (20.0, 35.0, 24.0), reference=20.0)
NAMES = (
    *("stiffness", "density", "gravity_tilt", "poisson_ratio", "viscoelasticity", "plastic_set", "strain_stiffening"),
    *("time_offset", "probe_offset", "softening", "swelling", "inclusion", "base_slip", "probe_friction"),
    *("stiffness_gradient", "skin"),
)


def markers(n: int = 40) -> Array:
    """Places (n, 3) on a dome."""
    i = np.arange(n) + 0.5
    z = HEIGHT * (0.05 + 0.9 * i / n)
    r = RADIUS * np.sqrt(1.0 - (z / HEIGHT) ** 2)
    a = np.pi * (3.0 - np.sqrt(5.0)) * i
    return np.column_stack([r * np.cos(a), r * np.sin(a), z])


def path(seconds: float = 30.0, seed: int = 0) -> list[Pose]:
    """Presses at two depths and places, with holds and retreats, at 100 Hz."""
    rng = np.random.default_rng(seed)
    places = [(0.0, 0.0), (0.015, 0.005), (-0.01, 0.012), (0.0, 0.0)]
    depths = [0.006, 0.010, 0.006, 0.010]
    knots_t, knots_p, t = [0.0], [(0.0, 0.0, -0.01)], 2.0
    for (x, y), depth in zip(places, depths, strict=True):
        x, y = x + rng.normal(0, 1e-3), y + rng.normal(0, 1e-3)
        for dt, d in ((0.0, -0.005), (1.2, depth), (2.0, depth), (0.5, -0.005), (2.8, -0.005)):
            t += dt
            knots_t.append(t)
            knots_p.append((x, y, d))
    stamps = np.arange(0.0, seconds, 0.01)
    p = np.column_stack([np.interp(stamps, knots_t, [k[i] for k in knots_p]) for i in range(3)])
    down = np.array([1.0, 0.0, 0.0, 0.0])
    return [Pose(int(s * 1e9), np.array([a, b, HEIGHT - d]), down) for s, (a, b, d) in zip(stamps, p, strict=True)]


@dataclass(frozen=True)
class ToyBody:
    """Displacements of the markers by closed formulas; ``detail`` adds a finer body's difference (another solver)."""

    places: Array
    detail: float = 0.0

    def points(self, effects: Sequence[EffectValues], seconds: Array, position: Array) -> Array:
        """(k, m, 3) at times (k,) with the probe's origin at ``position`` (k, 3)."""
        v = {e.name: {k: np.asarray(x, float) for k, x in e.values.items()} for e in effects}

        def get(effect: str, parameter: str, default: float) -> Array:
            return v[effect][parameter] if effect in v else np.asarray(default)

        x = self.places
        if "probe_offset" in v:
            position = position + v["probe_offset"]["translation"] * [1.0, -1.0, -1.0]
        z = x[:, 2] / HEIGHT
        drive = get("density", "ratio", 1.0) / get("stiffness", "ratio", 1.0)
        drive = drive * np.exp(get("softening", "rate", 0.0) * seconds)
        ax, ay = get("gravity_tilt", "angle_x", 0.0), get("gravity_tilt", "angle_y", 0.0)
        profile = (
            z
            * (1.0 - 0.4 * z)
            * (1.0 - 25.0 * HEIGHT * get("stiffness_gradient", "slope", 0.0) / 25.0 * (z - 0.5) * 0.5)
        )
        sag = np.zeros((len(seconds), len(x), 3))
        nu = get("poisson_ratio", "value", 0.49)
        sag[..., 2] = -2e-3 * drive[:, None] * profile
        sag[..., 0] = drive[:, None] * (
            2e-3 * profile * np.sin(ay) * 2.0 + 0.6 * (nu - 0.2) * 1e-3 * x[:, 0] / RADIUS * (1 - z)
        )
        sag[..., 1] = drive[:, None] * (
            -2e-3 * profile * np.sin(ax) * 2.0 + 0.6 * (nu - 0.2) * 1e-3 * x[:, 1] / RADIUS * (1 - z)
        )
        depth = np.maximum(HEIGHT - position[:, 2], 0.0)
        memory = self._memory(v, seconds, depth)
        width = 0.018 * (1.0 + 0.15 * (get("skin", "ratio", 1.0) - 1.0) * np.exp(-1.0))
        width = width * (1.0 + 20.0 * get("strain_stiffening", "b", 0.0) * depth[:, None])
        away = x[None, :, :2] - position[:, None, :2]
        r2 = (away**2).sum(axis=2)
        kernel = np.exp(-0.5 * r2 / width**2) * z
        u = sag
        u[..., 2] -= memory[:, None] * kernel
        bulge = 0.25 * (nu / 0.49) * memory[:, None, None] * np.exp(-0.5 * r2 / 0.03**2)[..., None] * away / 0.03
        u[..., :2] += bulge * (1.0 - z)[None, :, None]
        if "inclusion" in v:
            near = np.exp(-((x - v["inclusion"]["centre"]) ** 2).sum(axis=1) / v["inclusion"]["radius"] ** 2)
            strength = 0.15 * np.log(v["inclusion"]["ratio"]) * near
            u[..., 2] += memory[:, None] * strength
        if "base_slip" in v:
            u[..., :2] += (
                (1.0 / get("base_slip", "stiffness", 0.0))
                * 4e4
                * memory[:, None, None]
                * (away * 0.5)
                * (1 - z)[None, :, None]
            )
        if "probe_friction" in v:
            u[..., :2] -= (
                0.1
                * np.tanh(get("probe_friction", "mu", 0.0))
                * memory[:, None, None]
                * kernel[..., None]
                * away
                / 0.02
            )
        scale = (1.0 + get("swelling", "offset", 0.0) + get("swelling", "rate", 0.0) * seconds) ** (1 / 3)
        warmer = np.interp(seconds, TEMPERATURE.times, TEMPERATURE.values) - TEMPERATURE.reference
        scale = scale * (1.0 + 3.0 * get("thermal_expansion", "alpha", 0.0) * warmer) ** (1 / 3)
        out = x * scale[:, None, None] + u
        if self.detail:
            out = out + self.detail * memory[:, None, None] * np.sin(300.0 * x + 1.0) * kernel[..., None]
        return out

    @staticmethod
    def _memory(v: dict, seconds: Array, depth: Array) -> Array:
        out = depth.copy()
        if "plastic_set" in v:
            out += v["plastic_set"]["fraction"] * 0.5 * (np.maximum.accumulate(depth) - depth)
        if "viscoelasticity" in v:
            for g, tau in zip(
                np.atleast_1d(v["viscoelasticity"]["g"]), np.atleast_1d(v["viscoelasticity"]["tau"]), strict=True
            ):
                q, last = 0.0, 0.0
                for k, (t, d) in enumerate(zip(seconds, depth, strict=True)):
                    q += (d - q) * (1.0 - np.exp(-(t - last) / tau))
                    last = t
                    out[k] += 0.5 * g * (q - d)
        return out


@dataclass
class ToyModel:
    """`closed_loop.forward.ForwardModel` of a toy body with ``declared`` effects; columns by finite differences."""

    body: ToyBody
    processes: int = 1
    declared: Sequence[EffectValues] = ()
    paths: dict[int, tuple[Observation, PosePath]] = field(default_factory=dict)  # by the observation's id

    def predict(self, effects: Sequence[EffectValues], observation: Observation) -> Array:
        effects = with_others(self.declared, effects)
        offset = next((float(e.values["seconds"]) for e in effects if e.name == "time_offset"), 0.0)
        if id(observation) not in self.paths:
            self.paths[id(observation)] = observation, PosePath(observation.path)
        position, _ = self.paths[id(observation)][1].at(observation.stamps_ns, offset)
        return self.body.points(effects, observation.seconds, position)

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        out = []
        for o in observations:
            points = self.predict(effects, o)
            d = [self._column(effects, o, c) for c in columns]
            out.append(Run(points, None, np.stack(d, axis=-1) if d else np.zeros((*points.shape, 0)), None))
        return out

    def _column(self, effects: Sequence[EffectValues], o: Observation, column: Column) -> Array:
        c, z, i = column.candidate, np.array(column.z), column.coordinate
        others = [e for e in effects if e.name != c.name]
        h = c.coordinates[i].step
        kick = not c.tangent and abs(z[i]) < 1e-12 and c.kick[i] != 0.0
        low, high = z.copy(), z.copy()
        if kick:
            high[i] = c.kick[i]
        else:
            one_sided = z[i] - h < c.coordinates[i].lower
            low[i] -= 0.0 if one_sided else h
            high[i] += h
        a, b = (self.predict([*others, c.values(x)], o) for x in (low, high))
        return (b - a) / (high[i] - low[i])


SETTLED = 10.0  # time constants after which slow noise has forgotten its beginning


def record(
    effects: Sequence[EffectValues],
    *,
    seed: int,
    body: ToyBody | None = None,
    sigma: float = 1e-4,
    n: int = 48,
    name: str = "toy",
    poor: tuple[float, float] = (0.0, 1.0),
    slow: float = 0.0,
    poses: Sequence[Pose] | None = None,
) -> Observation:
    """A recording of 30 s at 25 Hz of the toy body with undeclared effects and noise, as an observation. A share of the
    points is ``poor``: so many times noisier than the others, as the tracker states. The noise fades with a ``slow``
    time constant s; 0: it is white."""
    rng = np.random.default_rng(seed)
    body = body or ToyBody(markers())
    poses = poses or path(seed=seed)
    stamps = (np.arange(0.05, 29.9, 0.04) * 1e9).astype(np.int64)
    offset = next((float(e.values["seconds"]) for e in effects if e.name == "time_offset"), 0.0)
    position, _ = poses_at(poses, stamps, offset)
    points = body.points(effects, stamps * 1e-9, position)
    spread = sigma * np.array([0.5, 0.5, 1.6])
    times = np.where(np.random.default_rng([seed, 1]).random(points.shape[:2]) < poor[0], poor[1], 1.0)
    noise = rng.standard_normal((round(SETTLED * slow / 0.04) + len(stamps), *points.shape[1:]))
    rho = np.exp(-0.04 / slow) if slow else 0.0
    noise = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], noise, axis=0)[-len(stamps) :] if slow else noise
    points = points + spread * times[..., None] * noise
    cov = np.diag(spread**2) * times[..., None, None] ** 2
    ids = np.arange(points.shape[1]).astype(np.uint32)
    frames = []
    for s, p, c in zip(stamps, points, cov, strict=True):
        seen = rng.random(len(ids)) > 0.05
        frames.append(MarkerFrame(int(s), ids[seen], p[seen], c[seen], np.full(seen.sum(), np.nan)))
    return observe(name, track(frames, ids), poses, n_moments=n, start_ns=0, settings=SETTINGS)


def surroundings(places: Array) -> Surroundings:
    physics = Physics(supports=(Support(lambda p: p[:, 2] < 1e-3),), probe=Probe(shape=None), temperature=TEMPERATURE)
    return Surroundings(
        physics=physics,
        lower=np.array([-RADIUS, -RADIUS, 0.0]),
        upper=np.array([RADIUS, RADIUS, HEIGHT]),
        markers=places,
        internal=False,
        duration=30.0,
        has_probe=True,
        contacts=np.array([[0.0, 0.0, HEIGHT]]),
        has_cameras=False,
        has_release=False,
    )


def candidates(
    places: Array, names: Sequence[str] = NAMES, declared: Sequence[EffectValues] = ()
) -> dict[str, Candidate]:
    return catalogue(surroundings(places), names, declared)


def effect(name: str, **values: object) -> EffectValues:
    return EffectValues(name, {k: np.asarray(v, float) for k, v in values.items()})


def errors(places: Array) -> ModelErrors:
    return ModelErrors(place_sigma=np.full(len(places), 2e-5), relative=0.003)


def uncertain(places: Array) -> Uncertain:
    """As much as a registration to markers at rest leaves open."""
    return Uncertain(errors(places), SETTINGS.allowance.shift, SETTINGS.allowance.turn)


__all__ = [
    "SETTINGS",
    "ToyBody",
    "ToyModel",
    "candidates",
    "effect",
    "errors",
    "markers",
    "path",
    "record",
    "replace",
    "surroundings",
    "uncertain",
]


def recording_errors(
    measured: Array,
    predicted: Array,
    covariances: Array,
    weights: Array,
    presses: np.ndarray,
    *,
    name: str = "b",
    blocks: np.ndarray | None = None,
) -> RecordingErrors:
    """What a model leaves of one recording: points (k, m, 3) m with covariances, moments that stand for ``weights``
    (k,) s in ``presses`` (k,), each moment or as said a block of its own."""
    k, m, _ = measured.shape
    own = np.arange(k) if blocks is None else blocks
    return RecordingErrors(
        name, 0, np.arange(k), np.arange(m), measured, predicted, covariances, weights, own, presses
    )  # fmt: skip
