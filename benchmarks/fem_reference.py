"""The gelatin cuboid under its weight against codes that nobody here wrote (fem-reference.json of the design
documents).

    python benchmarks/fem_reference.py [--reference FILE] [--element p2p0] [--size 0.00833]

A quarter with symmetry planes: the reference is the symmetric solution (the whole soft cuboid would lean to one side).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from fem_node.element import make_space
from fem_node.items import Moment
from fem_node.mechanics import Mechanics
from fem_node.mesh_shapes import block_mesh
from fem_node.physics import MaterialSpec, Physics, Support
from livedeform_common.errors import ConvergenceError

REFERENCE = Path(__file__).parents[2] / "shared" / "design" / "fem-reference.json"
MODELS = {"linear": "linear", "neo_hookean_isochoric": "neo_hookean", "neo_hookean_log": "neo_hookean_log"}
SIDE, HEIGHT, GRAVITY = 0.05, 0.07, np.array([0.0, 0.0, -9.81])


def plane(axis: int):
    """The points of a coordinate plane."""
    return lambda X: np.abs(X[:, axis]) < 1e-9


def shortening(model: str, E: float, nu: float, base: str, element: str, size: float) -> tuple[float, int, float]:
    """Shortening (m) of the top's centre, unknowns, seconds."""
    n = (round(SIDE / 2 / size), round(SIDE / 2 / size), round(HEIGHT / size))
    space = make_space(block_mesh((SIDE / 2, SIDE / 2, HEIGHT), n, origin=(0.0, 0.0, 0.0)), element)
    supports = (Support(plane(2), "fixed" if base == "bonded" else "sliding"),)
    supports += (Support(plane(0), "sliding"), Support(plane(1), "sliding"))
    body = Mechanics(space, Physics(MaterialSpec(model, E, nu), supports=supports))
    top = np.argmin(np.linalg.norm(space.nodes - [0.0, 0.0, HEIGHT], axis=1))
    began = time.perf_counter()
    body.advance(Moment(0.0, np.inf, GRAVITY))
    return -float(body.u[top, 2]), space.n_dof, time.perf_counter() - began


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reference", type=Path, default=REFERENCE)
    parser.add_argument("--element", default="p2p0")
    parser.add_argument("--size", type=float, default=0.025 / 3)
    parser.add_argument("--only", default="", help="text that the row must hold")
    arguments = parser.parse_args()
    worst: dict[str, float] = {}
    for row in json.loads(arguments.reference.read_text())["values"]:
        name = f"{row['model']} {row['base']} E {row['youngs_modulus']:.0f} nu {row['poisson_ratio']}"
        if arguments.only not in name:
            continue
        expected = row["shortening_top_centre"]
        try:
            found, n_dof, seconds = shortening(
                MODELS[row["model"]],
                row["youngs_modulus"],
                row["poisson_ratio"],
                row["base"],
                arguments.element,
                arguments.size,
            )
        except ConvergenceError as error:
            print(f"{name:58s} {1e3 * expected:8.3f} mm  {error}")
            continue
        off = 100.0 * (found / expected - 1.0)
        spread = 100.0 * row["uncertainty"] / expected
        print(
            f"{name:58s} {1e3 * expected:8.3f} mm  found {1e3 * found:8.3f} mm"
            f"  {off:+.2f} % (reference +- {spread:.2f} %)  {n_dof} dof  {seconds:.2f} s",
            flush=True,
        )
        kind = f"{row['model']} {row['base']}"
        worst[kind] = max(worst.get(kind, 0.0), abs(off))
    for kind, off in worst.items():
        print(f"worst of {kind}: {off:.2f} %")


if __name__ == "__main__":
    main()
