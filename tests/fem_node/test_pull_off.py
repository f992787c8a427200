"""The force by which an adhesive probe pulls before it lets go, against closed forms on a half space."""

import numpy as np
import pytest
from bodies import moment, plane, soft

from livedeform.common.frames import transform
from livedeform.fem_node.contact.contact import ADHESION_OPENING
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.effects.probe_adhesion import WRONG
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import Probe, Support
from livedeform.fem_node.simulator import SETTINGS

E, NU = 4000.0, 0.49
BALL, CYLINDER, EDGE = 0.020, 0.010, 0.001  # m, their radii, and that of the cylinder's edge
SHAPES = {
    "ball": (make_shape("sphere", (BALL,), 0.0), 2.0),  # pressed by so many mm first
    "cylinder": (make_shape("cylinder", (CYLINDER, 0.04), EDGE), 0.5),
}


def pull(name: str, strength: float) -> float:
    """Return the largest force (N) of a probe that presses a block of 60 x 60 x 40 mm, with elements of 10 mm, and
    rises in steps of 0.1 mm."""
    shape, deep = SHAPES[name]
    physics = soft(NU, E, supports=(Support(plane(2, 0.0)),), probe=Probe(shape, adhesion=strength))
    space = make_space(block_mesh((0.06, 0.06, 0.04), (6, 6, 4)), "p2p0")
    body, g = Mechanics(space, physics, settings=SETTINGS), np.array([0.0, 0.0, -9.81])
    body.advance(moment(g))
    top, most = float((space.nodes + body.u)[:, 2].max()), 0.0
    for k, depth in enumerate([*np.arange(-0.5, deep + 1e-9, 0.5), *np.arange(deep - 0.1, -6.0, -0.1)]):
        pose = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0007, 0.0011, top - 1e-3 * depth]))
        body.advance(moment(g, time=1.0 + k, pose=pose))
        most = max(most, float(body.wrench()[0][2]))
        if depth < 0.0 and k > 10 and not body.contact.state.attached.any():
            break
    return most


def theory(name: str, strength: float) -> float:
    """Return the force (N) that the work of separation asks for: of a ball by Johnson, Kendall & Roberts (1971), of a
    flat cylinder by Kendall (1971)."""
    work = strength * ADHESION_OPENING
    if name == "ball":
        return float(1.5 * np.pi * work * BALL)
    flat = CYLINDER - 0.5 * EDGE
    return float(np.sqrt(8.0 * np.pi * E / (1.0 - NU**2) * work * flat**3))


@pytest.mark.parametrize(
    ("name", "strength"),
    [
        ("ball", 500.0),
        pytest.param("ball", 1500.0, marks=pytest.mark.slow),
        pytest.param("ball", 4000.0, marks=pytest.mark.slow),
        *(pytest.param("cylinder", strength, marks=pytest.mark.slow) for strength in (500.0, 4000.0)),
    ],
)
def test_a_probe_pulls_by_what_its_work_of_separation_asks_for(name, strength):
    """Measured 0.88, 1.17, 0.87, 0.80 and 1.10 times as much: asked is two times what the effect allows for."""
    found = pull(name, strength) / theory(name, strength)
    print(name, strength, found)
    assert abs(found - 1.0) < 2.0 * WRONG
