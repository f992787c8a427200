"""Assembly and one Newton solution against felupe and scikit-fem: same mesh, element (p2), material, loads and
tolerance.

    python benchmarks/fem_speed.py [--cells 10] [--press 0.001]

A block of gel, bonded base, pressed at its top by displacing a patch (no contact: the peers have none of this
kind), from the state under its weight: one warm full nonlinear step. CPU times (the machine is shared), the least of
three runs, after one for the compilers.

Measured on 2 shared cores, one thread each, 14 553 unknowns, all with the same answer: assembly 5.1 ms against 59 ms
(felupe, the faster of two measurements, 59 and 69 ms: 11.6 times) and 2640 ms (scikit-fem, 516 times); the step 0.17 s
against 5.4 s (felupe with its own solver, 31 times), 1.4 s (felupe with our solver, 8.2 times), 8.8 s (scikit-fem with
our solver, 52 times).

Where the assembly's time goes (while other processes keep both cores busy: 5.9 ms in all): stiffness 3.0 ms, some 1.3
of it the products and the rest adding 1.4 million numbers into the matrix; material 0.9; volume's tangent 0.4; zeroing
the matrix 0.3; deformation gradients and nodal forces 0.5. The next factor would need both cores, and single precision
for the linear solver.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np

from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.solver import SolverSettings

E, NU, SIZE, HEIGHT, TOLERANCE = 4000.0, 0.49, 0.1, 0.05, 1e-6
GRAVITY = np.array([0.0, 0.0, -9.81])
OTHER_SIZES = (4, 6, 8, 14)  # cells a side: how the step grows with the mesh


class Patch(PlainItem):
    """Top nodes near the middle, displaced downwards by ``depth`` from where the weight brought them."""

    def __init__(self, nodes: np.ndarray, start: np.ndarray) -> None:
        self.nodes, self.start, self.depth = nodes, start, 0.0

    def evaluate(self, x: np.ndarray, system: System, *, tangent: bool) -> float:
        return 0.0

    def constraints(self) -> tuple[np.ndarray, np.ndarray]:
        return 3 * self.nodes + 2, self.start - self.depth


def least(run: Callable[[], object], times: int = 3) -> float:
    """Seconds of the fastest of some runs, after one that is not counted."""
    run()
    found = []
    for _ in range(times):
        began = time.process_time()
        run()
        found.append(time.process_time() - began)
    return min(found)


def once(run: Callable[[], object]) -> float:
    """CPU seconds of one run."""
    began = time.process_time()
    run()
    return time.process_time() - began


def patch_nodes(nodes: np.ndarray) -> np.ndarray:
    """Top nodes under a face of 60 x 15 mm."""
    return np.flatnonzero(
        (nodes[:, 2] > HEIGHT - 1e-9) & (np.abs(nodes[:, 0]) < 0.031) & (np.abs(nodes[:, 1]) < 0.0085)
    )


def ours(cells: int, press: float, element: str) -> dict[str, float]:
    """Seconds of assembly and of the step; the step's displacement for comparison."""
    mesh = block_mesh((SIZE, SIZE, HEIGHT), (cells, cells, cells // 2), origin=(-SIZE / 2, -SIZE / 2, 0.0))
    space = make_space(mesh, element)
    physics = Physics(MaterialSpec("neo_hookean", E, NU), supports=(Support(lambda X: X[:, 2] < 1e-9),))
    body = Mechanics(space, physics, settings=SolverSettings(tolerance=TOLERANCE))
    weight = Moment(0.0, np.inf, GRAVITY)
    body.advance(weight)
    x0, patch = body.x.copy(), patch_nodes(space.nodes)
    solver = body.solver
    assembly = least(lambda: solver.evaluate(x0, solver.system, tangent=True))
    body.items.append(Patch(patch, x0[3 * patch + 2]))
    iterations = []

    def step() -> None:
        body.items[-1].depth = press
        solver.drop_factor()
        solution = solver.solve(x0, weight, weight)
        iterations.append((solution.n_iterations, solution.n_factorisations))
        body.x = solution.x

    seconds = least(step)
    return {
        "n_dof": space.n_dof,
        "assembly": assembly,
        "step": seconds,
        "iterations": iterations[-1][0],
        "factorisations": iterations[-1][1],
        "side": float(np.abs(body.u[:, 0]).max()),
    }


def felupes(cells: int, press: float, *, pardiso: bool) -> dict[str, float]:
    """The same with felupe's quadratic tetrahedra and scipy's sparse solver (its default) or PARDISO."""
    import felupe
    from pypardiso import spsolve as fast
    from scipy.sparse.linalg import spsolve as slow

    mesh = block_mesh((SIZE, SIZE, HEIGHT), (cells, cells, cells // 2), origin=(-SIZE / 2, -SIZE / 2, 0.0))
    space = make_space(mesh, "p2")
    region = felupe.RegionQuadraticTetra(felupe.Mesh(space.nodes, space.cells, "tetra10"))
    field = felupe.FieldContainer([felupe.Field(region, dim=3)])
    mu, bulk = E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))
    solid = felupe.SolidBody(felupe.NeoHooke(mu=mu, bulk=bulk), field)
    weight = felupe.SolidBodyForce(field, values=list(1000.0 * GRAVITY))
    base = felupe.Boundary(field[0], fz=0.0)
    patch = patch_nodes(space.nodes)

    def assemble() -> None:
        solid.assemble.vector(field)
        solid.assemble.matrix(field)

    def solve(boundaries: dict) -> int:
        dof0, dof1 = felupe.dof.partition(field, boundaries)
        ext0 = felupe.dof.apply(field, boundaries, dof0)
        found = felupe.newtonraphson(
            items=[solid, weight],
            dof0=dof0,
            dof1=dof1,
            ext0=ext0,
            solver=fast if pardiso else slow,
            tol=1e-5,
            verbose=0,
        )
        return found.iterations

    solve({"base": base})
    u0 = field[0].values.copy()
    assembly = least(assemble)
    iterations = []

    def step() -> None:
        field[0].values[:] = u0
        mask = np.zeros((space.n_nodes, 3), bool)
        mask[patch, 2] = True
        pressed = felupe.Boundary(field[0], mask=mask, value=u0[patch, 2] - press)
        iterations.append(solve({"base": base, "patch": pressed}))

    seconds = least(step, times=1) if pardiso else once(step)
    return {
        "n_dof": 3 * space.n_nodes,
        "assembly": assembly,
        "step": seconds,
        "iterations": iterations[-1],
        "factorisations": iterations[-1],
        "side": float(np.abs(field[0].values[:, 0]).max()),
    }


def scikit_fems(cells: int, press: float) -> dict[str, float]:
    """The same with scikit-fem's quadratic tetrahedra and PARDISO; stress and tangent written out as its forms."""
    import skfem
    from pypardiso import spsolve
    from skfem.helpers import ddot, det, dot, grad, identity, inv, mul, transpose

    mesh = block_mesh((SIZE, SIZE, HEIGHT), (cells, cells, cells // 2), origin=(-SIZE / 2, -SIZE / 2, 0.0))
    basis = skfem.Basis(skfem.MeshTet(mesh.nodes.T, mesh.tets.T), skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
    mu, bulk = E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))

    def parts(w):
        F = grad(w["u"]) + identity(grad(w["u"]))
        J, T = det(F), transpose(inv(F))
        return F, J, T, mu * J ** (-2 / 3), ddot(F, F)

    @skfem.LinearForm
    def residual(v, w):
        F, J, T, m, t = parts(w)
        P = m * (F - t / 3 * T) + bulk * J * (J - 1) * T
        return ddot(P, grad(v)) - 1000.0 * dot(GRAVITY[:, None, None] + 0.0 * w.x, v)

    @skfem.BilinearForm
    def tangent(u, v, w):
        F, J, T, m, t = parts(w)
        H = grad(u)
        TH, FH, dT = ddot(T, H), ddot(F, H), -mul(mul(T, transpose(H)), T)
        dP = m * (H - 2 / 3 * FH * T - t / 3 * dT) - 2 / 3 * m * TH * (F - t / 3 * T)
        dP = dP + bulk * (J * (2 * J - 1) * TH * T + J * (J - 1) * dT)
        return ddot(dP, grad(v))

    def assemble(u):
        field = basis.interpolate(u)
        return skfem.asm(tangent, basis, u=field), skfem.asm(residual, basis, u=field)

    def solve(u, held, values) -> tuple[np.ndarray, int]:
        u = u.copy()
        for iteration in range(30):
            K, r = assemble(u)
            step = np.zeros_like(u)
            step[held] = values - u[held]
            free = np.setdiff1d(np.arange(len(u)), held)
            K = K.tocsr()
            step[free] = spsolve(K[free][:, free], -r[free] - K[free][:, held] @ step[held])
            u += step
            if np.abs(step).max() < TOLERANCE:
                return u, iteration + 1
        raise RuntimeError("scikit-fem did not converge")

    x, y, z = basis.doflocs
    component = np.zeros(basis.N, int)
    for name, axis in (("u^1", 0), ("u^2", 1), ("u^3", 2)):
        component[basis.get_dofs(elements=True).all([name])] = axis
    base = np.flatnonzero(z < 1e-9)
    patch = (z > HEIGHT - 1e-9) & (np.abs(x) < 0.031) & (np.abs(y) < 0.0085)
    patch = np.flatnonzero(patch & (component == 2))
    u0, _ = solve(np.zeros(basis.N), base, np.zeros(len(base)))
    held = np.concatenate([base, patch])
    values = np.concatenate([np.zeros(len(base)), u0[patch] - press])
    assembly = least(lambda: assemble(u0), times=2)
    found = []
    seconds = once(lambda: found.append(solve(u0, held, values)))
    u, iterations = found[0]
    return {
        "n_dof": basis.N,
        "assembly": assembly,
        "step": seconds,
        "iterations": iterations,
        "factorisations": iterations,
        "side": float(np.abs(u[component == 0]).max()),
    }


def main() -> None:
    """Prints the table and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--press", type=float, default=0.001)
    arguments = parser.parse_args()
    rows = {name: ours(arguments.cells, arguments.press, name) for name in ("p2", "p2p0", "p2p1")}
    rows |= {f"p2p0, {n} cells a side": ours(n, arguments.press, "p2p0") for n in OTHER_SIZES}
    rows["felupe p2 (PARDISO)"] = felupes(arguments.cells, arguments.press, pardiso=True)
    rows["scikit-fem p2 (PARDISO)"] = scikit_fems(arguments.cells, arguments.press)
    rows["felupe p2 (its own)"] = felupes(arguments.cells, arguments.press, pardiso=False)
    for name, r in rows.items():
        print(
            f"{name:24s} {r['n_dof']:6.0f} dof  assembly {1e3 * r['assembly']:8.1f} ms  step {r['step']:7.2f} s CPU"
            f"  iterations {r['iterations']:.0f} (factorisations {r['factorisations']:.0f})"
            f"  bulge {1e3 * r['side']:.4f} mm"
        )
    peer, mine = rows["felupe p2 (PARDISO)"], rows["p2"]
    own = rows["felupe p2 (its own)"]
    assembly = min(peer["assembly"], own["assembly"])  # the same work, measured twice
    print(
        f"felupe / ours: assembly {assembly / mine['assembly']:.1f}, step {own['step'] / mine['step']:.1f} "
        f"as it comes, {peer['step'] / mine['step']:.1f} with our linear solver"
    )
    peer = rows["scikit-fem p2 (PARDISO)"]
    ratios = [peer[what] / mine[what] for what in ("assembly", "step")]
    print(f"scikit-fem / ours: assembly {ratios[0]:.0f}, step {ratios[1]:.0f} with our linear solver")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB, peers included")


if __name__ == "__main__":
    main()
