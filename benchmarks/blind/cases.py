"""The experiments of the blind test: every effect at three sizes, pairs, effects from outside the catalogue, and none.

``VISIBLE`` holds what is, on the standard experiment below, as large as the noise: the markers with and without the
effect differ, over the frames of the fitted recording, after the rigid registration that is always uncertain, and
whitened by the tracker's covariance, by 1 rms per coordinate. ``benchmarks/blind/sizes.py`` measures the
ratio again.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

STANDARD: dict[str, Any] = {
    "version": 1,
    "body": {"shape": "block", "size": [0.08, 0.06, 0.045], "elements": [12, 10, 5], "focus": 1.0},
    "declared": {
        "youngs_modulus": 4000.0,
        "poisson_ratio": 0.49,
        "density": 1000.0,
        "configuration": "unloaded",
        "element_size": 0.014,
        "sigmas": {"density": 10.0},
    },
    # a ball: edges would ask for finer meshes of both the truth and the model (benchmarks/truth_agreement.py)
    "probe": {"shape": {"sphere": 0.035}, "edge_radius": 0.0, "friction": 0.0},
    "markers": {"surface": 36, "internal": 0, "support": 4},
    "measuring": {"kind": "markers", "rate": 5.0, "noise_px": 0.08},
    "path_step": 0.002,
    "time_step": 1.0,
    "pose_rate": 100.0,  # straight lines between 20 poses per second are 0.2 mm off in a fast retreat
}
PRESSES: dict[str, Any] = {
    "a": [
        {"at": [0.0, 0.0], "depth": 0.004, "hold": 2.0, "pause": 2.0},
        {
            "at": [0.018, 0.006],
            "depth": 0.007,
            "hold": 3.0,
            "stroke": [0.006, 0.0],
            "retreat_speed": 0.05,
            "pause": 3.0,
        },
        {"at": [-0.018, -0.008], "depth": 0.006, "hold": 1.0, "pause": 1.0},
    ],
    "b": [
        {"at": [-0.015, 0.006], "depth": 0.007, "hold": 3.0, "retreat_speed": 0.05, "pause": 3.0},
        {"at": [0.010, -0.008], "depth": 0.004, "hold": 1.5, "stroke": [-0.005, 0.004], "pause": 2.0},
    ],
}
POOR: dict[str, Any] = {  # a single shallow press in the middle: most effects cannot be told apart
    "a": [{"at": [0.0, 0.0], "depth": 0.003, "hold": 2.0}],
    "b": [{"at": [0.0, 0.0], "depth": 0.003, "hold": 2.0}],
}

# another body and another probe: what holds on the block alone would be a habit of the block
DOME: dict[str, Any] = {
    **STANDARD,
    "body": {"shape": "hemi_ellipsoid", "semi_axes": [0.05, 0.05, 0.045], "elements": [8, 2], "focus": 1.5},
    "probe": {"shape": {"sphere": 0.025}, "edge_radius": 0.0, "friction": 0.0},  # a box would ask for a finer truth
}
DOME_PRESSES: dict[str, Any] = {
    "a": [
        {"at": [0.0, 0.0], "depth": 0.004, "hold": 2.0, "pause": 2.0},
        {
            "at": [0.006, 0.008],
            "depth": 0.006,
            "hold": 3.0,
            "stroke": [0.005, 0.0],
            "retreat_speed": 0.05,
            "pause": 3.0,
        },
        {"at": [-0.006, -0.006], "depth": 0.005, "hold": 1.0, "pause": 1.0},
    ],
    "b": [
        {"at": [-0.004, 0.006], "depth": 0.006, "hold": 3.0, "retreat_speed": 0.05, "pause": 3.0},
        {"at": [0.004, -0.006], "depth": 0.004, "hold": 1.5, "stroke": [-0.004, 0.003], "pause": 2.0},
    ],
}

# a corner of the block is outside of the dome: what pulls there pulls nothing
ON_DOME: dict[str, dict[str, Any]] = {"tether": {"place": [-0.03, -0.02, 0.031]}}

# name: values at 1 x noise; the first key is what a size scales (as a difference from where the effect vanishes)
VISIBLE: dict[str, dict[str, Any]] = {
    "stiffness": {"ratio": 1.085},
    "poisson_ratio": {"value": 0.468},
    "strain_stiffening": {"b": 2.8},
    "viscoelasticity": {"g": [0.14], "tau": [4.0]},
    "plastic_set": {"fraction": 0.05, "threshold": 0.05},
    "softening": {"rate": 0.0042},
    "swelling": {"rate": 0.0003, "offset": 0.0},
    "inclusion": {"ratio": 2.7, "centre": [0.012, 0.0, 0.03], "radius": 0.010},
    "skin": {"ratio": 1.15, "thickness": 0.005},
    "stiffness_gradient": {"slope": 4.2},
    "base_slip": {"stiffness": 8.5e5},
    "base_debonding": {"fraction": 0.055, "direction": 0.0},  # a row of the truth's nodes, several times the noise
    "probe_friction": {"mu": 0.02},
    "probe_adhesion": {"strength": 2700.0},
    "gravity_tilt": {"angle_x": 0.0144, "angle_y": 0.0108},
    "density": {"ratio": 1.08},
    "scan_gravity": {"fraction": 0.08},
    "stereo_scale": {"scale": 1.0013},
    "camera_motion": {"translation": [7e-5, 3.6e-5, 0.0], "rotation": [0.0, 0.0, 0.00036], "onset": 12.0},
    "lens_distortion": {"k1": 0.08},
    "refraction": {"index": 1.028},
    "time_offset": {"seconds": 0.037},
    "probe_offset": {"translation": [1.1e-4, 0.0, 4.1e-4]},
    "thermal_expansion": {"alpha": 3e-4},  # of WARMING
}
# what some effects need an experiment to declare is declared in such a share of all others as well
BESIDES = 0.4
MODULUS_SIGMA = 0.02  # of the modulus, for the density's of STANDARD where that is not declared
NUMBERED_LAST = ("thermal_expansion",)  # after all others: a case that results are kept of keeps its seed
WARMING: dict[str, Any] = {"time": [0.0, 12.0, 40.0], "value": [20.0, 30.0, 20.0], "reference": 20.0}  # degrees Celsius
NEUTRAL: dict[str, float] = {"ratio": 1.0, "scale": 1.0, "index": 1.0, "value": 0.49}
OUTSIDE: dict[str, dict[str, Any]] = {
    "anisotropy": {"stiffness": 1.0, "direction": [1.0, 0.5, 0.0]},
    "tether": {"place": [-0.03, -0.02, 0.045], "radius": 0.008, "end": [-0.08, -0.06, 0.06], "stiffness": 60.0},
    "cavity": {"centre": [-0.012, 0.006, 0.025], "radius": 0.011, "amplitude": 0.25, "period": 9.0},
}
PAIRS = (
    ("stiffness", "probe_offset"),
    ("base_slip", "viscoelasticity"),
    ("stiffness_gradient", "camera_motion"),
    ("probe_friction", "gravity_tilt"),
    ("inclusion", "time_offset"),
    ("strain_stiffening", "stereo_scale"),
)


N_PLANS = 6  # ways of pressing


@dataclass(frozen=True)
class Case:
    """One experiment: ``kind`` none | single | pair | outside | poor; ``size`` in units of the noise (on the
    block)."""

    name: str
    kind: str
    effects: tuple[Mapping[str, Any], ...]
    size: float
    seed: int
    body: str = "block"

    @property
    def truth(self) -> tuple[str, ...]:
        return tuple(str(e["name"]) for e in self.effects)

    @property
    def distinct(self) -> Hashable:
        """Return what tells the case from those that are pressed alike and have the same true effects, so that they
        differ in nothing but noise and in what is declared."""
        return self.body, self.kind == "poor", self.truth, self.size, self.seed % N_PLANS

    def scenario(self) -> dict[str, Any]:
        """The scenario of the case; the seed varies where and how deep the probe presses."""
        plain, presses = (STANDARD, PRESSES) if self.body == "block" else (DOME, DOME_PRESSES)
        spec = copy.deepcopy(plain)
        spec["name"] = f"experiment-{self.seed:04d}"  # says nothing of what is the matter
        spec["truth"] = [dict(e) for e in self.effects]
        spec["recordings"] = _varied(POOR if self.kind == "poor" else presses, self.seed)
        declare_sigmas(spec, self.truth, self.seed)
        declare_besides(spec, self.truth, self.seed)
        if "scan_gravity" in self.truth and self.seed % 2:
            spec["declared"]["configuration"] = "loaded"
            spec["truth"][self.truth.index("scan_gravity")]["fraction"] = 1.0 - self.effects[0]["fraction"]
        return spec


def declare_sigmas(spec: dict[str, Any], truth: Collection[str], seed: int) -> None:
    """Declare how well the modulus is known, or else the density: by the seed alone, so that it says nothing of the
    truth, but for the two effects that would belie it. Who has weighed it to one per cent does not err by eight.
    """
    modulus = "density" in truth or ("stiffness" not in truth and _drawn_besides(seed)[0])
    if modulus:
        spec["declared"]["sigmas"] = {"youngs_modulus": MODULUS_SIGMA * spec["declared"]["youngs_modulus"]}


def declare_besides(spec: dict[str, Any], truth: Collection[str], seed: int) -> None:
    """Add a temperature and inner markers where the truth needs them, and in a share of all other cases."""
    _, warming, inner = _drawn_besides(seed)
    if "thermal_expansion" in truth or warming:
        spec["temperature"] = copy.deepcopy(WARMING)
    if "refraction" in truth or inner:
        spec["markers"]["internal"] = 8


def _drawn_besides(seed: int) -> tuple[bool, bool, bool]:
    """Draw what is declared, by a generator of its own: bodies, presses and effects of a seed are what they were."""
    modulus, warming, inner = np.random.default_rng([12, seed]).random(3) < BESIDES
    return bool(modulus), bool(warming), bool(inner)


def _varied(plan: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """One of ``N_PLANS`` variations: cases that differ in measuring and noise alone share the solved body."""
    rng = np.random.default_rng(seed % N_PLANS)
    varied = copy.deepcopy(dict(plan))
    for presses in varied.values():
        for press in presses:
            press["at"] = [round(float(v + rng.uniform(-0.003, 0.003)), 4) for v in press["at"]]
            press["depth"] = round(float(press["depth"] * rng.uniform(0.9, 1.1)), 5)
    return varied


def sized(name: str, size: float) -> dict[str, Any]:
    """An effect at ``size`` times what noise allows to see."""
    return scaled({"name": name, **(VISIBLE.get(name) or OUTSIDE[name])}, size)


def scaled(effect: Mapping[str, Any], size: float) -> dict[str, Any]:
    """An effect whose difference from nothing is scaled; where it acts, and from when, stays."""
    name, values = effect["name"], {key: copy.deepcopy(value) for key, value in effect.items() if key != "name"}
    if name in ("base_slip",):
        values["stiffness"] /= size
    elif name == "camera_motion":
        values["translation"] = [size * v for v in values["translation"]]
        values["rotation"] = [size * v for v in values["rotation"]]
    elif name == "gravity_tilt":
        values = {k: size * v for k, v in values.items()}
    elif name == "inclusion" or name == "skin":
        values["ratio"] = values["ratio"] ** size
    elif name in OUTSIDE:
        key = "amplitude" if name == "cavity" else "stiffness"
        values[key] *= size
    else:
        key = next(iter(values))
        start = NEUTRAL.get(key, 0.0)
        value = values[key]
        if isinstance(value, list):
            values[key] = [start + size * (v - start) for v in value]
        else:
            values[key] = start + size * (value - start)
    return {"name": name, **values}


def nothing_at(spec: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of parameters at which effects do nothing in a scenario, those that are not here at 0: a scan
    is taken to be loaded, or unloaded."""
    return NEUTRAL | ({"fraction": 1.0} if spec["declared"].get("configuration") == "loaded" else {})


