"""Six bodies in six triangulations: is the model's answer that of the body that was given?

    python benchmarks/bodies_grid.py OUT.jsonl [--bodies box,L] [--parts 4,5,6] [--table]

Every case is one body, triangulation, element size and support (bonded or sliding), under its weight and then pressed
on the middle of its top. Element sizes are the body's least thickness over ``--parts``. The answer is how far the
middle of the top, a region given by geometry, sinks in the mean: by the weight, and by the press on top of it. ``off``
is the difference in % from the fine triangulation's with elements of the same size, the larger of both. (Sideways a
bonded column near its buckling load leans by whatever little it is not upright: that is kept in ``moved``, and not
compared.)
Cases that are in OUT.jsonl already are not run again. `TUNED` says which bodies the limits of meshing were chosen on;
the others, and every other seed of noise, are held out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triangulations import SHAPES, TRIANGULATIONS, surface

from livedeform.common.errors import ConvergenceError, LivedeformError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.supports import check_caught
from livedeform.fem_node.mesh.generate import mesh_warnings, meshed
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import DeadLoad, MaterialSpec, Physics, Support
from livedeform.fem_node.surface.surface import merge_vertices

TUNED = ("box", "dome")
THIN = {"box": 0.05, "cylinder": 0.05, "L": 0.025, "dome": 0.035, "slab": 0.02, "breast": 0.045}  # m
LIMIT = 0.5  # % of the motion
BASE = 0.001  # m: the support's region ends there; two standard deviations of the noisiest scan above the base
MODULUS, POISSON, DENSITY, GRAVITY = 2896.0, 0.49, 1000.0, 9.81
SLIDING = 500.0  # Pa/m along the base: far softer than the body, only so that it cannot drift
MIDDLE, PRESS = 0.012, 0.05  # m: radius of the pressed part of the top, and the force on it in N
Case = dict[str, Any]


def on_top(name: str, X: Array) -> NDArray[np.bool_]:
    """Which of the points (n, 3) m are in the middle of the top, if they are on the surface."""
    return np.asarray((np.hypot(X[:, 0], X[:, 1]) < MIDDLE) & (X[:, 2] > 0.5 * SHAPES[name].height))


def points_on(name: str) -> Array:
    """(n, 3) m spread evenly over the middle of the top."""
    vertices, _ = surface(name, "fine")
    return vertices[on_top(name, vertices)]


def answer(name: str, mesh: TetMesh, given: tuple[Array, Any], support: str) -> list[list[float]]:
    """How far (2, 3) m the middle of the top moves in the mean: by the weight, and further by the press."""
    region = Support(lambda X: X[:, 2] < BASE, "fixed" if support == "bonded" else "spring", stiffness=SLIDING)
    physics = Physics(
        material=MaterialSpec("neo_hookean", MODULUS, POISSON, {}),
        density=DENSITY,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        supports=(region,),
    )
    press = DeadLoad("press", lambda X: on_top(name, X), np.array([0.0, 0.0, -PRESS]))
    space = make_space(mesh, "p2p0")
    check_caught(space, physics.supports, *given)
    points, places = points_on(name), []
    for physics_of in (physics, replace(physics, loads=(press,))):
        moment = PhantomModel(space, physics_of, markers=points).predict(None, 0)
        if not moment.converged:
            raise ConvergenceError(moment.message)
        places.append(moment.markers.mean(axis=0))
    return [(places[0] - points.mean(axis=0)).tolist(), (places[1] - places[0]).tolist()]


def run(name: str, triangulation: str, size: float, support: str, seed: int) -> Case:
    """One case; ``refused`` has the reason where there is no answer."""
    case: Case = dict(body=name, triangulation=triangulation, size=size, support=support, seed=seed)
    began = time.perf_counter()
    try:
        given = merge_vertices(*surface(name, triangulation, seed))
        mesh, report = meshed(*given, size)
        case |= dict(nodes=report.n_nodes, hash=report.digest, repairs=report.repairs)
        case["warned"] = mesh_warnings(report, size)
        case["moved"] = answer(name, mesh, given, support)
    except LivedeformError as error:
        case["refused"] = str(error)
    return case | dict(seconds=round(time.perf_counter() - began, 1))


def off(case: Case, fine: Case) -> float:
    """% by which a case sinks otherwise than the fine triangulation, the larger of weight and press."""
    a, b = (np.array(c["moved"])[:, 2] for c in (case, fine))
    return float(100.0 * np.abs(a / b - 1.0).max())


def table(cases: list[Case]) -> None:
    """Solved within `LIMIT`, solved otherwise, and refused, for the bodies that were tuned on and the others."""
    fine = {(c["body"], c["size"], c["support"]): c for c in cases if c["triangulation"] == "fine"}
    rows = []
    for c in cases:
        reference = fine.get((c["body"], c["size"], c["support"]))
        if reference is None or "refused" in reference or c["triangulation"] == "fine":
            continue
        error = off(c, reference) if "moved" in c else np.nan
        rows.append((c, error))
        said = c.get("refused") or " | ".join([*c["repairs"], *c["warned"]])
        print(
            f"{c['body']:9}{c['triangulation']:13}{1e3 * c['size']:5.2f} mm  {c['support']:8}seed {c['seed']}  "
            f"off {error:6.2f} %  {c['seconds']:6.1f} s  {said}"
        )
    for part, mine in (("tuned on", True), ("held out", False)):
        some = [(c, e) for c, e in rows if (c["body"] in TUNED and c["seed"] == 0) == mine]
        for kind in ("drawn", "scan"):
            of = [(c, e) for c, e in some if c["triangulation"].startswith("scan") == (kind == "scan")]
            good, refused = sum(e <= LIMIT for _, e in of), sum("refused" in c for c, _ in of)
            warned = sum(e > LIMIT and bool(c["warned"]) for c, e in of)
            print(
                f"{part}, {kind}: {len(of)} cases, {good} within {LIMIT} %, {refused} refused, "
                f"{warned} off with a warning, {len(of) - good - refused - warned} off without"
            )


def cases_of(
    names: list[str], parts: list[float], kinds: list[str], seeds: list[int]
) -> Iterator[tuple[str, str, float, str, int]]:
    """The fine triangulation of each group first: the others are compared with it."""
    for part, name, kind, support in product(parts, names, ["fine", *kinds], ("bonded", "sliding")):
        for seed in seeds if kind.startswith("scan") else seeds[:1]:
            yield name, kind, round(THIN[name] / part, 5), support, seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--bodies", default=",".join(SHAPES))
    parser.add_argument("--parts", default="4,5,6", help="elements through the least thickness")
    parser.add_argument("--kinds", default=",".join(t for t in TRIANGULATIONS if t != "fine"))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--table", action="store_true", help="print what is there, run nothing")
    options = parser.parse_args()
    done = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.is_file() else []
    known = {(c["body"], c["triangulation"], c["size"], c["support"], c["seed"]): c for c in done}
    names, kinds = options.bodies.split(","), options.kinds.split(",")
    parts, seeds = [float(p) for p in options.parts.split(",")], [int(s) for s in options.seeds.split(",")]
    wanted = cases_of(names, parts, kinds, seeds)
    for case in wanted if not options.table else ():
        if case in known:
            continue
        known[case] = run(*case)
        with options.out.open("a") as file:
            file.write(json.dumps(known[case]) + "\n")
    table(list(known.values()))


if __name__ == "__main__":
    main()
