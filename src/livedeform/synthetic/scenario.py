"""A scenario becomes an experiment with recordings, and its truth beside it: ``livedeform synth``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import as_number
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array
from livedeform.common.yaml_text import parse_settings
from livedeform.synthetic.body_markers import BodyMarkers, aimed_rig, place_markers
from livedeform.synthetic.checks.scenario_schema import check_scenario
from livedeform.synthetic.declare import Mesher, write_experiment
from livedeform.synthetic.measuring.measure import Seen, Tracker
from livedeform.synthetic.record import START_NS, ScenarioRecording, record
from livedeform.synthetic.solved_motion import (
    HexSolver,
    KeyStates,
    StateCourse,
    TruthSolver,
    build_world,
    planned_path,
    refuse_misdeclared,
    scanned_nodes,
)
from livedeform.synthetic.trajectory import TURNS, ProbePath
from livedeform.synthetic.true_effects import Warmth, World, apply_all
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.discretisation import STICKING_POINTS
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe

# how the truth adheres: kept motions are known by it
LETS_GO = f"what is glued lets go where all else has settled, at {STICKING_POINTS} points a side"

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
        "effects": [],  # as an experiment lists them, right or not
    },
    "probe": {"shape": {"box": [0.03, 0.015, 0.04]}, "edge_radius": 0.002, "friction": 0.0},
    "markers": {"surface": 32, "internal": 0, "support": 4},
    "lesions": [],
    "temperature": None,  # or time (s), value and reference, as an experiment declares them: known, and true
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


def shipped() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(
        p.name[:-5] for p in (files("livedeform.synthetic") / "scenarios").iterdir() if p.name.endswith(".yaml")
    )


def load(scenario: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """Read a scenario and fill in its defaults: a mapping, a YAML file, or the name of a shipped one."""
    given: Any = _numbers_read(dict(scenario) if isinstance(scenario, Mapping) else _read(scenario))
    known = {*DEFAULTS, "name", "body", "recordings"}
    unknown = set(given) - known
    source = str(given.get("name", "scenario") if isinstance(scenario, Mapping) else scenario)
    if unknown or not {"name", "body", "recordings"} <= set(given):
        what = f"unknown key '{sorted(map(str, unknown))[0]}'" if unknown else "name, body and recordings are needed"
        raise InputError(what, where=source, remedy=f"known keys: {', '.join(sorted(known))}")
    full: dict[str, Any] = {}
    for key, default in DEFAULTS.items():
        value = given.get(key, default)
        full[key] = {**default, **value} if isinstance(default, dict) and isinstance(value, Mapping) else value
    full |= {key: given[key] for key in ("name", "body", "recordings")}
    check_scenario(full, source)
    return full


def _read(scenario: str | Path) -> dict[Any, Any]:
    """Return what is in a YAML file, or in a shipped scenario."""
    path: Any = Path(scenario)
    if not path.is_file():
        path = files("livedeform.synthetic") / "scenarios" / f"{scenario}.yaml"
        if not path.is_file():
            remedy = f"name a YAML file, or one of {', '.join(shipped())}"
            raise InputError(f"there is no scenario '{scenario}'", remedy=remedy)
    try:
        _, given = parse_settings(path.read_text(encoding="utf-8"), str(scenario))
    except UnicodeDecodeError as error:
        raise InputError("is no text in UTF-8", where=str(scenario), remedy="save it as plain UTF-8 text") from error
    if not isinstance(given, dict):
        raise InputError("a scenario is a mapping", where=str(scenario), remedy="see the shipped scenarios")
    return given


def _numbers_read(value: Any) -> Any:
    """Return a scenario with its texts that are numbers as numbers, but for names: YAML takes 1e-3 for a text."""
    if isinstance(value, Mapping):
        return {key: one if key == "name" else _numbers_read(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_numbers_read(one) for one in value]
    return as_number(value)


def generator(seed: int) -> np.random.Generator:
    """Return the random numbers of a seed; InputError if it is negative."""
    if seed < 0:
        raise InputError(f"the seed {seed} is negative", where="seed", remedy="give 0 or more")
    return np.random.default_rng(seed)


def make(
    scenario: str | Path | Mapping[str, Any],
    out: Path,
    seed: int = 0,
    progress: Callable[[str, float | None], None] | None = None,
    kept: Path | None = None,
    mesher: Mesher | None = None,
    solver: Callable[[World, TruthProbe], TruthSolver] = HexSolver,
) -> Path:
    """Make OUT/experiment, OUT/bags/<recording>, OUT/truth; returns the experiment's folder.

    ``kept``: a folder for solved bodies. Experiments that differ in measuring alone share one there. ``mesher`` makes
    the model's mesh where the experiment is to ship one: it is the judged model's business, and none of the truth's.
    ``solver`` makes what solves the body: one folder of ``kept`` bodies for each.
    """
    tell = progress or (lambda text, fraction: None)
    rng, spec = generator(seed), load(scenario)
    if spec["declared"]["ship_mesh"] and mesher is None:
        raise InputError("it ships a mesh, but nobody makes one", where="declared.ship_mesh", remedy="give a mesher")
    world, shape = build_world(spec)
    refuse_misdeclared(spec, world.mesh)
    body = solver(world, shape)
    world = replace(world, mesh=body.mesh)
    scan = scanned_nodes(world, spec)
    rest_x, solved = _all_solved(body, spec, kept, tell)
    body.close()
    rig = aimed_rig(spec, rest_x)
    markers = place_markers(spec, body.mesh, rest_x, rig)
    folder = out / "experiment"
    folder.mkdir(parents=True, exist_ok=True)
    write_experiment(folder, spec, body.mesh, scan, markers, rig, world, tell, mesher)
    load_experiment(folder)  # whatever is wrong with it is told before anything is recorded
    tracker = Tracker(rig, world.measuring, _seen(markers, spec["measuring"]), shape, rng)
    tracker.register(markers.places(rest_x), markers.normals(rest_x))
    (out / "truth").mkdir(exist_ok=True)
    for name, (start, trajectory, states) in solved.items():
        x, force, torque = (
            StateCourse(trajectory, states, values) for values in (states.x, states.force, states.torque)
        )
        recording = ScenarioRecording(name, trajectory, x, force, torque, START_NS + round(start * 1e9))
        record(out, recording, spec, world, markers, tracker, body.mesh, rest_x, rng, seed)
    _write_truth(out / "truth", spec, seed)
    return folder


def _seen(markers: BodyMarkers, measuring: Mapping[str, Any]) -> Seen:
    """Return what the tracker sees of the markers, and how well."""
    ids = np.arange(1, len(markers.kinds) + 1).astype(np.uint32)
    noise_px, dropout, jitter = (float(measuring[key]) for key in ("noise_px", "dropout", "jitter"))
    return Seen(ids, markers.kinds, noise_px, dropout, jitter)


def _all_solved(
    body: TruthSolver, spec: Mapping[str, Any], kept: Path | None, tell: Callable[[str, float | None], None]
) -> tuple[Array, dict[str, tuple[float, ProbePath, KeyStates]]]:
    """Return the places at rest, and each recording's start s, trajectory and key states; from ``kept`` if there."""
    path = None if kept is None else kept / f"{_key(spec)}.npz"
    known = dict(np.load(path)) if path is not None and path.is_file() else {}
    if not known:
        tell("the body at rest", 0.0)
        known["rest"] = body.rest()
    paths = {name: planned_path(plan, known["rest"], body.mesh, spec) for name, plan in spec["recordings"].items()}
    if path is not None and any(p.contact is not None for p in paths.values()):  # others were kept under this key
        path = path.with_stem(f"{path.stem}-clear")
        known = dict(np.load(path)) if path.is_file() else {"rest": known["rest"]}
    clock, out = 0.0, {}
    for name, trajectory in paths.items():
        if f"{name}.x" in known:
            states = KeyStates(*(known[f"{name}.{f.name}"].astype(float) for f in fields(KeyStates)))
        else:
            states = body.recording(trajectory, clock, spec, _telling(tell, name))
            known |= {f"{name}.{f.name}": getattr(states, f.name) for f in fields(KeyStates)}
        out[name] = (clock, trajectory, states)
        clock = round(clock + trajectory.duration + float(spec["gap"]), 3)
    if path is not None and not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        small = {k: v.astype(np.float32) if k.endswith(".x") else v for k, v in known.items()}  # 1e-9 m
        np.savez(part, **small)
        part.replace(path)
    return known["rest"], out


