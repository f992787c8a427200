"""The gelatin cuboid under its weight against codes that nobody here wrote: the reference of `livedeform study cuboid`.

    python benchmarks/fem_reference.py [--reference FILE] [--element p2p0] [--sizes 0.00833] [--only "linear bonded"]

A quarter with symmetry planes: the reference is the symmetric solution (the whole soft cuboid would lean to one side).
The mesh is the study's, graded towards the rim of the base; with ``--sizes`` even ones instead. A warm step is the
equilibrium under 1 % more weight, from the one before it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from livedeform import studies
from livedeform.common.errors import ConvergenceError
from livedeform.fem_node.element.element import ElementKind, Space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support
from livedeform.studies.bodies import GRADED_CELLS, GRADED_GROWTH, quarter_block

REFERENCE = Path(studies.__file__).parent / "reference" / "cuboid_fem.json"
MODELS = {"linear": "linear", "neo_hookean_isochoric": "neo_hookean", "neo_hookean_log": "neo_hookean_log"}
SIDE, HEIGHT, GRAVITY = 0.05, 0.07, np.array([0.0, 0.0, -9.81])
WARM = (1.01, 1.0, 1.01, 1.0, 1.01)  # of the weight


def plane(axis: int):
    """The points of a coordinate plane."""
    return lambda X: np.abs(X[:, axis]) < 1e-9


def mesh_of(size: float | None, element: ElementKind) -> Space:
    """The quarter in even cells of ``size`` m, or graded."""
    if size is None:
        return quarter_block((SIDE, SIDE, HEIGHT), GRADED_CELLS, growth=GRADED_GROWTH, element=element)
    n = (round(SIDE / 2 / size), round(SIDE / 2 / size), round(HEIGHT / size))
    return quarter_block((SIDE, SIDE, HEIGHT), n, element=element)


def shortening(model: str, E: float, nu: float, base: str, space: Space) -> tuple[float, float]:
    """Shortening (m) of the top's centre, and the CPU seconds of a warm step."""
    bottom = Support(plane(2), "fixed" if base == "bonded" else "sliding")
    supports = (bottom, Support(plane(0), "sliding"), Support(plane(1), "sliding"))
    body = Mechanics(space, Physics(MaterialSpec(model, E, nu), supports=supports))
    top = np.argmin(np.linalg.norm(space.nodes - [0.0, 0.0, HEIGHT], axis=1))
    body.advance(Moment(0.0, np.inf, GRAVITY))
    found, seconds = -float(body.u[top, 2]), []
    for g in WARM:
        began = time.process_time()
        body.advance(Moment(0.0, np.inf, g * GRAVITY))
        seconds.append(time.process_time() - began)
    return found, float(np.median(seconds))


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
    parser.add_argument("--sizes", type=float, nargs="+", default=[None], help="m; three or more are extrapolated")
    parser.add_argument("--only", default="", help="text that the row must hold")
    arguments = parser.parse_args()
    worst: dict[str, float] = {}
    slowest = 0.0
    for row in json.loads(arguments.reference.read_text())["values"]:
        E, nu, base = row["youngs_modulus"], row["poisson_ratio"], row["base"]
        name = f"{row['model']} {base} E {E:.0f} nu {nu}"
        if arguments.only not in name:
            continue
        expected = row["shortening_top_centre"]
        print(f"{name:46s} {1e3 * expected:8.3f} mm +- {100.0 * row['uncertainty'] / expected:.2f} %", flush=True)
        values: list[float] = []
        for size in arguments.sizes:
            label = "   graded" if size is None else f"{1e3 * size:6.2f} mm"
            try:
                space = mesh_of(size, arguments.element)
                found, warm = shortening(MODELS[row["model"]], E, nu, base, space)
            except ConvergenceError as error:
                print(f"    {label}  {error}", flush=True)
                break
            values.append(found)
            off = 100.0 * (found / expected - 1.0)
            print(
                f"    {label}  {1e3 * found:8.4f} mm  {off:+.2f} %  {space.n_dof} dof  "
                f"warm step {1e3 * warm:.0f} ms CPU",
                flush=True,
            )
        if len(values) >= 3:
            limit, order = extrapolated(values, arguments.sizes[: len(values)])
            print(f"    limit      {1e3 * limit:8.4f} mm  {100.0 * (limit / expected - 1.0):+.2f} %  order {order:.1f}")
        if values:
            kind = f"{row['model']} {base} E {E:.0f}"
            worst[kind] = max(worst.get(kind, 0.0), abs(100.0 * (values[-1] / expected - 1.0)))
            slowest = max(slowest, warm)
    for kind, off in worst.items():
        print(f"worst of {kind}: {off:.2f} %")
    print(f"slowest warm step on the last mesh: {1e3 * slowest:.0f} ms CPU")


if __name__ == "__main__":
    main()
