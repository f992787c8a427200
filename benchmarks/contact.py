"""Contact against exact solutions, and what a press costs.

    python benchmarks/contact.py

Hertz's sphere and Sneddon's flat punch on a quarter of a large block (neo-Hookean, nu 0.49, quadratic tetrahedra with
constant pressure), and a press of 2 mm in steps of 1 mm by a 60 x 15 mm box on a breast phantom of 22 000 unknowns.
"""

from __future__ import annotations

import time

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.common.types import Array
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Shape, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.generate import TetMesh, block_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

E, NU = 4000.0, 0.49
E_STAR = E / (1.0 - NU**2)
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
FACES = 1e-3 * np.array([0.0, 1.25, 2.5, 3.75, 5.0, 7.5, 14.0, 35.0, 120.0])


def quarter_block() -> TetMesh:
    """x, y >= 0 of a block of 240 x 240 x 120 mm with its top at z = 0, fine where it is touched."""
    n = len(FACES) - 1
    unit = block_mesh([n, n, n], n, origin=[0.0, 0.0, 0.0])
    nodes = np.interp(unit.nodes, np.arange(n + 1), FACES)
    nodes[:, 2] = -np.interp(n - unit.nodes[:, 2], np.arange(n + 1), FACES)
    return TetMesh(nodes, unit.tets)


def on(axis: int, value: float):
    """The plane where a coordinate has a value."""
    return lambda points: np.abs(points[:, axis] - value) < 1e-9


def indent(shape: Shape, depth: float) -> tuple[float, Mechanics]:
    """The whole block's force, N."""
    supports = (Support(on(0, 0.0), "sliding"), Support(on(1, 0.0), "sliding"), Support(on(2, -FACES[-1])))
    physics = Physics(MaterialSpec("neo_hookean", E, NU), gravity=np.zeros(3), supports=supports, probe=Probe(shape))
    body = Mechanics(make_space(quarter_block(), "p2p0"), physics)
    body.advance(Moment(0.0, np.inf, np.zeros(3), pose=frames.transform(DOWN, np.array([0.0, 0.0, -depth]))))
    return -4.0 * float(body.wrench()[0][2]), body


def report(name: str, force: float, exact: float, body: Mechanics) -> None:
    penetration = body.contact.penetration(body.x) if body.contact else 0.0
    print(f"{name}: {1e3 * force:.3f} mN, exact {1e3 * exact:.3f} mN ({100 * (force / exact - 1):+.2f} %), "
          f"penetration {1e3 * penetration:.4f} mm")  # fmt: skip


def pressed_phantom() -> None:
    """Newton's work for each millimetre."""
    space = make_space(hemi_ellipsoid_mesh([0.05, 0.05, 0.05], 6), "p2p0")
    physics = Physics(supports=(Support(on(2, 0.0)),), probe=Probe(Box(0.06, 0.015, 0.04, 0.002)))
    body, gravity = Mechanics(space, physics), np.array([0.0, 0.0, -9.81])
    body.advance(Moment(0.0, np.inf, gravity))
    top = float((space.nodes + body.u)[:, 2].max())
    for depth in (-0.001, 0.001, 0.002):
        T: Array = frames.transform(DOWN, np.array([0.0, 0.0, top - depth]))
        began = time.process_time()
        solution = body.advance(Moment(0.0, np.inf, gravity, pose=T))
        print(
            f"phantom, {space.n_dof} unknowns, {1e3 * depth:+.0f} mm: {solution.n_factorisations} factorisations, "
            f"{time.process_time() - began:.1f} s CPU, penetration {1e3 * body.contact.penetration(body.x):.4f} mm"
        )


def main() -> None:
    radius, depth = 0.04, 0.0004
    thickness = 1.0 + 1.133 * np.sqrt(radius * depth) / FACES[-1]  # a bonded layer: Dimitriadis et al. 2002
    force, body = indent(Sphere(radius), depth)
    report("sphere, Hertz", force, 4.0 / 3.0 * E_STAR * np.sqrt(radius) * depth**1.5 * thickness, body)
    radius, depth = 0.005, 0.0002
    force, body = indent(Cylinder(radius, 0.02), depth)
    report("flat punch, Sneddon", force, 2.0 * E_STAR * radius * depth * (1.0 + 1.133 * radius / FACES[-1]), body)
    pressed_phantom()


if __name__ == "__main__":
    main()
