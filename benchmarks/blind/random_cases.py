"""Experiments off the bench: body, modulus, probe, presses, tracker, elements and truth are drawn by a seed.

Even seeds may be looked at, and the loop mended after them; odd seeds are the proof half, which is only counted. Of
five of the first ``COMMON`` cases of a half two have no effect and three have one. Effects come in an order that is
shuffled for each half, so that none comes twice before all have come, every third of them at 1 x the noise and the
others at 2 x. After these come cases of what is rarer (``RARER``), in turn, and from number ``AGAIN`` on common ones
again. Sizes are scaled from what is visible on the standard block (`benchmarks.blind.cases`) by the tracker's noise,
and by the modulus where the weight or a stiffness shows them; how large they are there is measured
(`benchmarks.blind.sizes`). How well the modulus or the density is known, a temperature and inner markers are drawn for
every case, so that they do not tell the effects that need them.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.blind.cases import (
    OUTSIDE,
    PAIRS,
    POOR,
    STANDARD,
    VISIBLE,
    Case,
    declare_besides,
    declare_sigmas,
    end_at_balls,
    sized,
)

NOISE, MODULUS = 0.08, 4000.0  # px and Pa, of the standard block
BY_WEIGHT = ("stiffness", "gravity_tilt", "density", "scan_gravity")  # the stiffer the body, the less they show
BY_STIFFNESS = {"base_slip": "stiffness", "probe_adhesion": "strength"}  # in proportion to the modulus
MOST = 6.0  # of what is visible on the standard block: beyond, values are no longer those of a phantom
LARGEST_RATIO = 20.0  # of an inclusion
ROUNDED = 0.0125  # m, the edges of cylinders and boxes
# m, of the truth's elements (27 nodes) in a block, which are finer in the middle: of 9.5 mm a press drags 0.76 as much
# by its friction, and a stiffness_gradient seemed to be where nothing was (docs/evidence/blind-faults.md)
TRUTH_ELEMENT = (0.0063, 0.0063, 0.0083)
ROUND_A_BALL = (0.0095, 0.0095, 0.0095)  # m, where they end at an inclusion and are much smaller round it
N_NONE, N_OF = 2, 5  # of so many cases so many have no effect
COMMON, AGAIN = 60, 200  # cases of each half with one effect or none; after them, and up to ``AGAIN``, come in turn:
RARER = ("none", "outside", "single", "pair", "none", "outside", "poor")
LARGEST_SWING = 0.6  # of a cavity's volume: in most of them, which are below the size that is asked for then
ONCE = ("camera_motion",)  # effects that happen at a time which a short recording may not have
TIED = 0.012  # m, radius of the patch that a tether pulls: some of the truth's nodes
DOMES, EDGED, FORCES = 0.3, 0.2, 0.5  # shares of domes, of probes with an edge, and of a measured force
NOISES = (0.05, 0.24)  # px
MODULI = (2500.0, 12000.0)  # Pa


@dataclass(frozen=True)
class RandomCase(Case):
    """One drawn experiment: the seed decides everything but its kind, which effect it is, and of what ``size``."""

    def scenario(self) -> dict[str, Any]:
        """Return the scenario of the case."""
        spec = conditions(self.seed, self.truth) | {"truth": [dict(e) for e in self.effects]}
        if self.kind == "poor":
            spec["recordings"] = copy.deepcopy(POOR)
        end_at_balls(spec)
        if "ball" in spec["body"]:
            spec["body"]["elements"] = elements_of(spec["body"]["size"], ROUND_A_BALL)
        declare_sigmas(spec, self.truth, self.seed)
        declare_besides(spec, self.truth, self.seed)
        return spec

    @property
    def distinct(self) -> Hashable:
        """Return the seed, which draws body and presses."""
        return self.seed


def conditions(seed: int, effects: Collection[str]) -> dict[str, Any]:
    """Draw a scenario for ``effects``, without them. With an inclusion it is a block, where the truth's elements can
    end at the ball."""
    rng = np.random.default_rng([7, seed])
    spec = copy.deepcopy(STANDARD)
    spec["name"] = f"experiment-{seed:04d}"
    spec["body"], reach, height = _body(rng, domes=0.0 if "inclusion" in effects else DOMES)
    modulus = float(np.exp(rng.uniform(*np.log(MODULI))))
    spec["declared"] |= {"youngs_modulus": round(modulus, -2), "element_size": round(rng.uniform(0.010, 0.016), 4)}
    spec["probe"], spec["path_step"] = _probe(rng), 0.0025
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    rate = float(rng.choice([5.0, 10.0, 30.0]))
    spec["measuring"] = {"kind": "markers", "rate": rate, "noise_px": round(noise, 3)}
    spec["markers"]["surface"] = int(rng.integers(20, 45))
    spec["wrench"] = {"noise": 0.005} if rng.random() < FORCES else None
    fitted = int(rng.integers(2, 4))
    spec["recordings"] = {name: _presses(rng, n, reach, height) for name, n in (("a", fitted), ("b", 2))}
    return spec


def _body(rng: np.random.Generator, domes: float) -> tuple[dict[str, Any], np.ndarray, float]:
    """Draw a body, of which ``domes`` is the share of those; also return how far (2,) m from its middle a probe may
    press, and its height m."""
    if rng.random() < domes:
        across, height = rng.uniform(0.042, 0.055), rng.uniform(0.035, 0.050)
        axes = [round(float(v), 4) for v in (across, across * rng.uniform(0.85, 1.0), height)]
        dome = {"shape": "hemi_ellipsoid", "semi_axes": axes, "elements": [8, 2], "focus": 1.5}
        return dome, 0.15 * np.array(axes[:2]), axes[2]
    size = [round(float(rng.uniform(*r)), 4) for r in ((0.060, 0.090), (0.050, 0.070), (0.035, 0.060))]
    block = {"shape": "block", "size": size, "elements": elements_of(size, TRUTH_ELEMENT), "focus": 1.4}
    return block, 0.24 * np.array(size[:2]), size[2]


def elements_of(size: Sequence[float], element: Sequence[float]) -> list[int]:
    """Return how many elements of about the sizes ``element`` (3) m a block of ``size`` (3) m has along each edge."""
    return [round(v / e) for v, e in zip(size, element, strict=True)]


def _probe(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a ball, or a cylinder or box that is rounded nearly as far as it can be, as a convex transducer is.

    Under a flat face that slides freely these soft blocks sway: the truth's contact goes to and fro between two
    patches, with friction as well, and does not settle. Flat faces are in the foreign set.
    """
    ball, edged, kind = rng.uniform(0.018, 0.035), rng.random() < EDGED, rng.random()
    if not edged:
        return {"shape": {"sphere": round(float(ball), 4)}, "edge_radius": 0.0, "friction": 0.0}
    shape = {"cylinder": [0.016, 0.04]} if kind < 0.5 else {"box": [0.034, 0.026, 0.04]}
    return {"shape": shape, "edge_radius": ROUNDED, "friction": 0.0}


