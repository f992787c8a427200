"""Six bodies in six triangulations: is the model's answer that of the body that was given?

    python benchmarks/bodies_grid.py OUT.jsonl [--bodies box,L] [--sizes 12,10,8] [--table]

Every case is one body, triangulation, element size and support (bonded or sliding), under its weight and then pressed
on its top. Its answer, the motion of points on the surface by the weight and by the press, is compared with
that of the fine triangulation with elements of the same size; ``off`` is the rms difference in % of the rms motion.
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
from triangulations import SHAPES, TRIANGULATIONS, surface

from livedeform.common.errors import ConvergenceError, LivedeformError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.supports import check_caught
from livedeform.fem_node.mesh.generate import mesh_warnings, meshed
from livedeform.fem_node.mesh.surface import merge_vertices
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import DeadLoad, MaterialSpec, Physics, Support

TUNED = ("box", "dome")
LIMIT = 0.5  # % of the motion
BASE = 0.0025  # m: the support's region ends there; five standard deviations of the noisiest scan above the base
MODULUS, POISSON, DENSITY, GRAVITY = 2896.0, 0.49, 1000.0, 9.81
SLIDING = 500.0  # Pa/m along the base: far softer than the body, only so that it cannot drift
CAP, PRESS = 0.006, 0.1  # m under the top on which the press acts, and its force in N
Case = dict[str, Any]


def points_on(name: str) -> Array:
    """(n, 3) m on the fine surface, away from the base."""
    vertices, _ = surface(name, "fine")
    high = vertices[vertices[:, 2] > 0.3 * SHAPES[name].height]
    return np.asarray(high[np.random.default_rng(1).choice(len(high), 60, replace=False)])


def answer(name: str, mesh: TetMesh, given: tuple[Array, Any], support: str) -> list[list[float]]:
    """Where the points are under the weight, and with the press as well (2 * n, 3) m."""
    region = Support(lambda X: X[:, 2] < BASE, "fixed" if support == "bonded" else "spring", stiffness=SLIDING)
    top = SHAPES[name].height - CAP
    physics = Physics(
        material=MaterialSpec("neo_hookean", MODULUS, POISSON, {}),
        density=DENSITY,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        supports=(region,),
    )
    pressed = replace(physics, loads=(DeadLoad("press", lambda X: X[:, 2] > top, np.array([0.0, 0.0, -PRESS])),))
    space = make_space(mesh, "p2p0")
    check_caught(space, physics.supports, *given)
    places = []
    for physics_of in (physics, pressed):
        moment = PhantomModel(space, physics_of, markers=points_on(name)).predict(None, 0)
        if not moment.converged:
            raise ConvergenceError(moment.message)
        places.append(moment.markers)
    return np.concatenate(places).tolist()


def run(name: str, triangulation: str, size: float, support: str, seed: int) -> Case:
    """One case; ``refused`` has the reason where there is no answer."""
    case: Case = dict(body=name, triangulation=triangulation, size=size, support=support, seed=seed)
    began = time.perf_counter()
    try:
        given = merge_vertices(*surface(name, triangulation, seed))
        mesh, report = meshed(*given, size)
        case |= dict(nodes=report.n_nodes, hash=report.digest, repairs=report.repairs)
        case["warned"] = mesh_warnings(report, size)
        case["places"] = answer(name, mesh, given, support)
    except LivedeformError as error:
        case["refused"] = str(error)
    return case | dict(seconds=round(time.perf_counter() - began, 1))


def off(case: Case, fine: Case) -> float:
    """% of the motion by which a case differs from the fine triangulation's, the larger of weight and press."""
    start = points_on(case["body"])
    a, b = (np.array(c["places"]).reshape(2, -1, 3) for c in (case, fine))
    return float(100.0 * max(np.sqrt(((a - b) ** 2).sum((1, 2)) / ((b - start) ** 2).sum((1, 2)))))


def table(cases: list[Case]) -> None:
    """Solved within `LIMIT`, solved otherwise, and refused, for the bodies that were tuned on and the others."""
    fine = {(c["body"], c["size"], c["support"]): c for c in cases if c["triangulation"] == "fine"}
    rows = []
    for c in cases:
        reference = fine.get((c["body"], c["size"], c["support"]))
        if reference is None or "refused" in reference or c["triangulation"] == "fine":
            continue
        error = off(c, reference) if "places" in c else np.nan
        rows.append((c, error))
        said = c.get("refused") or " | ".join([*c["repairs"], *c["warned"]])
        print(
            f"{c['body']:9}{c['triangulation']:13}{1e3 * c['size']:4.0f} mm  {c['support']:8}seed {c['seed']}  "
            f"off {error:6.2f} %  {c['seconds']:6.1f} s  {said}"
        )
    for part, mine in (("tuned on", True), ("held out", False)):
        some = [(c, e) for c, e in rows if (c["body"] in TUNED and c["seed"] == 0) == mine]
        for kind in ("drawn", "scan"):
            of = [(c, e) for c, e in some if c["triangulation"].startswith("scan") == (kind == "scan")]
            good, refused = sum(e <= LIMIT for _, e in of), sum("refused" in c for c, _ in of)
            print(
                f"{part}, {kind}: {len(of)} cases, {good} within {LIMIT} %, {refused} refused, "
                f"{len(of) - good - refused} otherwise"
            )


def cases_of(names: list[str], sizes: list[float], seeds: list[int]) -> Iterator[tuple[str, str, float, str, int]]:
    """The fine triangulation of each group first: the others are compared with it."""
    kinds = ("fine", *(t for t in TRIANGULATIONS if t != "fine"))
    for name, size, support, kind in product(names, sizes, ("bonded", "sliding"), kinds):
        for seed in seeds if kind.startswith("scan") else seeds[:1]:
            yield name, kind, size, support, seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--bodies", default=",".join(SHAPES))
    parser.add_argument("--sizes", default="12,10,8", help="mm")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--table", action="store_true", help="print what is there, run nothing")
    options = parser.parse_args()
    done = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.is_file() else []
    known = {(c["body"], c["triangulation"], c["size"], c["support"], c["seed"]): c for c in done}
    sizes = [1e-3 * float(s) for s in options.sizes.split(",")]
    wanted = cases_of(options.bodies.split(","), sizes, [int(s) for s in options.seeds.split(",")])
    for case in wanted if not options.table else ():
        if case in known:
            continue
        known[case] = run(*case)
        with options.out.open("a") as file:
            file.write(json.dumps(known[case]) + "\n")
    table(list(known.values()))


if __name__ == "__main__":
    main()
