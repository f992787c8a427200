"""A scenario becomes an experiment with recordings, and its truth beside it: ``livedeform synth``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.types import Array
from livedeform.synthetic import render, writing
from livedeform.synthetic.measure import Seen, Tracker
from livedeform.synthetic.rig import Rig, stereo_rig
from livedeform.synthetic.trajectory import CLEARANCE, Press, Trajectory, presses
from livedeform.synthetic.true_effects import World, apply_all
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.probe import ProbeShape
from livedeform.synthetic.truth.solver import TruthBody, TruthPhysics

START_NS = 1_750_000_000 * 1_000_000_000
SHAPES: dict[str, Callable[[Mapping[str, Any]], hexmesh.HexMesh]] = {
    "block": lambda b: hexmesh.block(b["size"], b["elements"], float(b.get("focus", 1.0))),
    "hemi_ellipsoid": lambda b: hexmesh.hemi_ellipsoid(
        b["semi_axes"], b["elements"][0], b["elements"][1], float(b.get("focus", 1.0))
    ),
}
SURFACE_CUTS = 20  # of a face's side into triangles: a flat one of 0.6 mm lies 1 um below a surface of 45 mm radius
SCAN_CUTS = 5  # as dense as a scan: flat triangles of 2 mm lie 11 um below a surface of 45 mm radius
NEAR = 0.008  # m, within which a surface has a point of its mesh
DEFAULTS: dict[str, Any] = {
    "version": 1,
    "declared": {
        "youngs_modulus": 4000.0,
        "poisson_ratio": 0.49,
        "density": 1000.0,
        "configuration": "unloaded",
        "element_size": 0.010,
        "ship_mesh": True,
        "sigmas": {},
    },
    "probe": {"shape": {"box": [0.03, 0.015, 0.04]}, "edge_radius": 0.002, "friction": 0.0},
    "markers": {"surface": 32, "internal": 0, "support": 4},
    "lesions": [],
    "measuring": {"kind": "markers", "rate": 5.0, "noise_px": 0.08, "dropout": 0.02, "jitter": 0.01},
    "rig": {},
    "pose_rate": 20.0,
    "wrench": {"noise": 0.005},
    "gap": 60.0,
    "path_step": 0.001,
    "time_step": 0.5,
    "truth": [],
    "paint": {},
    "threshold": 0.005,
}


@dataclass(frozen=True)
class BodyMarkers:
    """Markers of the truth's mesh: surface ones by face and weights, internal ones as nodes, support ones fixed in
    space."""

    faces: NDArray[np.int64]
    weights: Array
    nodes: NDArray[np.int64]
    support: Array
    mesh: hexmesh.HexMesh

    @property
    def kinds(self) -> tuple[str, ...]:
        n = (len(self.faces), len(self.nodes), len(self.support))
        return ("surface",) * n[0] + ("internal",) * n[1] + ("support",) * n[2]

    def places(self, x: Array) -> Array:
        """(n, 3) m for the mesh's places ``x``."""
        surface = np.einsum("pa,pad->pd", self.weights, x[self.mesh.faces[self.faces]])
        return np.vstack([surface, x[self.nodes], self.support])

    def normals(self, x: Array) -> Array:
        """(n, 3) outward; of internal markers the way straight up to the surface."""
        local = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
        p = np.einsum("qa,fad->fqd", hexmesh.face_shape(local), x[self.mesh.faces[self.faces]])
        normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        top = x[np.unique(self.mesh.faces)]
        up = [[0.0, 0.0, max(_height(top, node[:2]) - node[2], 1e-6)] for node in x[self.nodes]]
        support = np.tile([0.0, 0.0, 1.0], (len(self.support), 1))
        return np.vstack([normal, np.reshape(up, (-1, 3)), support])


def shipped() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(
        p.name[:-5] for p in (files("livedeform.synthetic") / "scenarios").iterdir() if p.name.endswith(".yaml")
    )


