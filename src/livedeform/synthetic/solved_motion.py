"""Solve the truth of a scenario: the body with its effects, key states of each recording, and those between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import PchipInterpolator

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic.checks.effect_values import check_effects, check_places
from livedeform.synthetic.trajectory import CLEARANCE, Press, ProbePath, presses, turned
from livedeform.synthetic.true_effects import Warmth, World, apply_all
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.ball_mesh import block_round_ball
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe
from livedeform.synthetic.truth.solver import TruthBody

SHAPES: dict[str, Callable[[Mapping[str, Any]], hexmesh.HexMesh]] = {
    "block": lambda b: (
        block_round_ball(b["size"], b["elements"], b["ball"]["centre"], float(b["ball"]["radius"]))
        if "ball" in b
        else hexmesh.block(b["size"], b["elements"], float(b.get("focus", 1.0)))
    ),
    "hemi_ellipsoid": lambda b: hexmesh.hemi_ellipsoid(
        b["semi_axes"], b["elements"][0], b["elements"][1], float(b.get("focus", 1.0))
    ),
    "bent_slab": lambda b: hexmesh.bent_slab(b["size"], b["elements"], float(b["radius"]), float(b.get("focus", 1.0))),
}

COARSE, FINE = 4, 16  # cuts of a face's side: to see whether a probe is clear, and to plan for one that is not
SLACK = 0.5e-3  # m by which a probe may touch earlier than with its middle, and be less clear: 0.2 in the blind test
PROBE_SIZES = {"box": 3, "cylinder": 2, "sphere": 1}  # how many sizes each shape of a probe has


def build_truth(spec: Mapping[str, Any]) -> tuple[World, TruthBody, TruthProbe]:
    """Build the world of a scenario with its effects, the body to solve, and the probe."""
    world, shape = build_world(spec)
    return world, TruthBody(world.mesh, world.physics, shape), shape


def build_world(spec: Mapping[str, Any]) -> tuple[World, TruthProbe]:
    """Build the world of a scenario with its effects, and the probe."""
    declared, probe = spec["declared"], spec["probe"]
    kind = spec["body"].get("shape")
    if kind not in SHAPES:
        raise InputError(f"unknown body shape '{kind}'", where="body.shape", remedy=f"use {' or '.join(SHAPES)}")
    _refuse_balls(spec["body"], spec["truth"])
    _refuse_unseen(spec)
    mesh = SHAPES[kind](spec["body"])
    check_effects(spec["truth"], height=float(np.ptp(mesh.nodes[:, 2])))
    check_places(spec["truth"], mesh)
    physics = TruthPhysics(
        float(declared["youngs_modulus"]), float(declared["poisson_ratio"]), float(declared["density"]),
        friction=float(probe["friction"]),
    )  # fmt: skip
    loaded = declared["configuration"] == "loaded"
    world = World(mesh, physics, scan_fraction=1.0 if loaded else 0.0, warmth=Warmth.of(spec["temperature"]))
    world = apply_all(world, spec["truth"])
    return world, truth_probe(probe["shape"], float(probe["edge_radius"]))


def _refuse_balls(body: Mapping[str, Any], truth: Sequence[Mapping[str, Any]]) -> None:
    """Raise InputError for elements that cannot end at a ball, and for a sharp edge at which none end."""
    ball = body.get("ball")
    if ball is not None and body["shape"] != "block":
        raise InputError("only a block has elements that end at a ball", where="body.ball", remedy="leave it out")
    if ball is not None and "focus" in body:
        raise InputError("a block round a ball has no focus", where="body.focus", remedy="leave it out")
    for effect in truth:
        if "edge" in effect and (
            ball is None or any(np.any(np.not_equal(effect[k], ball[k])) for k in ("centre", "radius"))
        ):
            remedy = "give body: ball: the effect's centre and radius"
            raise InputError("no elements end at this sharp edge", where="truth", remedy=remedy)


def _refuse_unseen(spec: Mapping[str, Any]) -> None:
    """Raise InputError for an effect that would be in the truth, and in nothing that is recorded."""
    if all(effect["name"] != "refraction" for effect in spec["truth"]):
        return
    if spec["measuring"]["kind"] == "pictures":
        what, remedy = "pictures show no internal markers, and so no refraction", "use kind: markers, or leave it out"
        raise InputError(what, where="truth: refraction", remedy=remedy)
    if not spec["markers"]["internal"]:
        what, remedy = "refraction acts on internal markers, and there are none", "ask for some: markers: internal"
        raise InputError(what, where="truth: refraction", remedy=remedy)


def refuse_misdeclared(spec: Mapping[str, Any], mesh: hexmesh.HexMesh) -> None:
    """Raise InputError for lengths that this body cannot have been meant by, before it is solved."""
    lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    most, element = float((upper - lower).max()) / 2.0, float(spec["declared"]["element_size"])
    if element > most:
        what, remedy = f"is {element:g} m, more than half of the body", f"give it in metres, below {most:.3g}"
        raise InputError(what, where="declared.element_size", remedy=remedy)
    for i, lesion in enumerate(spec["lesions"]):
        centre = np.asarray(lesion["centre"], float)
        if (centre < lower - 1e-9).any() or (centre > upper + 1e-9).any():
            remedy = "give its centre in metres, in the body's frame"
            raise InputError(f"lesion '{lesion['name']}' is outside the body", where=f"lesions.{i}", remedy=remedy)
    for name, plan in spec["recordings"].items():
        for i, press in enumerate(plan):
            if press["depth"] >= upper[2] - lower[2]:
                what, where = f"a press {press['depth']:g} m deep goes through the body", f"recordings.{name}.{i}.depth"
                raise InputError(what, where=where, remedy="give it in metres: 4 mm is 0.004")


def truth_probe(shape: Mapping[str, Any], edge_radius: float) -> TruthProbe:
    """Return the probe of a scenario's ``probe.shape``, {kind: sizes in m}; InputError if there is none such."""
    kind, size = next(iter(shape.items())) if len(shape) == 1 else ("", ())
    sizes = np.atleast_1d(np.asarray(size, float))
    if len(sizes) != PROBE_SIZES.get(kind) or not (sizes > 0.0).all():
        known = ", ".join(f"{name} ({n})" for name, n in PROBE_SIZES.items())
        raise InputError(
            f"no probe has the shape {dict(shape)}",
            where="probe.shape",
            remedy=f"use one of these, with as many sizes in m above zero: {known}",
        )
    return TruthProbe(kind, tuple(sizes.tolist()), edge_radius)