def end_at_balls(spec: dict[str, Any]) -> None:
    """Let the elements of a scenario's truth end where its inclusion does, if it is a block."""
    for ball in spec["truth"]:
        if ball["name"] == "inclusion" and spec["body"]["shape"] == "block":
            ball["edge"] = "sharp"
            spec["body"] = {key: value for key, value in spec["body"].items() if key != "focus"}
            spec["body"]["ball"] = {name: ball[name] for name in ("centre", "radius")}


def small() -> list[Case]:
    """A few cases for CI."""
    names = ("stiffness", "base_slip", "probe_offset", "camera_motion")
    return [Case("none-0", "none", (), 0.0, 0)] + [
        Case(f"{name}-2x-0", "single", (sized(name, 2.0),), 2.0, 1) for name in names
    ]


def medium(n_none: int = 24) -> list[Case]:
    """What an afternoon of one core allows: cases without an effect, each effect once at three times the noise, and a
    few of the rest. Those with an effect are all pressed as seed 0 is: sizes can be measured on the same bodies.
    """
    seeds = iter(range(6 * N_PLANS * 100, 10**6, N_PLANS))
    cases = [Case(f"none-{k:02d}", "none", (), 0.0, k) for k in range(n_none)]
    cases += [Case(f"{name}-3x-0", "single", (sized(name, 3.0),), 3.0, next(seeds)) for name in _numbered_first()]
    cases += [Case(f"{name}-3x-0", "outside", (sized(name, 3.0),), 3.0, next(seeds)) for name in OUTSIDE]
    cases += [Case(f"{'+'.join(p)}-3x-0", "pair", tuple(sized(n, 3.0) for n in p), 3.0, next(seeds)) for p in PAIRS]
    cases.append(Case("poor-3x-0", "poor", (sized("stiffness", 3.0),), 3.0, next(seeds)))
    cases += [Case(f"{name}-3x-0", "single", (sized(name, 3.0),), 3.0, next(seeds)) for name in NUMBERED_LAST]
    return cases