def load(scenario: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """A scenario with its defaults filled in: a mapping, a YAML file, or the name of a shipped one."""
    if isinstance(scenario, Mapping):
        given: Any = dict(scenario)
    else:
        path = Path(scenario)
        if not path.is_file():
            shipped_file = files("livedeform.synthetic") / "scenarios" / f"{scenario}.yaml"
            if not shipped_file.is_file():
                raise InputError(
                    f"there is no scenario '{scenario}'", remedy=f"name a YAML file, or one of {', '.join(shipped())}"
                )
            text = shipped_file.read_text()
        else:
            text = path.read_text()
        try:
            given = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise InputError(f"is not YAML ({error})", where=str(scenario), remedy="correct the file") from error
        if not isinstance(given, dict):
            raise InputError("a scenario is a mapping", where=str(scenario), remedy="see the shipped scenarios")
    known = {*DEFAULTS, "name", "body", "recordings"}
    unknown = set(given) - known
    if unknown or not {"name", "body", "recordings"} <= set(given):
        what = f"unknown key '{sorted(unknown)[0]}'" if unknown else "name, body and recordings are needed"
        raise InputError(what, where=str(given.get("name", scenario)), remedy=f"known keys: {', '.join(sorted(known))}")
    full = {}
    for key, default in DEFAULTS.items():
        value = given.get(key, default)
        full[key] = {**default, **value} if isinstance(default, dict) and isinstance(value, Mapping) else value
    return {**full, **{key: given[key] for key in ("name", "body", "recordings")}}


def make(
    scenario: str | Path | Mapping[str, Any],
    out: Path,
    seed: int = 0,
    progress: Callable[[str, float | None], None] | None = None,
    kept: Path | None = None,
) -> Path:
    """Make OUT/experiment, OUT/bags/<recording>, OUT/truth; returns the experiment's folder.

    ``kept``: a folder for solved bodies. Experiments that differ in measuring alone share one there.
    """
    tell = progress or (lambda text, fraction: None)
    spec = load(scenario)
    rng = np.random.default_rng(seed)
    world, body, shape = _truth(spec)
    scan = _scan(world, spec)
    rest_x, solved = _all_solved(body, world, spec, kept, tell)
    body.factors.close()
    markers = _markers(spec, body.mesh, rest_x, _rig(spec, rest_x))
    rig = _rig(spec, rest_x)
    folder = out / "experiment"
    folder.mkdir(parents=True, exist_ok=True)
    _write_experiment(folder, spec, body.mesh, scan, markers, rig, world, tell)
    ids = np.arange(1, len(markers.kinds) + 1).astype(np.uint32)
    m = spec["measuring"]
    seen = Seen(ids, markers.kinds, float(m["noise_px"]), float(m["dropout"]), float(m["jitter"]))
    tracker = Tracker(rig, world.measuring, seen, shape, rng)
    tracker.register(markers.places(rest_x), markers.normals(rest_x))
    (out / "truth").mkdir(exist_ok=True)
    for name, (start, trajectory, states) in solved.items():
        x, force, torque = (_Course(trajectory, states, values) for values in (states.x, states.force, states.torque))
        recording = _Recording(name, trajectory, x, force, torque, START_NS + round(start * 1e9))
        _record(out, recording, spec, world, markers, tracker, body.mesh, rest_x, rng, seed)
    _write_truth(out / "truth", spec, seed)
    return folder


def _all_solved(
    body: TruthBody, world: World, spec: Mapping[str, Any], kept: Path | None, tell: Callable[[str, float | None], None]
) -> tuple[Array, dict[str, tuple[float, Trajectory, _Solved]]]:
    """Places at rest, and of each recording its start s, trajectory and key states; from ``kept`` if they are there."""
    path = None if kept is None else kept / f"{_key(spec)}.npz"
    known = dict(np.load(path)) if path is not None and path.is_file() else {}
    if not known:
        tell("the body at rest", 0.0)
        known["rest"] = body.rest().x
    clock, out = 0.0, {}
    for name, plan in spec["recordings"].items():
        trajectory = _trajectory(plan, known["rest"], body.mesh, spec)
        if f"{name}.x" in known:
            states = _Solved(*(known[f"{name}.{f.name}"].astype(float) for f in fields(_Solved)))
        else:
            states = _solve(body, world, trajectory, clock, spec, _telling(tell, name))
            known |= {f"{name}.{f.name}": getattr(states, f.name) for f in fields(_Solved)}
        out[name] = (clock, trajectory, states)
        clock = round(clock + trajectory.duration + float(spec["gap"]), 3)
    if path is not None and not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        small = {k: v.astype(np.float32) if k.endswith(".x") else v for k, v in known.items()}  # 1e-9 m
        np.savez(part, **small)  # type: ignore[arg-type]
        part.replace(path)
    return known["rest"], out


def _key(spec: Mapping[str, Any]) -> str:
    """What the body's motion depends on, as a short text."""
    plain = World(hexmesh.block([1.0, 1.0, 1.0], [1, 1, 1]), TruthPhysics(1.0))
    bodily = [e for e in spec["truth"] if apply_all(plain, [e]).physics is not plain.physics]
    declared = {k: spec["declared"][k] for k in ("youngs_modulus", "poisson_ratio", "density")}
    parts = ("body", "probe", "recordings", "path_step", "time_step", "gap")
    text = json.dumps([declared, bodily, {k: spec[k] for k in parts}], sort_keys=True, default=float)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _telling(tell: Callable[[str, float | None], None], name: str) -> Callable[[float], None]:
    return lambda fraction: tell(f"recording {name}", fraction)


# ---- the truth


def _truth(spec: Mapping[str, Any]) -> tuple[World, TruthBody, ProbeShape]:
    declared, probe = spec["declared"], spec["probe"]
    kind = spec["body"].get("shape")
    if kind not in SHAPES:
        raise InputError(f"unknown body shape '{kind}'", where="body.shape", remedy=f"use {' or '.join(SHAPES)}")
    mesh = SHAPES[kind](spec["body"])
    physics = TruthPhysics(
        float(declared["youngs_modulus"]), float(declared["poisson_ratio"]), float(declared["density"]),
        friction=float(probe["friction"]),
    )  # fmt: skip
    loaded = declared["configuration"] == "loaded"
    world = apply_all(World(mesh, physics, scan_fraction=1.0 if loaded else 0.0), spec["truth"])
    ((shape_kind, size),) = probe["shape"].items()
    shape = ProbeShape(shape_kind, tuple(np.atleast_1d(size).tolist()), float(probe["edge_radius"]))
    return world, TruthBody(mesh, world.physics, shape), shape


def _scan(world: World, spec: Mapping[str, Any]) -> Array:
    """The mesh's places while the surface was scanned: at rest under a share of the declared gravity, before any
    drift."""
    if world.scan_fraction == 0.0:
        return world.mesh.nodes
    gravity = tuple(world.scan_fraction * g for g in (0.0, 0.0, -9.81))
    scanned = TruthBody(world.mesh, world.physics.changed(gravity=gravity, growth=None))
    x = scanned.rest().x
    scanned.factors.close()
    return x


def _trajectory(plan: list[Mapping[str, Any]], x: Array, mesh: hexmesh.HexMesh, spec: Mapping[str, Any]) -> Trajectory:
    steps = [Press.of(p) for p in plan]
    half = (
        np.array(spec["probe"]["shape"].get("box", [0.02, 0.02])[:2]) / 2 if "box" in spec["probe"]["shape"] else None
    )
    weights, faces, _ = hexmesh.surface_triangles(mesh, 4)
    surface = np.einsum("pa,pad->pd", weights, x[mesh.faces[faces]])
    heights = []
    for step in steps:
        reach = half if half is not None else np.full(2, 0.004)
        under = (np.abs(surface[:, :2] - np.array(step.at)) <= reach).all(1)
        if not under.any():
            raise InputError(f"the press at {step.at} misses the body", where="recordings", remedy="press on the body")
        heights.append(float(surface[under, 2].max()))
    return presses(steps, heights)


@dataclass(frozen=True)
class _Solved:
    """Key states of a recording: ``times`` (k,), ``path`` (k,) m along the probe's way, ``x`` (k, n, 3), forces,
    torques."""

    times: Array
    path: Array
    x: Array
    force: Array
    torque: Array


class _Course:
    """``values`` (k, ...) of the key states at any time: over the probe's path while it moves, over time while it
    rests, by monotone cubics (Fritsch & Butland 1984) within each move. Contact sets in with a power of the depth: a
    straight line between states 2 mm apart would be off by 0.03 mm.
    """

    def __init__(self, trajectory: Trajectory, solved: _Solved, values: Array) -> None:
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


def _solve(
    body: TruthBody, world: World, trajectory: Trajectory, clock: float, spec: Mapping[str, Any],
    tell: Callable[[float], None],
) -> _Solved:  # fmt: skip
    physics = world.physics
    moving_clock = bool(physics.prony or physics.growth or physics.plastic or physics.modulus)
    static = not (physics.prony or physics.growth or physics.plastic) and not _drifts(physics)
    every = None if static or not moving_clock else float(spec["time_step"])
    top = float(body.memory.x[:, 2].max())
    times = trajectory.key_times(float(spec["path_step"]), top + CLEARANCE / 2, every)
    states = []
    for i, t in enumerate(times):
        states.append(body.step(trajectory(float(t)), clock + float(t), float(spec["path_step"])))
        tell(i / len(times))
    return _Solved(
        times,
        np.array([_path(trajectory, float(t)) for t in times]),
        np.stack([s.x for s in states]),
        np.stack([s.force for s in states]),
        np.stack([s.torque for s in states]),
    )


def _drifts(physics: TruthPhysics) -> bool:
    probe = np.zeros((1, 3))
    return any(abs(f(probe, 100.0) - f(probe, 0.0)).max() > 0.0 for f in physics.modulus)


def _path(trajectory: Trajectory, time: float) -> float:
    """Length m of the probe's way until a time (the moves are straight)."""
    done = trajectory.times <= time
    keys = np.vstack([trajectory.positions[done], trajectory(time)[:3, 3]])
    return float(np.linalg.norm(np.diff(keys, axis=0), axis=1).sum())


# ---- markers, cameras


def _rig(spec: Mapping[str, Any], x: Array) -> Rig:
    target = np.array([0.0, 0.0, 0.55 * float(x[:, 2].max())])
    options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in spec["rig"].items()}
    return stereo_rig(target, **options)


