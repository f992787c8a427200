"""A toy body that is let go: one swing with damping, relaxation and creep, on the markers of a beam that is clamped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import toy
from numba import njit
from scipy.spatial.transform import Rotation

from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.candidates import Candidate, catalogue
from livedeform.closed_loop.evidence.noise import ModelErrors
from livedeform.closed_loop.evidence.observation import Observation, observe
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.forward import Column
from livedeform.closed_loop.inference.fitted_model import Uncertain
from livedeform.closed_loop.inputs import Inputs
from livedeform.common.effect import Surroundings
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.physics.record import Physics, Support

PLACES = np.array([[0.1, y, z] for y in (0.0, 0.03) for z in (0.0, 0.03)] + [[0.01, y, 0.03] for y in (0.0, 0.03)])
SHAPE = np.array([[0.05, 0.0, -1.0]] * 4 + [[0.0, 0.0, 0.0]] * 2)  # of the swing, at the markers
KINDS = np.array(["surface"] * 4 + ["support"] * 2)
SAG, HERTZ, RELEASE, STEP = 0.007, 6.8, 0.2, 1e-3  # m, Hz (of the relaxed body), s, s
SLIDES = 0.02  # 1/s: above it what rubs slides
CLOSE = 0.01  # of the steps that columns are differences over: what swings is far from linear in its rate
NAMES = ("stiffness", "viscoelasticity", "inertia", "softening", "reference_pose")
HELD = (*NAMES, "density", "scan_gravity", "gravity_tilt")  # how heavy, how held and how level it is as well


@njit(cache=True)
def _swing(n, dt, w2, ratio, beta, Q, decay, weight, moves, rubs, friction, give):
    """Return q (n,), 1 where the declared body rests, from Q at first: q'' + w2 (ratio (q + beta q' + sum Q)
    + rubs sign q' + friction z) = w2, where z goes to sign q' within ``give`` (Dahl 1968)."""
    q, v, a, z = np.zeros(n), 0.0, w2 * (1.0 - ratio * Q.sum()), 0.0
    for k in range(1, n):
        old = np.sum(decay * Q)
        if moves:
            ahead, speed = q[k - 1] + dt * v + 0.25 * dt * dt * a, v + 0.5 * dt * a
            left = w2 * (
                1.0
                - rubs * np.tanh(v / SLIDES)
                - friction * z
                - ratio * (old + ahead + beta * speed + weight.sum() * (ahead - q[k - 1]))
            )
            new = left / (1.0 + w2 * ratio * (0.25 * dt * dt * (1.0 + weight.sum()) + 0.5 * dt * beta))
            q[k], v, a = ahead + 0.25 * dt * dt * new, speed + 0.5 * dt * new, new
            to = np.sign(q[k] - q[k - 1])
            z = to + (z - to) * np.exp(-np.abs(q[k] - q[k - 1]) / give)
        else:
            q[k] = (1.0 / ratio - old + weight.sum() * q[k - 1]) / (1.0 + weight.sum())
        Q = decay * Q + weight * (q[k] - q[k - 1])
    return q


def _value(values: Mapping[str, Mapping[str, Array]], effect: str, parameter: str, without: float) -> float:
    return float(values.get(effect, {}).get(parameter, without))


@dataclass
class RingingBody:
    """Displacements of the markers; `points` as those of `toy.ToyBody`."""

    places: Array
    rubs: float = 0.0  # of the weight

    def points(self, effects: Sequence[EffectValues], seconds: Array, position: Array) -> Array:
        """Return (k, m, 3) m at times (k,) s."""
        v = {e.name: e.values for e in effects}
        g, tau = (np.atleast_1d(v.get("viscoelasticity", {"g": [], "tau": []})[k]).astype(float) for k in ("g", "tau"))
        b = g / max(1.0 - g.sum(), 1e-3)
        ratio, n = _value(v, "stiffness", "ratio", 1.0), int((seconds.max() - RELEASE) / STEP) + 2
        q = _swing(
            n,
            STEP,
            (2.0 * np.pi * HERTZ) ** 2,
            ratio / _value(v, "density", "ratio", 1.0),
            _value(v, "inertia", "rayleigh_beta", 0.0),
            -b * np.exp(-(_value(v, "viscoelasticity", "held", np.inf) + RELEASE) / tau) / ratio,  # it had hung
            np.exp(-STEP / tau),
            b * -np.expm1(-STEP / tau) * tau / STEP,
            "inertia" in v,
            self.rubs,
            _value(v, "load_friction", "ratio", 0.0),
            _value(v, "load_friction", "give", SAG) / SAG,
        )
        q = np.interp(seconds - RELEASE, STEP * np.arange(n), q, left=0.0)
        if "softening" in v:
            q = q * np.exp(float(v["softening"]["rate"]) * seconds)
        q = q * (1.0 - _value(v, "scan_gravity", "fraction", 0.0))  # that share acted before the release already
        tilt = Rotation.from_rotvec([*(_value(v, "gravity_tilt", a, 0.0) for a in ("angle_x", "angle_y")), 0.0])
        down = tilt.apply([0.0, 0.0, -1.0])  # what is along the beam hardly moves it
        bends = SHAPE[:, [0, 2, 2]] * [-down[2], -down[1], -down[2]]
        out = self.places + SAG * q[:, None, None] * bends
        if "reference_pose" in v:
            out = out - np.where((KINDS == "support")[:, None], 0.0, v["reference_pose"]["translation"])
        return out


def surroundings() -> Surroundings:
    """Return what can act on it: no probe, no cameras."""
    return Surroundings(
        physics=Physics(supports=(Support(lambda X: X[:, 0] < 1e-3),)),
        lower=PLACES.min(axis=0),
        upper=PLACES.max(axis=0),
        markers=PLACES,
        internal=False,
        duration=5.0,
        has_probe=False,
        contacts=np.zeros((0, 3)),
        has_cameras=False,
        has_release=True,
        has_loads=True,
    )


def candidates(names: Sequence[str] = NAMES) -> dict[str, Candidate]:
    """Return those candidates."""
    return catalogue(surroundings(), names)


def swayed(seconds: Array, size: float) -> Array:
    """Return the course (k,) m of a sway to one side that has a rate and a decay of its own."""
    after = np.maximum(seconds - RELEASE, 0.0)
    turned = np.exp(-2.2 * after) * np.cos(2.0 * np.pi * 1.09 * HERTZ * after + 1.0) - np.cos(1.0)
    return np.asarray(size * turned)


def handled(seconds: Array, size: float) -> Array:
    """Return the course (k,) m of what a hand does that does not let go at once, along the swing and over in one."""
    after = np.maximum(seconds - RELEASE, 0.0)
    course = np.sin(np.pi * after / 0.03) * np.exp(-after / 0.04)
    return np.asarray(size * np.where(after < 0.12, course, 0.0))


def record(
    effects: Sequence[EffectValues],
    seed: int,
    name: str,
    sigma: float = 2e-5,
    n: int = 80,
    *,
    sway: float = 0.0,
    rubs: float = 0.0,
    hand: float = 0.0,
) -> Observation:
    """Return a recording of 5 s at 100 Hz, with noise, of a body that sways by ``sway`` m across its swing as well,
    ``rubs`` with a share of its weight, and is let go by a ``hand`` that moves it by as many m."""
    rng = np.random.default_rng(seed)
    stamps = (np.arange(0.0, 5.0, 0.01) * 1e9).astype(np.int64)
    points = RingingBody(PLACES, rubs).points(effects, stamps * 1e-9, np.zeros((len(stamps), 3)))
    points = points + np.multiply.outer(handled(stamps * 1e-9, hand), SHAPE)
    points = points + np.multiply.outer(swayed(stamps * 1e-9, sway), (KINDS == "surface")[:, None] * [0.0, 1.0, 0.0])
    points = points + sigma * rng.standard_normal(points.shape)
    covariances = np.broadcast_to(sigma**2 * np.eye(3), (*points.shape, 3))
    data = Track(stamps, np.arange(len(PLACES)), points, np.array(covariances))
    return observe(name, data, n_moments=n, start_ns=0, settings=toy.SETTINGS)


@dataclass
class RingingModel(toy.ToyModel):
    """The toy's forward model, without a probe."""

    def predict(self, effects: Sequence[EffectValues], observation: Observation) -> Array:
        return self.body.points(effects, observation.seconds, np.zeros((observation.n_moments, 3)))

    def _column(self, effects: Sequence[EffectValues], o: Observation, column: Column) -> Array:
        """Return as the model does of what is switched on as a whole the difference of two runs."""
        c = column.candidate
        close = tuple(replace(x, step=CLOSE * x.step) for x in c.coordinates)
        column = replace(column, candidate=replace(c, coordinates=close))
        if not len(c.amplitudes) and all(e.name != c.name for e in effects):
            return self.predict([*effects, c.values(np.array(column.z))], o) - self.predict(effects, o)
        return super()._column(effects, o, column)


def model() -> RingingModel:
    """Return the declared model."""
    return RingingModel(RingingBody(PLACES))


def uncertain(place: float = 1e-4, relative: float = 0.01) -> Uncertain:
    """Return what is uncertain anyway: places to ``place`` m, the model to a share ``relative`` of the motion."""
    return Uncertain(ModelErrors(place_sigma=np.full(len(PLACES), place), relative=relative), 2e-5, 2e-4)


def inputs(fit: Observation, test: Observation, names: Sequence[str] = NAMES) -> Inputs:
    """Return what is known of a take that is fitted and one that is held out."""
    return Inputs(
        fitted=(fit,),
        held_out=(test,),
        candidates=candidates(names),
        uncertain=uncertain(),
        places=PLACES,
        settings=replace(toy.SETTINGS),
        reach=ProbeReach(PLACES.min(axis=0), PLACES.max(axis=0), None, 0.008),
    )
