"""The loop's simulator takes key moments as they come, without the checks of a jump: are its moments those of the model
that makes them?"""

import numpy as np
import pytest

from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Box, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.walk import WalkSettings
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support
from livedeform.fem_node.simulator import Recorded, Simulator

MESH = hemi_ellipsoid_mesh((0.05, 0.05, 0.04), 5)
# depth and place beside the top, mm: presses and lifts as key moments have them, with jumps along the surface
MOMENTS = [(-1, 0), (3, 0), (7, 0), (2, 0), (6, 3), (8, 3), (-1, 3), (8, -4), (4, -4), (9, 2)]


@pytest.mark.slow
@pytest.mark.parametrize("shape", [Sphere(0.012), Box(0.04, 0.015, 0.03, 0.002)], ids=["ball", "box"])
def test_its_moments_are_those_of_the_model_that_verifies_jumps(shape):
    """Within 1 % of the force and 0.05 mm."""
    physics = Physics(
        MaterialSpec("neo_hookean", 4000.0, 0.49),
        supports=(Support(lambda X: X[:, 2] < 1e-6),),
        probe=Probe(shape),
    )
    poses = [
        Pose(k * 500_000_000, np.array([1e-3 * x, 0.001, 0.04 - 1e-3 * depth]), np.array([1.0, 0.0, 0.0, 0.0]))
        for k, (depth, x) in enumerate(MOMENTS)
    ]
    stamps = [pose.stamp_ns for pose in poses]
    tops = np.array([[1e-3 * x, 0.0, 0.03] for x in (-25, -15, 0, 15, 25)])
    simulator = Simulator(MESH, "p2p0", tops, np.zeros(len(tops), bool))
    quick = simulator.simulate(physics, Recorded("keys", stamps, 0, poses), [], WalkSettings()).predictions
    model = PhantomModel(make_space(MESH), physics)
    for pose, answer in zip(poses, quick, strict=True):
        model.reset()
        expected = model.predict(pose)
        if not (answer.converged and expected.converged):
            continue  # left out of a fit, or not unique
        assert np.linalg.norm(answer.force - expected.force) <= 0.01 * max(np.linalg.norm(expected.force), 0.005)
        assert np.linalg.norm(answer.surface - expected.surface, axis=1).max() <= 5e-5