def _markers(spec: Mapping[str, Any], mesh: hexmesh.HexMesh, x: Array, rig: Rig) -> BodyMarkers:
    """Surface markers spread evenly over what both cameras see, clear of where the probe presses."""
    weights, faces, _ = hexmesh.surface_triangles(mesh, 4)
    everything = BodyMarkers(faces, weights, np.empty(0, np.int64), np.empty((0, 3)), mesh)
    places, normals = everything.places(x), everything.normals(x)
    visible = places[:, 2] > 0.004
    for _, T in rig.views():
        eye = -T[:3, :3].T @ T[:3, 3]
        view = (eye - places) / np.linalg.norm(eye - places, axis=1, keepdims=True)
        visible &= (view * normals).sum(1) > 0.35
    candidates = np.flatnonzero(visible)
    chosen = _spread(places[candidates], int(spec["markers"]["surface"]))
    chosen = candidates[chosen]
    inner = np.setdiff1d(np.arange(len(mesh.nodes)), np.unique(mesh.faces))
    shallow = inner[mesh.nodes[inner, 2] > 0.5 * mesh.nodes[:, 2].max()]
    shallow = shallow[_seen_from_above(x[shallow], x[np.unique(mesh.faces)], rig)]
    n_inner = int(spec["markers"]["internal"])
    nodes = shallow[_spread(mesh.nodes[shallow], n_inner)] if n_inner else np.empty(0, np.int64)
    half = np.ptp(mesh.nodes[:, :2], axis=0) / 2 + 0.010
    y = -half[1] * np.array([1.0, 1.0, 0.25, 0.25])
    corners = np.column_stack([half[0] * np.array([-0.8, 0.8, -1.05, 1.05]), y, np.zeros(4)])
    return BodyMarkers(faces[chosen], weights[chosen], nodes, corners[: int(spec["markers"]["support"])], mesh)


