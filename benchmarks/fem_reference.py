"""The gelatin cuboid under its weight against codes that nobody here wrote: the reference of `livedeform study cuboid`.

    python benchmarks/fem_reference.py [--reference FILE] [--element p2p0] [--sizes 0.00833] [--only "linear bonded"]

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
from livedeform import studies
from livedeform_common.errors import ConvergenceError

REFERENCE = Path(studies.__file__).parent / "reference" / "cuboid_fem.json"
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


def extrapolated(values: list[float], sizes: list[float]) -> tuple[float, float]:
    """Limit and order of v(h) = v0 + c h^p through the three finest meshes (sizes fall)."""
    (a, b, c), (p, q, r) = values[-3:], sizes[-3:]

    def mismatch(order: float) -> float:
        return (b - a) * (q**order - r**order) - (c - b) * (p**order - q**order)

    orders = np.linspace(0.2, 5.0, 481)
    signs = np.array([mismatch(order) for order in orders])
    change = np.flatnonzero(np.sign(signs[:-1]) != np.sign(signs[1:]))
    if len(change) == 0:
        return float("nan"), float("nan")
    order = float(orders[change[0]])
    return c + (c - b) * r**order / (q**order - r**order), order


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reference", type=Path, default=REFERENCE)
    parser.add_argument("--element", default="p2p0")
    parser.add_argument("--sizes", type=float, nargs="+", default=[0.025 / 3], help="three or more are extrapolated")
    parser.add_argument("--only", default="", help="text that the row must hold")
    arguments = parser.parse_args()
    worst: dict[str, float] = {}
    for row in json.loads(arguments.reference.read_text())["values"]:
        E, nu, base = row["youngs_modulus"], row["poisson_ratio"], row["base"]
        name = f"{row['model']} {base} E {E:.0f} nu {nu}"
        if arguments.only not in name:
            continue
        expected = row["shortening_top_centre"]
        print(f"{name:46s} {1e3 * expected:8.3f} mm +- {100.0 * row['uncertainty'] / expected:.2f} %", flush=True)
        values: list[float] = []
        for size in arguments.sizes:
            try:
                found, n_dof, _ = shortening(MODELS[row["model"]], E, nu, base, arguments.element, size)
            except ConvergenceError as error:
                print(f"    {1e3 * size:6.2f} mm  {error}", flush=True)
                break
            values.append(found)
            off = 100.0 * (found / expected - 1.0)
            print(
                f"    {1e3 * size:6.2f} mm  {1e3 * found:8.4f} mm  {off:+.2f} %  {n_dof} dof",
                flush=True,
            )
        if len(values) >= 3:
            limit, order = extrapolated(values, arguments.sizes[: len(values)])
            print(f"    limit      {1e3 * limit:8.4f} mm  {100.0 * (limit / expected - 1.0):+.2f} %  order {order:.1f}")
        if values:
            kind = f"{row['model']} {base} E {E:.0f}"
            worst[kind] = max(worst.get(kind, 0.0), abs(100.0 * (values[-1] / expected - 1.0)))
    for kind, off in worst.items():
        print(f"worst of {kind}: {off:.2f} %")


if __name__ == "__main__":
    main()