def scanned_nodes(world: World, spec: Mapping[str, Any]) -> Array:
    """Return the nodes' places (n, 3) m while the surface was scanned: at rest under a share of the declared gravity.

    The scan is before any drift, and at the temperature from which expansion counts.
    """
    if world.scan_fraction == 0.0:
        return world.mesh.nodes
    gravity = tuple(world.scan_fraction * g for g in (0.0, 0.0, -9.81))
    scanned = TruthBody(world.mesh, world.physics.changed(gravity=gravity, growth=()))
    x = scanned.rest().x
    scanned.factors.close()
    return x


def planned_path(plan: list[Mapping[str, Any]], x: Array, mesh: hexmesh.HexMesh, spec: Mapping[str, Any]) -> ProbePath:
    """Plan how the probe moves over the body's places ``x`` (n, 3) m at rest; InputError for a press beside it."""
    steps = [Press.of(p) for p in plan]
    half = (
        np.array(spec["probe"]["shape"].get("box", [0.02, 0.02])[:2]) / 2 if "box" in spec["probe"]["shape"] else None
    )
    surface = _surface(mesh, x, COARSE)
    heights = []
    for step in steps:
        reach = half if half is not None else np.full(2, 0.004)
        under = (np.abs(surface[:, :2] - np.array(step.at)) <= reach).all(1)
        if not under.any():
            raise InputError(f"the press at {step.at} misses the body", where="recordings", remedy="press on the body")
        heights.append(float(surface[under, 2].max()))
    shape = truth_probe(spec["probe"]["shape"], float(spec["probe"]["edge_radius"]))
    path = presses(steps, heights)
    early = max(t - h for t, h in zip(_touched(steps, surface, shape), heights, strict=True))
    if early <= SLACK and _clear(path, surface, shape) >= CLEARANCE - SLACK:
        return path
    return _clear_path(steps, heights, _surface(mesh, x, FINE), shape)