def _seen_from_above(points: Array, surface: Array, rig: Rig) -> NDArray[np.bool_]:
    """Which of the inner ``points`` both cameras see through the surface straight above them, not through a side: the
    surface goes on, as high, beyond where the lines of sight pass it."""
    out = np.ones(len(points), bool)
    for _, T in rig.views():
        eye = -T[:3, :3].T @ T[:3, 3]
        for i, p in enumerate(points):
            top = _height(surface, p[:2])
            across = (eye - p)[:2] * (top - p[2]) / (eye - p)[2]
            beyond = p[:2] + across + NEAR * across / max(float(np.linalg.norm(across)), 1e-9)
            out[i] &= _height(surface, beyond) > top - 0.1 * np.ptp(surface[:, 2])
    return out


def _height(surface: Array, place: Array) -> float:
    """The highest of the surface's points near a place (2,); -inf where there are none."""
    near = np.linalg.norm(surface[:, :2] - place, axis=1) < NEAR
    return float(surface[near, 2].max(initial=-np.inf))


def _spread(points: Array, n: int) -> NDArray[np.int64]:
    """n of the points, each as far as possible from those before."""
    if len(points) < n:
        raise InputError(f"only {len(points)} places are visible for {n} markers", remedy="ask for fewer markers")
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


# ---- files