def dome() -> list[Case]:
    """Another body and probe: each effect once at twice what is visible on the block, and none."""
    seeds = iter(range(6000, 10**6))
    cases = [Case(f"dome-none-{k}", "none", (), 0.0, next(seeds), "dome") for k in range(12)]
    cases += [Case(f"dome-{n}-2x", "single", (sized(n, 2.0),), 2.0, next(seeds), "dome") for n in _numbered_first()]
    outside = {name: sized(name, 2.0) | ON_DOME.get(name, {}) for name in OUTSIDE}
    cases += [Case(f"dome-{n}-2x", "outside", (e,), 2.0, next(seeds), "dome") for n, e in outside.items()]
    return cases + [Case(f"dome-{n}-2x", "single", (sized(n, 2.0),), 2.0, next(seeds), "dome") for n in NUMBERED_LAST]


def large(n_none: int = 80, n_seeds: int = 8) -> list[Case]:
    """The whole blind test. Seeds differ between cases, so that no two share their noise."""
    cases = [Case(f"none-{k:02d}", "none", (), 0.0, k) for k in range(n_none)]
    seed = 1000
    for k in range(n_seeds):  # seeds outermost: a part of the test covers every effect
        for size in (2.0, 1.0, 0.5):
            for name in _numbered_first():
                cases.append(Case(f"{name}-{size:g}x-{k}", "single", (sized(name, size),), size, seed))
                seed += 1
        for pair in PAIRS:
            cases.append(Case(f"{'+'.join(pair)}-2x-{k}", "pair", tuple(sized(p, 2.0) for p in pair), 2.0, seed))
            seed += 1
        for name in OUTSIDE:
            cases.append(Case(f"{name}-2x-{k}", "outside", (sized(name, 2.0),), 2.0, seed))
            seed += 1
        cases.append(Case(f"poor-{k}", "poor", (sized("stiffness", 2.0),), 2.0, seed))
        seed += 1
    for k, size, name in product(range(n_seeds), (2.0, 1.0, 0.5), NUMBERED_LAST):
        cases.append(Case(f"{name}-{size:g}x-{k}", "single", (sized(name, size),), size, seed))
        seed += 1
    return cases


def _numbered_first() -> list[str]:
    return [name for name in VISIBLE if name not in NUMBERED_LAST]


SETS: dict[str, Callable[[], list[Case]]] = {"small": small, "medium": medium, "large": large, "dome": dome}
