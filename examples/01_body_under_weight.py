"""A gelatin cuboid sinks under its own weight: mesh, material, support, equilibrium, without any files.

The thesis's column formula gives 8.3 mm; independent FEM codes agree on 6.845 +- 0.010 mm for the bonded body.
"""

import numpy as np

from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support

mesh = block_mesh((0.05, 0.05, 0.07), (4, 4, 6))
physics = Physics(
    material=MaterialSpec("neo_hookean", youngs_modulus=2896.0, poisson_ratio=0.49),
    density=1000.0,
    gravity=np.array([0.0, 0.0, -9.81]),
    supports=(Support(lambda points: points[:, 2] < 1e-6, "fixed"),),
)
top = np.array([[0.0, 0.0, 0.07]])
model = PhantomModel(make_space(mesh), physics, markers=top)

rest = model.rest()
sunk = 0.07 - rest.markers[0, 2]
column = 1000.0 * 9.81 * 0.07**2 / (2 * 2896.0)
print(f"top sinks {1e3 * sunk:.2f} mm in {rest.n_iterations} Newton iterations")
print(f"the column formula says {1e3 * column:.2f} mm")

assert rest.converged
assert abs(sunk - 0.006845) < 0.0001  # 6.84 mm measured on this coarse mesh
assert column > 1.2 * sunk
