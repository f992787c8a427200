"""A body in a few words: what it is, how it is held and loaded, and its solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import DEFAULT_ELEMENT
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import DeadLoad, Interface, MaterialSpec, Physics, RegionTest, Support


@dataclass(frozen=True)
class Body:
    """A mesh with a material; every method returns a changed copy."""

    mesh: TetMesh
    physics: Physics

    @classmethod
    def of(cls, mesh: TetMesh, youngs_modulus: float = 4000.0) -> Body:
        """Make a body that nothing holds yet."""
        return cls(mesh, Physics(material=MaterialSpec(youngs_modulus=youngs_modulus)))

    def held(self, region: RegionTest) -> Body:
        """Hold it where ``region`` (points (n, 3) -> (n,) bool) says."""
        supports = (*self.physics.supports, Support(region))
        return replace(self, physics=replace(self.physics, supports=supports))

    def loaded(self, region: RegionTest, force: Sequence[float], name: str) -> Body:
        """Add a dead load of ``force`` N in all on the region's surface."""
        load = DeadLoad(name, region, np.array(force, float))
        return replace(self, physics=replace(self.physics, loads=(*self.physics.loads, load)))

    def touching(self, region: RegionTest, **how: Any) -> Body:
        """Add an interface where two parts of the mesh touch."""
        return replace(self, physics=replace(self.physics, interfaces=(Interface(region, **how),)))

    def solve(self) -> Mechanics:
        """Solve the relaxed equilibrium under weight and loads."""
        mechanics = Mechanics(make_space(self.mesh, DEFAULT_ELEMENT), self.physics)
        mechanics.advance(Moment(0.0, np.inf, self.physics.gravity))
        return mechanics
