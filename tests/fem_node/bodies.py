"""Small bodies for the tests of the solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support
from livedeform.fem_node.solve.solver import SolverSettings

EXACT = SolverSettings(tolerance=1e-12)
NO_GRAVITY = np.zeros(3)


@dataclass(frozen=True)
class plane:
    """The region of points with x[axis] = value; by what it is, as an experiment's regions are, solutions are kept."""

    axis: int
    value: float
    tolerance: float = 1e-6

    def __call__(self, X):
        return np.abs(X[:, self.axis] - self.value) < self.tolerance


def symmetry(*axes):
    """Held along the normal on the planes x[axis] = 0."""
    return tuple(Support(plane(axis, 0.0), "sliding") for axis in axes)


def block_space(size=(0.02, 0.02, 0.02), n=2, kind="p2p0"):
    """A block with one corner at the origin."""
    return make_space(block_mesh(size, n, origin=(0.0, 0.0, 0.0)), kind)


def moment(gravity=NO_GRAVITY, *, dt=np.inf, time=0.0, load=1.0, pose=None, still=True, acting=np.inf):
    return Moment(time, dt, np.asarray(gravity, float), load, pose, still, acting)


def soft(nu=0.49, E=3000.0, **changes):
    """Physics with a neo-Hookean body of 3 kPa."""
    return Physics(material=MaterialSpec("neo_hookean", E, nu), **changes)


def solve(space, physics, gravity=NO_GRAVITY, **options):
    """The relaxed equilibrium as a `Mechanics`."""
    mechanics = Mechanics(space, physics, settings=EXACT)
    mechanics.advance(moment(gravity, **options))
    return mechanics
