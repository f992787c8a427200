"""Simple bodies under their weight or between platens, solved with fem_node's elements; symmetric ones as a quarter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import ElementKind, Space, make_space
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.loads import Weight
from livedeform.fem_node.items.protocol import Item, Moment, PlainItem
from livedeform.fem_node.items.supports import Held
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.mesh.tet_mesh import join
from livedeform.fem_node.physics.record import MaterialSpec, ModulusField, Physics
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.solver import Solver, SolverSettings

Base = Literal["bonded", "sliding"]
_ON = 1e-9  # m
# A quarter of the 50 x 50 x 70 mm cuboid, cells shrinking to 2.7 x 2.7 x 1.4 mm at the rim of its base: 4617 unknowns
GRADED_CELLS, GRADED_GROWTH = (4, 4, 9), (1.0 / 1.6, 1.0 / 1.6, 1.4)


@dataclass(frozen=True)
class Deformed:
    """A solved body: ``space`` and the displacements ``u`` (n, 3) m of its nodes; ``n_iterations`` of Newton."""

    space: Space
    u: Array
    n_iterations: int
    reaction: Array = field(default_factory=lambda: np.zeros(3))  # N, of the moved face

    @property
    def x(self) -> Array:
        """Deformed nodes (n, 3) m."""
        return self.space.nodes + self.u

    def node(self, point: Sequence[float]) -> int:
        """The node that was at ``point`` (3,) m."""
        return int(np.argmin(((self.space.nodes - np.asarray(point)) ** 2).sum(axis=1)))

    def sink(self, point: Sequence[float]) -> float:
        """Return how far (m) the node that was at ``point`` went down."""
        return float(-self.u[self.node(point), 2])

    def nodes_where(self, keep: NDArray[np.bool_], order_by: int) -> NDArray[np.int64]:
        """Nodes of a line, in the order of a coordinate of the undeformed body."""
        nodes = np.flatnonzero(keep)
        return nodes[np.argsort(self.space.nodes[nodes, order_by])]


def on(space: Space, axis: int, value: float) -> NDArray[np.bool_]:
    """Nodes on the plane x[axis] = value."""
    return np.abs(space.nodes[:, axis] - value) < _ON


def quarter_block(
    size: Sequence[float],
    n: Sequence[int],
    *,
    growth: Sequence[float] = (1.0, 1.0, 1.0),
    element: ElementKind = "p2p0",
) -> Space:
    """The quarter x, y >= 0 of an upright block of ``size`` (3,) m on z = 0, in ``n`` cells of the quarter."""
    quarter = (0.5 * size[0], 0.5 * size[1], size[2])
    return make_space(block_mesh(quarter, n, origin=(0.0, 0.0, 0.0), growth=growth), element)


def quarter_holds(space: Space, base: Base) -> list[Item]:
    """Symmetry on x = 0 and y = 0, and the base z = 0 held in all directions or along z only."""
    held = [3 * np.flatnonzero(on(space, axis, 0.0)) + axis for axis in (0, 1)]
    bottom = np.flatnonzero(on(space, 2, 0.0))
    axes = (0, 1, 2) if base == "bonded" else (2,)
    return [Held(np.concatenate(held + [3 * bottom + axis for axis in axes]))]


def quarter_stack(size: Sequence[float], n: Sequence[int]) -> Space:
    """Two quarter blocks of ``size`` on each other, as two bodies that touch at z = size[2]."""
    quarter = (0.5 * size[0], 0.5 * size[1], size[2])
    blocks = [block_mesh(quarter, n, origin=(0.0, 0.0, z)) for z in (0.0, size[2])]
    return make_space(join(*blocks), "p2p0")


class Moved(PlainItem):
    """Nodes moved by ``displacement`` (3,) m, times the moment's load; axes with NaN stay free."""

    def __init__(self, nodes: NDArray[np.int64], displacement: Sequence[float]) -> None:
        full = np.asarray(displacement, float)
        axes = np.flatnonzero(np.isfinite(full))
        self._dofs = (3 * nodes[:, None] + axes).ravel()
        self._full = np.tile(full[axes], len(nodes))
        self._values = self._full

    def prepare(self, moment: Moment) -> None:
        self._values = moment.load * self._full

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        return 0.0

    def constraints(self) -> tuple[NDArray[np.int64], Array]:
        return self._dofs, self._values


def settle(
    space: Space,
    material: MaterialSpec,
    holds: Sequence[Item],
    *,
    gravity: float = 9.81,
    density: float = 1000.0,
    start: Array | None = None,
    moved: NDArray[np.int64] | None = None,
    further: Sequence[Item] = (),
    fields: tuple[ModulusField, ...] = (),
) -> Deformed:
    """Equilibrium from the stress-free shape under gravity along -z; ``moved``: nodes whose reaction is wanted."""
    physics = Physics(material=material, density=density, modulus_fields=fields)
    body = Continuum(space, physics)
    items: list[Item] = [body, Weight(space, density, body.mass_weights), *holds, *further]
    solver = Solver(items, space.n_dof, space.nodes, SolverSettings(tolerance=1e-9))
    x0 = np.zeros(space.n_dof) if start is None else np.concatenate([start.ravel(), np.zeros(space.n_pressure)])
    zero = Moment(time=0.0, dt=np.inf, gravity=np.zeros(3), load=0.0)
    full = Moment(time=0.0, dt=np.inf, gravity=np.array([0.0, 0.0, -gravity]), load=1.0)
    solution = solver.solve(x0, full, zero)
    reaction = np.zeros(3)
    if moved is not None:
        solver.evaluate(solution.x, solver.system, tangent=False)
        reaction = solver.system.r[: 3 * space.n_nodes].reshape(-1, 3)[moved].sum(axis=0)
    return Deformed(space, solution.x[: 3 * space.n_nodes].reshape(-1, 3), solution.n_iterations, reaction)


def cuboid(
    height: float, youngs_modulus: float, base: Base, *, width: float = 0.05, poisson_ratio: float = 0.49,
    model: str = "neo_hookean", density: float = 1000.0, n: int = 4, start: Array | None = None,
    graded: bool = False,
) -> Deformed:  # fmt: skip
    """A cuboid of ``width`` x ``width`` x ``height`` m under its weight (a quarter; ``n`` cells per half side, or
    ``graded`` towards the rim of its base, for about 50 x 50 x 70 mm)."""
    size = (width, width, height)
    if graded:
        space = quarter_block(size, GRADED_CELLS, growth=GRADED_GROWTH)
    else:
        space = quarter_block(size, (n, n, max(2, round(height / (0.5 * width) * n))))
    material = MaterialSpec(model, youngs_modulus, poisson_ratio)
    return settle(space, material, quarter_holds(space, base), density=density, start=start)