def _surface(mesh: hexmesh.HexMesh, x: Array, cuts: int) -> Array:
    """Return places (n, 3) m on the surface of the mesh with nodes at ``x``, each face's side cut so often."""
    weights, faces, _ = hexmesh.surface_triangles(mesh, cuts)
    places: Array = np.einsum("pa,pad->pd", weights, x[mesh.faces[faces]])
    return places


def _touched(steps: list[Press], surface: Array, probe: TruthProbe) -> list[float]:
    """Return the heights (k,) m of the probe's origin at which it first touches in each press."""
    return [probe.comes_down_to(surface, turned(step.tilt), np.array(step.at)) for step in steps]


def _clear(path: ProbePath, surface: Array, probe: TruthProbe) -> float:
    """Return how far, m, the probe at least is from the surface between presses."""
    return min(float(probe.distance((surface - T[:3, 3]) @ T[:3, :3])[0].min()) for T in path.aloft())


def _clear_path(steps: list[Press], heights: list[float], surface: Array, probe: TruthProbe) -> ProbePath:
    """Plan presses of a probe that would not be clear of the ``surface`` (n, 3) m between them: each counts from where
    it first touches, if that is above the ``heights`` (k,) m under its middle, and it moves over higher up."""
    used = [t if t - h > SLACK else h for t, h in zip(_touched(steps, surface, probe), heights, strict=True)]
    path = presses(steps, used)
    lowest = max(probe.comes_down_to(surface, T[:3, :3], T[:2, 3], CLEARANCE) for T in path.aloft())
    top = max(lowest, max(used) + CLEARANCE)
    return replace(presses(steps, used, top=top), contact=top - CLEARANCE)


@dataclass(frozen=True)
class KeyStates:
    """Hold the key states of a recording.

    ``times`` (k,) s, ``path`` (k,) m along the probe's path, ``x`` (k, n, 3) m, ``force`` (k, 3) N and ``torque``
    (k, 3) N m.
    """

    times: Array
    path: Array
    x: Array
    force: Array
    torque: Array


class TruthSolver(Protocol):
    """Say what a truth has to solve: the body on ``mesh``, at rest and along each recording, in their order."""

    mesh: hexmesh.HexMesh

    def rest(self) -> Array:
        """Return the places (n, 3) m of the mesh's nodes at rest."""

    def recording(
        self, trajectory: ProbePath, clock: float, spec: Mapping[str, Any], tell: Callable[[float], None]
    ) -> KeyStates:
        """Return the key states of a recording that starts at ``clock`` s."""

    def close(self) -> None:
        """Give back what solving took."""


class HexSolver:
    """Solve with `TruthBody`: what made most of the synthetic experiments."""

    def __init__(self, world: World, shape: TruthProbe) -> None:
        self.mesh, self._world = world.mesh, world
        self._body = TruthBody(world.mesh, world.physics, shape)

    def rest(self) -> Array:
        """Return the places (n, 3) m of the mesh's nodes at rest."""
        return self._body.rest().x

    def recording(
        self, trajectory: ProbePath, clock: float, spec: Mapping[str, Any], tell: Callable[[float], None]
    ) -> KeyStates:
        """Return the key states of a recording that starts at ``clock`` s."""
        return solve_recording(self._body, self._world, trajectory, clock, spec, tell)

    def close(self) -> None:
        """Give back the matrix's factors."""
        self._body.factors.close()