def _write_experiment(
    folder: Path, spec: Mapping[str, Any], mesh: hexmesh.HexMesh, scan: Array, markers: BodyMarkers, rig: Rig,
    world: World, tell: Callable[[str, float | None], None],
) -> None:  # fmt: skip
    declared = spec["declared"]
    weights, faces, triangles = hexmesh.surface_triangles(mesh, SCAN_CUTS)
    surface = np.einsum("pa,pad->pd", weights, scan[mesh.faces[faces]])
    surface[np.abs(surface[:, 2]) < 1e-9, 2] = 0.0
    writing.write_surface(folder / "phantom.stl", surface, triangles)
    kinds = np.array(markers.kinds)
    ids = np.arange(1, len(kinds) + 1).astype(np.uint32)
    write_markers(folder / "markers.csv", Markers(ids, markers.places(scan), np.full(len(kinds), np.nan), kinds))
    shape = {"surface": "phantom.stl"}
    if declared["ship_mesh"]:
        from livedeform.fem_node.mesh.generate import tetrahedralise, write_mesh

        tell("meshing for the shipped experiment", None)
        write_mesh(folder / "phantom.vtu", tetrahedralise(surface, triangles, float(declared["element_size"])))
        shape = {"mesh": "phantom.vtu"}
    write_lesions = [
        {"name": lesion["name"], "centre": _at_node(mesh, scan, lesion["centre"]), "diameter": lesion["diameter"]}
        for lesion in spec["lesions"]
    ]
    material = {
        "model": "neo_hookean",
        "youngs_modulus": float(declared["youngs_modulus"]),
        "poisson_ratio": float(declared["poisson_ratio"]),
    }
    sigmas = dict(declared["sigmas"])
    material |= {f"{k}_sigma": float(sigmas.pop(k)) for k in ("youngs_modulus", "poisson_ratio") if k in sigmas}
    phantom: dict[str, Any] = {
        **shape,
        "unit": "m",
        "configuration": declared["configuration"],
        "element_size": float(declared["element_size"]),
        "density": float(declared["density"]),
        **{f"{k}_sigma": float(v) for k, v in sigmas.items()},
        "material": material,
        "gravity": [0.0, 0.0, -9.81],
        "support": [{"region": {"below_z": 0.001}, "type": "fixed"}],
        "markers": "markers.csv",
    }
    if write_lesions:
        phantom["lesions"] = write_lesions
    probe = spec["probe"]
    document: dict[str, Any] = {
        "version": 1,
        "name": spec["name"],
        "phantom": phantom,
        "probe": {
            "shape": probe["shape"],
            **({} if "sphere" in probe["shape"] else {"edge_radius": float(probe["edge_radius"])}),
            "contact": {"formulation": "lagrange", "friction": float(probe["friction"])},
        },
    }
    writing.write_rig(folder, rig)
    document["stereo"] = {"left": "left.yaml", "right": "right.yaml", "pose": "registered"}
    document["effects"] = []
    document["thresholds"] = {"error": float(spec["threshold"])}
    writing.write_yaml(folder / "experiment.yaml", document)


