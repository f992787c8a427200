"""Effects change the record that the solver is built from, and nothing else: a body that is softer below."""

import numpy as np

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support

space = make_space(block_mesh((0.05, 0.05, 0.05), 3))
declared = Physics(
    material=MaterialSpec("neo_hookean", 3000.0, 0.49), supports=(Support(lambda points: points[:, 2] < 1e-6),)
)
points = np.array([[0.0, 0.0, 0.05], [0.025, 0.0, 0.025]])


def sunk(physics: Physics) -> np.ndarray:
    return points[:, 2] - PhantomModel(space, physics, markers=points).rest().markers[:, 2]


plain = sunk(declared)
stiffer = apply_effects(declared, [EffectValues("stiffness", {"ratio": np.array(1.25)})])
graded = apply_effects(declared, [EffectValues("stiffness_gradient", {"slope": np.array(20.0)})])
print(
    "declared",
    np.round(1e3 * plain, 3),
    "stiffer",
    np.round(1e3 * sunk(stiffer), 3),
    "graded",
    np.round(1e3 * sunk(graded), 3),
)

assert declared.material.youngs_modulus == 3000.0  # the record itself is frozen
assert np.allclose(sunk(stiffer), plain / 1.25, rtol=0.1)  # nearly: the strain is finite
assert sunk(graded)[0] > plain[0]  # soft below, where the weight is: it sinks more