def _presses(rng: np.random.Generator, n: int, reach: np.ndarray, height: float) -> list[dict[str, Any]]:
    """Draw presses of 7 to 15 % of the height, half of them with a stroke, half with a fast retreat."""
    presses = []
    for _ in range(n):
        press: dict[str, Any] = {
            "at": [round(float(v), 4) for v in reach * rng.uniform(-1.0, 1.0, 2)],
            "depth": round(float(height * rng.uniform(0.07, 0.15)), 5),
            "hold": round(float(rng.uniform(1.0, 3.0)), 1),
            "pause": round(float(rng.uniform(1.0, 3.0)), 1),
        }
        stroke = [round(float(v), 4) for v in rng.uniform(-0.006, 0.006, 2)]
        if rng.random() < 0.5:
            press["stroke"] = stroke
        if rng.random() < 0.5:
            press["retreat_speed"] = 0.05
        presses.append(press)
    return presses


def drawn_effect(name: str, size: float, spec: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return the effect of about ``size`` times the noise of a scenario, where its presses show it."""
    stiffer = spec["declared"]["youngs_modulus"] / MODULUS
    factor = size * spec["measuring"]["noise_px"] / NOISE * (stiffer if name in BY_WEIGHT else 1.0)
    effect = sized(name, min(factor, MOST))
    if name in OUTSIDE:
        return _placed(effect, spec["body"], stiffer)
    if name in BY_STIFFNESS:
        effect[BY_STIFFNESS[name]] *= stiffer
    if name == "inclusion":
        x, y = spec["recordings"]["a"][0]["at"]
        top = spec["body"]["size"][2] if "size" in spec["body"] else spec["body"]["semi_axes"][2]
        effect |= {"ratio": min(effect["ratio"], LARGEST_RATIO), "centre": [x, y, round(top - 0.016, 4)]}
    if name == "camera_motion":
        effect["onset"] = round(float(rng.uniform(5.0, 10.0)), 2)
    if name == "base_debonding":
        effect["direction"] = round(float(rng.uniform(0.0, 2.0 * np.pi)), 3)
    return effect


def _placed(effect: dict[str, Any], body: dict[str, Any], stiffer: float) -> dict[str, Any]:
    """Return an effect from outside the catalogue where it is in this body as on the standard block."""
    standard = np.array(STANDARD["body"]["size"])
    size = np.array(body.get("size", [2.0, 2.0, 1.0])) * body.get("semi_axes", 1.0)
    if "centre" in effect:
        effect["amplitude"] = min(effect["amplitude"], LARGEST_SWING)
        effect["centre"] = [round(float(v), 4) for v in np.array(effect["centre"]) * size / standard]
    if "place" in effect:
        place, end = (np.array(effect[name]) * size / standard for name in ("place", "end"))
        if "semi_axes" in body:  # halfway out on the dome, where a block's corner would be outside of it
            place[:2] /= 2.0
            place[2] = size[2] * np.sqrt(1.0 - 4.0 * np.sum((place[:2] / size[:2]) ** 2))
        effect |= {"place": place.tolist(), "end": end.tolist(), "radius": TIED}
        effect["stiffness"] *= stiffer
    return effect


def _half(first: int, n: int) -> Iterator[RandomCase]:
    """Return the cases of one half in their order; its seeds are ``first``, ``first`` + 2, ..."""
    yield from _common(first, min(n, COMMON))
    for k in range(COMMON, min(n, AGAIN)):
        yield _rarer(first + 2 * k, k - COMMON)
    yield from _common(first + 2 * AGAIN, n - AGAIN)


def _rarer(seed: int, k: int) -> RandomCase:
    """Return case number ``k`` of what is rarer."""
    turn, kind = k // len(RARER), RARER[k % len(RARER)]
    if kind == "outside":  # twice in each turn
        turn = 2 * turn + int(k % len(RARER) > RARER.index(kind))
    singles = np.random.default_rng([9, seed % 2, 1]).permutation([n for n in VISIBLE if n not in ONCE])
    among: Mapping[str, Sequence[Sequence[str]]] = {
        "none": [()],
        "outside": [(name,) for name in OUTSIDE],
        "pair": PAIRS,
        "single": [(str(name),) for name in singles],
        "poor": [(str(name),) for name in singles[::-1]],
    }
    names = among[kind][turn % len(among[kind])]
    size = {"none": 0.0, "single": 0.5}.get(kind, 2.0)
    rng = np.random.default_rng([8, seed])
    effects = tuple(drawn_effect(name, size, conditions(seed, names), rng) for name in names)
    return RandomCase(f"random-{seed:03d}", kind, effects, size, seed)


def _common(first: int, n: int) -> Iterator[RandomCase]:
    """Return the first ``n`` cases of a half, without an effect or with one."""
    names = np.random.default_rng([9, first]).permutation(list(VISIBLE))
    singles = 0
    for k in range(n):
        seed = first + 2 * k
        if k * N_NONE % N_OF < N_NONE:
            yield RandomCase(f"random-{seed:03d}", "none", (), 0.0, seed)
            continue
        name, size = str(names[singles % len(names)]), 1.0 if singles % 3 == 2 else 2.0
        singles += 1
        effect = drawn_effect(name, size, conditions(seed, [name]), np.random.default_rng([8, seed]))
        yield RandomCase(f"random-{seed:03d}", "single", (effect,), size, seed)


def randomised(n: int = AGAIN + 2 * COMMON) -> list[Case]:
    """Return ``n`` cases of each half, the halves in turn: even seeds to look at, odd ones to prove."""
    return [case for pair in zip(_half(0, n), _half(1, n), strict=True) for case in pair]