def _at_node(mesh: hexmesh.HexMesh, scan: Array, centre: list[float]) -> list[float]:
    node = int(np.argmin(np.linalg.norm(mesh.nodes - np.array(centre), axis=1)))
    return [round(float(v), 6) for v in scan[node]]


@dataclass(frozen=True)
class _Recording:
    name: str
    trajectory: Trajectory
    x: _Course
    force: _Course
    torque: _Course
    start_ns: int


def _record(
    out: Path, recording: _Recording, spec: Mapping[str, Any], world: World, markers: BodyMarkers, tracker: Tracker,
    mesh: hexmesh.HexMesh, rest: Array, rng: np.random.Generator, seed: int,
) -> None:  # fmt: skip
    """Write one bag and its truth."""
    trajectory, start = recording.trajectory, recording.start_ns
    m = spec["measuring"]
    frame_times = np.arange(0.0, trajectory.duration, 1.0 / float(m["rate"]))
    frame_times = np.clip(frame_times + rng.uniform(-1e-3, 1e-3, len(frame_times)), 0.0, None)
    pose_times = np.arange(0.0, trajectory.duration, 1.0 / float(spec["pose_rate"]))
    events = sorted([(t, "frame") for t in frame_times] + [(t + world.time_offset, "pose") for t in pose_times])
    painter = _Painter(spec, mesh, rest, markers, tracker) if m["kind"] == "pictures" else None
    truth_markers, stamps, forces, painted = [], [], [], []
    metadata = {"scenario": str(spec["name"]), "seed": str(seed), "made_by": "livedeform synth"}
    path = out / "bags" / recording.name
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing.ScenarioWriter(path, metadata) as bag:
        if painter is None:  # who finds the markers knows where the cameras are, and says so
            bag.registration(start, tracker.T_phantom_left)
        for when, kind in events:
            stamp = start + round(float(when) * 1e9)
            if kind == "pose":
                _write_pose(bag, stamp, when - world.time_offset, recording, spec, world, rng)
                continue
            x = recording.x(float(when))
            T = trajectory(float(when))
            if painter is not None:
                for side, pixels in painter.pictures(x, T, int(rng.integers(2**31))):
                    bag.picture(side, stamp, pixels)
                painted.append((x[painter.nodes].astype(np.float32), T))
            else:
                clock = float(when) + (start - START_NS) * 1e-9
                bag.markers(tracker.frame(stamp, clock, markers.places(x), markers.normals(x), T))
            truth_markers.append(markers.places(x))
            stamps.append(stamp)
            forces.append(recording.force(float(when)))
    scene: dict[str, Any] = {}
    if painter is not None:  # enough to paint the pictures again without solving
        scene = {
            "surface_rest": rest[painter.nodes],
            "surface": np.stack([x for x, _ in painted]),
            "T_probe": np.stack([T for _, T in painted]),
        }
    np.savez_compressed(
        out / "truth" / f"{recording.name}.npz",
        **scene,
        stamps_ns=np.array(stamps),
        markers=np.stack(truth_markers),
        rest=markers.places(rest),
        force=np.stack(forces),
        T_phantom_left=tracker.declared.T_phantom_left,
    )


