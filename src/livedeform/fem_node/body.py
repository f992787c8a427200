"""A body for notebooks: say what it is, how it is held and loaded, and solve.

>>> body = Body(block_mesh((0.05, 0.05, 0.07), 6), youngs_modulus=2896.0).held(lambda X: X[:, 2] < 1e-6)
>>> body.solve().displacement  # (n, 3) m under its weight
>>> model = body.pressed_by(Box(0.06, 0.015, 0.04, 0.002)).model(markers)
>>> model.predict(pose).force
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.contact.probe_shapes import Shape
from livedeform.fem_node.element.element import ElementKind, make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import DEFAULT_ELEMENT, PhantomModel
from livedeform.fem_node.output import fields, write_step
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import (
    DeadLoad,
    Interface,
    MaterialSpec,
    Physics,
    Probe,
    RegionTest,
    Support,
    SupportType,
)


@dataclass(frozen=True)
class Solved:
    """An equilibrium: ``nodes`` and ``displacement`` (n, 3) m; ``fields()`` has stress and strain, ``write`` makes a
    file."""

    mechanics: Mechanics
    n_iterations: int

    @property
    def nodes(self) -> Array:
        """Reference places."""
        return self.mechanics.space.nodes

    @property
    def displacement(self) -> Array:
        """From the reference places."""
        return self.mechanics.u.copy()

    def fields(self) -> dict[str, Array]:
        """Nodal fields as in `fem_node.output`."""
        return fields(self.mechanics)

    def write(self, path: Path | str) -> None:
        """A VTU file of this step."""
        write_step(path, self.mechanics)


@dataclass(frozen=True)
class Body:
    """A mesh with a material; every method returns a changed copy. ``extra``: the model's own constants."""

    mesh: TetMesh
    material: str = "neo_hookean"
    youngs_modulus: float = 4000.0
    poisson_ratio: float = 0.49
    density: float = 1000.0
    gravity: Sequence[float] = (0.0, 0.0, -9.81)
    extra: dict[str, Any] = field(default_factory=dict)
    element: ElementKind = DEFAULT_ELEMENT
    supports: tuple[Support, ...] = ()
    loads: tuple[DeadLoad, ...] = ()
    interfaces: tuple[Interface, ...] = ()
    probe: Probe | None = None

    def held(self, region: RegionTest, how: SupportType = "fixed", **options: float) -> Body:
        """Held where ``region`` (points (n, 3) -> (n,) bool) says: fixed, sliding, spring (stiffness), friction
        (mu)."""
        return replace(self, supports=(*self.supports, Support(region, how, **options)))

    def loaded(self, region: RegionTest, force: Sequence[float], name: str = "load") -> Body:
        """With a dead load of ``force`` N in all on the region's surface."""
        return replace(self, loads=(*self.loads, DeadLoad(name, region, np.array(force, float))))

    def touching(self, region: RegionTest, **how: Any) -> Body:
        """With an interface where two parts of the mesh touch (``friction``, ``bonded``, ``reach``; meshes are put
        together by `tet_mesh.join`)."""
        return replace(self, interfaces=(*self.interfaces, Interface(region, **how)))

    def pressed_by(self, shape: Shape, **contact: Any) -> Body:
        """With a rigid probe (``friction``, ``formulation``, ...)."""
        return replace(self, probe=Probe(shape, **contact))

    @property
    def physics(self) -> Physics:
        """All of it as the solver takes it."""
        spec = MaterialSpec(self.material, self.youngs_modulus, self.poisson_ratio, self.extra)
        return Physics(
            material=spec,
            density=self.density,
            gravity=np.array(self.gravity, float),
            supports=self.supports,
            loads=self.loads,
            interfaces=self.interfaces,
            probe=self.probe,
        )

    def solve(self) -> Solved:
        """The relaxed equilibrium under weight and loads, without the probe; `ConvergenceError` if there is none."""
        mechanics = Mechanics(make_space(self.mesh, self.element), replace(self.physics, probe=None))
        solution = mechanics.advance(Moment(0.0, np.inf, self.physics.gravity))
        return Solved(mechanics, solution.n_iterations)

    def model(self, markers: Array | None = None, lesions: Array | None = None) -> PhantomModel:
        """A model that predicts markers (n, 3) m and lesions (l, 3) m for probe poses."""
        return PhantomModel(make_space(self.mesh, self.element), self.physics, markers=markers, lesions=lesions)