def _key(spec: Mapping[str, Any]) -> str:
    """Return what the body's motion depends on, as a short text."""
    warmth = Warmth.of(spec["temperature"])
    plain = World(hexmesh.block([1.0, 1.0, 1.0], [1, 1, 1]), TruthPhysics(1.0), warmth=warmth)
    changed = [(e, apply_all(plain, [e]).physics) for e in spec["truth"]]
    bodily = [e for e, physics in changed if physics is not plain.physics]
    declared = {k: spec["declared"][k] for k in ("youngs_modulus", "poisson_ratio", "density")}
    parts: tuple[str, ...] = ("body", "probe", "recordings", "path_step", "time_step", "gap")
    if warmth is not None:
        parts = (*parts, "temperature")
    rubs = float(spec["probe"]["friction"]) > 0.0 or any(physics.rubs for _, physics in changed)
    ways = [TURNS.tolist()] if rubs else []
    if any(physics.adhesion > 0.0 for _, physics in changed):
        ways = [*ways, LETS_GO]
    text = json.dumps([declared, bodily, {k: spec[k] for k in parts}, *ways], sort_keys=True, default=float)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _telling(tell: Callable[[str, float | None], None], name: str) -> Callable[[float], None]:
    return lambda fraction: tell(f"recording {name}", fraction)


def _write_truth(folder: Path, spec: Mapping[str, Any], seed: int) -> None:
    document = {"scenario": spec, "effects": spec["truth"], "seed": seed}
    (folder / "truth.json").write_text(json.dumps(document, indent=2, default=float))