def _write_pose(
    bag: writing.ScenarioWriter, stamp: int, time: float, recording: _Recording, spec: Mapping[str, Any], world: World,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """The robot's report: true pose = recorded pose displaced by the offset in the probe's frame."""
    T = recording.trajectory(time)
    reported = T.copy()
    reported[:3, 3] -= T[:3, :3] @ np.array(world.probe_offset)
    bag.pose(stamp, reported)
    if spec["wrench"]:
        noise = float(spec["wrench"]["noise"])
        force = recording.force(time) + noise * rng.normal(size=3)
        bag.wrench(stamp, force, recording.torque(time) + 0.03 * noise * rng.normal(size=3))


class _Painter:
    """Draws the body with its markers, the support's plate with its own, and the probe."""

    def __init__(
        self, spec: Mapping[str, Any], mesh: hexmesh.HexMesh, rest: Array, markers: BodyMarkers, tracker: Tracker
    ) -> None:
        self.weights, self.faces, triangles = hexmesh.surface_triangles(mesh, SURFACE_CUTS)
        self.mesh, self.tracker = mesh, tracker
        self.nodes = np.unique(mesh.faces)
        body = self._surface(rest)
        plate, plate_triangles = _plate(markers.support)
        self.plate = plate
        outside = ~(np.abs(body[triangles][:, :, 2]) < 1e-9).all(1)
        points = np.vstack([body, plate])
        painted = markers.places(rest)[[k != "internal" for k in markers.kinds]]
        self.scene = render.Scene(
            np.vstack([triangles[outside], plate_triangles + len(body)]), points, painted, render.Paint(**spec["paint"])
        )
        ((kind, size),) = spec["probe"]["shape"].items()
        self.probe = render.probe_surface(kind, tuple(np.atleast_1d(size).tolist()))

    def _surface(self, x: Array) -> Array:
        surface: Array = np.einsum("pa,pad->pd", self.weights, x[self.mesh.faces[self.faces]])
        return surface

    def pictures(self, x: Array, T: Array, seed: int) -> list[tuple[str, NDArray[np.uint8]]]:
        points = np.vstack([self._surface(x), self.plate])
        probe = (self.probe[0] @ T[:3, :3].T + T[:3, 3], self.probe[1])
        views = self.tracker.true.views()
        return [
            (side, render.render(self.scene, points, probe, camera, T_view, seed + i))
            for i, (side, (camera, T_view)) in enumerate(zip(("left", "right"), views, strict=True))
        ]


def _plate(support: Array) -> tuple[Array, NDArray[np.int64]]:
    """A small square of plate under each support marker, finely cut so that the marker is painted on it."""
    points, triangles = [], []
    n, half = 14, 0.006
    s = np.linspace(-half, half, n)
    grid = np.stack(np.meshgrid(s, s, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.reshape(-1) for q in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    own = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    for k, centre in enumerate(support):
        points.append(grid + centre)
        triangles.append(own + k * n * n)
    if not points:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    return np.vstack(points), np.vstack(triangles)


def _write_truth(folder: Path, spec: Mapping[str, Any], seed: int) -> None:
    document = {"scenario": spec, "effects": spec["truth"], "seed": seed}
    (folder / "truth.json").write_text(json.dumps(document, indent=2, default=float))
