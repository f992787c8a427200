"""Count how often the stated 95 % intervals of fitted values hold the truth, given the right effect.

    python -m benchmarks.coverage run --half tuning|proof --out DIR [--limit N] [--only PART] [--keep]
    python -m benchmarks.coverage again|table --half tuning|proof --out DIR

Each case draws one effect and its values, a body, a probe, the tracker's noise and the size of the elements, by a seed
of its own: those of the two halves differ, so that what is chosen on one is proved on the other. The experiment is made
by the truth of the blind test, which shares nothing with the model, and the search knows the true effect as its only
candidate: that is what a stated interval promises. ``run`` goes on where it was stopped; ``again`` states the intervals
of kept fits as the code does now.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import pickle
import shutil
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.blind.cases import STANDARD, end_at_balls, sized
from benchmarks.blind.run import ONE_THREAD, resources
from benchmarks.blind.table import bounds
from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.diagnosis import fitted_values, stated_covariance
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel
from livedeform.closed_loop.inference.forward_selection import ForwardSelection
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.inputs import read_inputs
from livedeform.closed_loop.measured_coverage import family_of
from livedeform.closed_loop.settings import SamplingSettings, Settings
from livedeform.fem_node.mesh.generate import mesh_to_file
from livedeform.synthetic.scenario import make
from livedeform.synthetic.solved_motion import HexSolver
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth.hexmesh import HexMesh, hex_shape
from livedeform.synthetic.truth.physics import Field
from livedeform.synthetic.truth.probe import TruthProbe

BODIES: dict[str, dict[str, Any]] = {
    "block": {"shape": "block", "size": [0.08, 0.06, 0.045], "elements": [8, 6, 5], "focus": 1.4},
    "cuboid": {"shape": "block", "size": [0.07, 0.06, 0.06], "elements": [7, 6, 6], "focus": 1.4},
    "slab": {"shape": "bent_slab", "size": [0.1, 0.06, 0.035], "radius": 0.12, "elements": [9, 6, 4], "focus": 1.3},
    "dome": {"shape": "hemi_ellipsoid", "semi_axes": [0.05, 0.05, 0.045], "elements": [6, 2], "focus": 1.5},
}
N_BLOCKS = 2  # of these, the first: in which an inclusion has a mesh of its own (`synthetic.truth.ball_mesh`)
REACH = {"block": (0.02, 0.012), "cuboid": (0.014, 0.012), "slab": (0.022, 0.01), "dome": (0.007, 0.007)}  # m
BALLS = (0.025, 0.03, 0.035)  # m, radius
NOISES = (0.04, 0.06, 0.09)  # px
VERTICES = (150, 200, 270)  # of the search's mesh: elements of 10 to 12 mm, 18 of the dome
MOMENTS = 12  # less than half of what a diagnosis fits, and about half of its noise
# two of three cases are of the families that missed; what remembers takes minutes
EFFECTS = (
    *("skin", "probe_offset", "inclusion", "gravity_tilt", "stiffness", "camera_motion"),
    *("skin", "time_offset", "inclusion", "base_slip", "stiffness_gradient", "probe_offset"),
    *("skin", "stereo_scale", "poisson_ratio", "inclusion", "strain_stiffening", "density"),
)
TWINS = 2
N_PLANS = 4  # bodies with a probe and presses: what changes no body shares them
HALVES = {"tuning": 71_000, "proof": 95_000}


@dataclass(frozen=True)
class Case:
    """One experiment: the ``effect``'s true values are drawn by ``seed``, which also chooses one of a few bodies with
    their probe and presses; elements and noise are another ``twin``'s as well. What is solved alike is solved once."""

    effect: str
    seed: int
    twin: int = 0

    @property
    def name(self) -> str:
        return f"{self.effect}-{self.seed}-{self.twin}"

    def scenario(self) -> dict[str, Any]:
        """Return the scenario: three presses to fit, and a shallow one that is held out."""
        rng, how = np.random.default_rng(self.seed), self.seed % N_PLANS
        body = list(BODIES)[how % (N_BLOCKS if self.effect == "inclusion" else len(BODIES))]
        spec = copy.deepcopy(STANDARD)
        spec |= {"name": f"experiment-{self.seed}", "body": BODIES[body]}
        spec["probe"] = {"shape": {"sphere": BALLS[how % len(BALLS)]}, "edge_radius": 0.0, "friction": 0.0}
        spec["recordings"] = {
            "a": _presses(np.array(REACH[body]), np.random.default_rng(how + (self.seed // 1000 - 71) * N_PLANS))
        }
        spec["truth"] = [DRAWN.get(self.effect, _signed)(self.effect, rng)]
        end_at_balls(spec)
        if self.effect == "density":
            spec["declared"]["sigmas"] = {"youngs_modulus": 80.0}
        own = np.random.default_rng([self.seed, self.twin])
        spec["measuring"]["noise_px"] = float(own.choice(NOISES))
        spec["declared"]["element_size"] = 0.02
        spec["wrench"] = {"noise": 0.005} if own.random() < 0.5 else None
        return spec

    @property
    def settings(self) -> Settings:
        """Return the diagnosis's: the elements are another size in each twin."""
        vertices = VERTICES[(self.seed + self.twin) % len(VERTICES)]
        return Settings(sampling=SamplingSettings(moments_fit=MOMENTS, mesh_vertices=vertices))

    @property
    def true(self) -> dict[str, Any]:
        return dict(self.scenario()["truth"][0])


def _presses(reach: np.ndarray, rng: np.random.Generator) -> list[dict[str, Any]]:
    presses = []
    for depth in (0.004, 0.0065, 0.0055):
        at = [round(float(v), 4) for v in reach * rng.uniform(-1.0, 1.0, 2)]
        presses.append({"at": at, "depth": round(depth * rng.uniform(0.85, 1.15), 5), "hold": 1.5, "pause": 1.5})
    presses[1] |= {"retreat_speed": 0.05}
    return [*presses, {"at": [0.0, 0.0], "depth": 0.0015, "hold": 1.0}]


class FineTruth(HexSolver):
    """The blind test's truth, whose moduli that jump are integrated more finely than by the three points along each
    side of an element: of a layer of 5 mm in elements of 10 mm these make one of 4.4 mm."""

    def __init__(self, world: World, shape: TruthProbe) -> None:
        fine = tuple(_finely(field, world.mesh) for field in world.physics.modulus)
        super().__init__(world.body(modulus=fine), shape)


def _finely(field: Field, mesh: HexMesh, n: int = 8) -> Field:
    """Return a field that does not change with time at the Gauss points, with its moments up to the second."""
    x, w = np.polynomial.legendre.leggauss(3)
    fine = (2.0 * np.arange(n) + 1.0) / n - 1.0
    others = [np.delete(x, q) for q in range(3)]
    lagrange = np.array([np.prod([(fine - o) / (x[q] - o) for o in others[q]], axis=0) for q in range(3)])
    A = lagrange * 2.0 / n / w[:, None]
    grid = np.stack(np.meshgrid(fine, fine, fine, indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.einsum("qa,mad->mqd", hex_shape(grid)[0], mesh.nodes[mesh.hexes])
    values = field(places.reshape(-1, 3), 0.0).reshape(-1, n, n, n)
    low, high = (f(values, axis=(1, 2, 3))[:, None, None, None] for f in (np.min, np.max))
    at_points = np.clip(np.einsum("mabc,ia,jb,kc->mijk", values, A, A, A, optimize=True), low, high)
    # what is cut off above and below is not the same, and the mean over the element has to stay
    weights = np.einsum("i,j,k->ijk", w, w, w) / 8.0
    over, under = at_points - low, high - at_points
    more = (over * weights).sum(axis=(1, 2, 3), keepdims=True) - values.mean(axis=(1, 2, 3), keepdims=True) + low
    whole = (np.where(more > 0.0, over, under) * weights).sum(axis=(1, 2, 3), keepdims=True)
    share = np.divide(more, whole, out=np.zeros_like(whole), where=whole > 0.0)
    kept = (at_points - share * np.where(more > 0.0, over, under)).reshape(-1)
    return lambda X, t: kept


# --- true values
# ------------------------------------------------------------------------------------------------------


def _size(rng: np.random.Generator) -> float:
    return float(rng.uniform(2.0, 5.0))


def _signed(name: str, rng: np.random.Generator) -> dict[str, Any]:
    """An effect of a drawn size, in either direction where it has two."""
    one_way = {"strain_stiffening", "poisson_ratio", "base_slip"}
    size = _size(rng)
    return sized(name, size if name in one_way or rng.random() < 0.5 else -0.7 * size)


def _skin(name: str, rng: np.random.Generator) -> dict[str, Any]:
    return sized(name, _size(rng)) | {"thickness": round(float(rng.uniform(0.003, 0.009)), 5)}


def _inclusion(name: str, rng: np.random.Generator) -> dict[str, Any]:
    x, y = rng.uniform(-0.012, 0.012, 2)
    centre = [round(float(v), 4) for v in (x, y, rng.uniform(0.018, 0.028))]
    return {"name": name, "ratio": float(rng.uniform(3.0, 12.0)), "centre": centre,
            "radius": round(float(rng.uniform(0.006, 0.011)), 5)}  # fmt: skip


def _probe_offset(name: str, rng: np.random.Generator) -> dict[str, Any]:
    x, y, z = rng.normal(size=3) * _size(rng) * np.array([2.0e-4, 2.0e-4, 2.5e-4])
    return {"name": name, "translation": [float(x), float(y), float(z)]}


def _gravity_tilt(name: str, rng: np.random.Generator) -> dict[str, Any]:
    angle, size = rng.uniform(0.0, 2.0 * np.pi), 0.018 * _size(rng)
    return {"name": name, "angle_x": float(size * np.cos(angle)), "angle_y": float(size * np.sin(angle))}


def _camera_motion(name: str, rng: np.random.Generator) -> dict[str, Any]:
    size = _size(rng)
    translation, rotation = size * 5e-5 * rng.normal(size=3), size * 2e-4 * rng.normal(size=3)
    return {"name": name, "translation": translation.tolist(), "rotation": rotation.tolist(),
            "onset": round(float(rng.uniform(5.0, 9.0)), 3)}  # fmt: skip


DRAWN: dict[str, Callable[[str, np.random.Generator], dict[str, Any]]] = {
    "skin": _skin,
    "inclusion": _inclusion,
    "probe_offset": _probe_offset,
    "gravity_tilt": _gravity_tilt,
    "camera_motion": _camera_motion,
}


def cases(half: str, n: int = 180) -> list[Case]:
    """Return the cases of a half in their order: any part of them covers all effects."""
    return [Case(EFFECTS[k // TWINS % len(EFFECTS)], HALVES[half] + k // TWINS, k % TWINS) for k in range(n)]


# --- running
# ----------------------------------------------------------------------------------------------------------


def run_case(case: Case, out: Path, keep: bool) -> dict[str, Any]:
    """Make and fit one case and write ``out/<case>.json``, unless that is there; ``keep`` also writes what was fitted,
    for a look at why an interval missed.

    A case that raises has its ``error`` there, so that it is counted, and is begun again by the next run.
    """
    done = out / f"{case.name}.json"
    if done.is_file():
        result = dict(json.loads(done.read_text()))
        if "error" not in result:
            return result
    try:
        result = _made_and_fitted(case, out, keep)
    except Exception as error:  # one that cannot be made or fitted must not end the others
        result = {"case": case.name, "error": f"{type(error).__name__}: {error}"}
    temporary = done.with_suffix(".part")
    temporary.write_text(json.dumps(result, indent=1))
    temporary.replace(done)
    return result


def _made_and_fitted(case: Case, out: Path, keep: bool) -> dict[str, Any]:
    """Return what was fitted of a case, and the CPU seconds that it took."""
    folder, began = out / case.name, resources()
    shutil.rmtree(folder, ignore_errors=True)
    make(
        case.scenario(),
        folder,
        zlib.crc32(case.name.encode()),
        kept=out / "bodies",
        mesher=mesh_to_file,
        solver=FineTruth,
    )
    made = resources() - began
    inputs = read_inputs(
        folder / "experiment", [folder / "bags" / "a"], [],
        candidates=[case.effect], processes=2, settings=case.settings,
    )  # fmt: skip
    assert inputs.forward is not None  # read_inputs makes one
    with inputs.forward as forward:
        method = ForwardSelection.of(
            inputs.settings, forward, inputs.fitted, inputs.candidates, inputs.uncertain,
            refined_mesh=inputs.refined_mesh, max_effects=1,
        )  # fmt: skip
        model, problem = fitted_given(method, inputs.candidates[case.effect])
    result = _result(case, inputs.fitted, inputs.element_size, model, problem) | {
        "made": made,
        "seconds": resources() - began - made,
    }
    if keep:
        with (out / f"{case.name}.pickle").open("wb") as file:
            pickle.dump((inputs.fitted, inputs.uncertain, inputs.element_size, model, problem), file)
    shutil.rmtree(folder, ignore_errors=True)
    return result


def fitted_given(method: ForwardSelection, candidate: Candidate) -> tuple[FittedModel, Problem]:
    """Fit an effect as a diagnosis that names it does, however little speaks for it; also return the problem."""
    last = method.linearised(method.declared, None, None)
    (best,) = method.screen(method.declared, last.problem, last.dictionary).scores
    tried = [replace(method.declared, added=(Added(candidate, z),)) for z in method.starts_of(best)]
    fits = [f for f in (method.fitter.refit(last.problem, model) for model in tried) if f is not None]
    model = max(fits, key=_gain_of, default=tried[0])
    model = method.mesh.corrected(last.problem, model, method.settings.passes)
    return method.settle(last.problem, method.freed(last.problem, model))


def _gain_of(model: FittedModel) -> float:
    return -np.inf if model.joint is None else model.joint.gain


def again(case: Case, out: Path) -> None:
    """State the intervals of a kept fit once more."""
    done, kept = out / f"{case.name}.json", out / f"{case.name}.pickle"
    if not kept.is_file():
        return
    fitted, _, element_size, model, problem = pickle.loads(kept.read_bytes())
    result = json.loads(done.read_text()) | _result(case, fitted, element_size, model, problem)
    done.write_text(json.dumps(result, indent=1))


def _result(
    case: Case, fitted: Sequence[Observation], element_size: float, model: FittedModel, problem: Problem
) -> dict[str, Any]:
    """Return what was fitted beside what is true: ``numbers`` of [parameter, value, sigma, true value, lower and upper
    end of the interval]."""
    numbers = []
    covariance = stated_covariance(model, problem, fitted, case.settings, element_size)
    for effect in fitted_values(model, covariance):
        for name, value in effect.values.items():
            true = np.atleast_1d(np.asarray(case.true[name], float))
            sigma = np.atleast_1d(np.asarray(effect.sigmas.get(name, np.full(true.shape, np.nan)), float))
            ends = np.asarray(effect.intervals.get(name, np.full((*true.shape, 2), np.nan)), float).reshape(-1, 2)
            for i, numbered in enumerate(zip(np.atleast_1d(value), sigma, true, *ends.T, strict=True)):
                label = name if true.size == 1 else f"{name}[{i}]"
                numbers.append([label, *map(float, numbered)])
    return {"effect": case.effect, "family": family_of(model.added[0].candidate.info), "numbers": numbers}


# --- the table
# --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Number:
    """One fitted number of a case: its ``family``, by how many of its stated sigmas it is off (``z``), and whether its
    interval ``held`` the truth."""

    family: str
    parameter: str
    z: float
    held: bool


def numbers_of(result: Mapping[str, Any]) -> list[Number]:
    """Return the numbers of a result."""
    return [
        Number(result["family"], f"{result['effect']}.{name}", (value - true) / sigma, low <= true <= high)
        for name, value, sigma, true, low, high in result["numbers"]
    ]


def table(results: Iterable[Mapping[str, Any]]) -> list[str]:
    """Tabulate each family's coverage, and what its parameters are off by; those that have no fit are listed last."""
    begun = list(results)
    fitted = [r for r in begun if "error" not in r]
    numbers = [n for r in fitted for n in numbers_of(r)]
    lines = [f"{len(fitted)} experiments"]
    if len(fitted) < len(begun):
        lines[0] += f"; {len(begun) - len(fitted)} of {len(begun)} could not be made or fitted, and are in no share"
    for family in sorted({n.family for n in numbers}):
        lines.append(_line(family, [n for n in numbers if n.family == family]))
    lines += [_line("all", numbers), ""]
    for parameter in sorted({n.parameter for n in numbers}):
        lines.append(_line(parameter, [n for n in numbers if n.parameter == parameter]))
    return lines + [f"without a fit: {r['case']}: {r['error']}" for r in begun if "error" in r]


def _line(what: str, numbers: Sequence[Number]) -> str:
    k, n = sum(x.held for x in numbers), len(numbers)
    if not n:
        return f"{what:32s} -"
    low, high = bounds(k, n)
    z = np.array([x.z for x in numbers])
    return (
        f"{what:32s} {100 * k / n:5.1f} %  ({k} of {n}, 95 %: {100 * low:.0f}-{100 * high:.0f})  "
        f"median |z| {np.median(np.abs(z)):.2f}, median z {np.median(z):+.2f}, largest {np.abs(z).max():.1f}"
    )


def _told(result: Mapping[str, Any]) -> str:
    """Say in a line what came of a case."""
    if "error" in result:
        return str(result["error"])
    z = " ".join(f"{n.parameter.split('.')[1]} {n.z:+.1f}" for n in numbers_of(result))
    return f"{z}  ({result['made']:.0f} + {result['seconds']:.0f} s)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run or print the wanted cases; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["run", "again", "table"])
    parser.add_argument("--half", choices=list(HALVES), default="proof")
    parser.add_argument("--out", type=Path, default=Path("out/coverage"))
    parser.add_argument("--limit", type=int, default=180)
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    parser.add_argument("--keep", action="store_true", help="keep what was fitted")
    options = parser.parse_args(arguments)
    wanted = [c for c in cases(options.half, options.limit) if options.only in c.name]
    if not wanted:
        parser.error(
            f"none of the first {options.limit} cases has '{options.only}' in its name: see --limit and --only"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "run":
        os.environ.update(ONE_THREAD)
        for case in wanted:
            print(f"{case.name}: {_told(run_case(case, options.out, options.keep))}", flush=True)
    if options.what == "again":
        for case in wanted:
            again(case, options.out)
    done = [options.out / f"{c.name}.json" for c in wanted]
    print("\n".join(table(json.loads(p.read_text()) for p in done if p.is_file())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