class StateCourse:
    """Interpolate ``values`` (k, ...) of the key states to any time.

    Over the probe's path while it moves and over time while it rests, by monotone cubics (Fritsch & Butland 1984)
    within each move. Contact sets in with a power of the depth: a straight line between states 2 mm apart would be off
    by 0.03 mm.
    """

    def __init__(self, trajectory: ProbePath, solved: KeyStates, values: Array) -> None:
        self._trajectory, self._moves = trajectory, []
        for start, end in pairwise(trajectory.times):
            inside = np.flatnonzero((solved.times > start - 2e-4) & (solved.times < end + 2e-4))
            moves = np.ptp(solved.path[inside]) > 1e-7
            s = (solved.path if moves else solved.times)[inside]
            inside = inside[np.r_[True, np.diff(s) > 1e-9]]
            s = (solved.path if moves else solved.times)[inside]
            curve = PchipInterpolator(s, values[inside], axis=0) if len(s) > 1 else None
            self._moves.append((moves, s[0], s[-1], curve, values[inside[0]]))

    def __call__(self, time: float) -> Array:
        times = self._trajectory.times
        moves, low, high, curve, first = self._moves[
            int(np.clip(np.searchsorted(times, time, "right") - 1, 0, len(times) - 2))
        ]
        if curve is None:
            return np.asarray(first)
        s = _path(self._trajectory, time) if moves else time
        found: Array = curve(min(max(s, low), high))
        return found


def solve_recording(
    body: TruthBody, world: World, trajectory: ProbePath, clock: float, spec: Mapping[str, Any],
    tell: Callable[[float], None],
) -> KeyStates:  # fmt: skip
    times = solved_times(world.physics, trajectory, float(body.memory.x[:, 2].max()), spec)
    states = []
    for i, t in enumerate(times):
        states.append(body.step(trajectory(float(t)), clock + float(t), float(spec["path_step"])))
        tell(i / len(times))
    return KeyStates(
        times,
        path_lengths(trajectory, times),
        np.stack([s.x for s in states]),
        np.stack([s.force for s in states]),
        np.stack([s.torque for s in states]),
    )


def solved_times(physics: TruthPhysics, trajectory: ProbePath, top: float, spec: Mapping[str, Any]) -> Array:
    """Return the times (k,) s at which a body whose highest point at rest is at ``top`` m is solved."""
    every = float(spec["time_step"]) if has_clock(physics) else None
    low = max(top, top if trajectory.contact is None else trajectory.contact) + CLEARANCE / 2
    return trajectory.key_times(float(spec["path_step"]), low, every, rubs=physics.rubs)


def has_clock(physics: TruthPhysics) -> bool:
    """Return whether the body depends on more than where the probe is: it has a memory, or changes by itself."""
    return bool(physics.prony or physics.growth or physics.plastic) or _drifts(physics)


def path_lengths(trajectory: ProbePath, times: Array) -> Array:
    """Return the lengths (k,) m of the probe's path until ``times`` (k,) s."""
    return np.array([_path(trajectory, float(t)) for t in times])


def _drifts(physics: TruthPhysics) -> bool:
    probe = np.zeros((1, 3))
    return any(abs(f(probe, 100.0) - f(probe, 0.0)).max() > 0.0 for f in physics.modulus)


def _path(trajectory: ProbePath, time: float) -> float:
    """Return the length m of the probe's path until a time (the moves are straight)."""
    done = trajectory.times <= time
    keys = np.vstack([trajectory.positions[done], trajectory(time)[:3, 3]])
    return float(np.linalg.norm(np.diff(keys, axis=0), axis=1).sum())
