"""A stereo pair measures depth worse than width, and says so in its covariances.

f = 1000 px, baseline 100 mm, distance 400 mm, 0.05 px of noise: 0.014 mm sideways, 0.113 mm in depth.
"""

import numpy as np

from livedeform.common.types import CameraCalibration
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.triangulate import triangulate

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])


def camera(name: str, baseline: float) -> CameraCalibration:
    projection = np.column_stack([K, [-1000.0 * baseline, 0.0, 0.0]])
    return CameraCalibration(name, 1280, 720, K, np.zeros(5), np.eye(3), projection)


rig = StereoRig(camera("left", 0.0), camera("right", 0.1))
rng = np.random.default_rng(1)
truth = np.tile([0.05, 0.0, 0.4], (2000, 1))
left, right, _, _ = rig.project(truth)
left, right = (px + rng.normal(0.0, 0.05, px.shape) for px in (left, right))
measured = triangulate(rig, left, right, sigma_px=0.05)

scatter = measured.points.std(axis=0)
stated = np.sqrt(np.diagonal(measured.covariances, axis1=1, axis2=2).mean(axis=0))
print("scatter (mm):", np.round(1e3 * scatter, 4), "stated (mm):", np.round(1e3 * stated, 4))

assert np.allclose(scatter, stated, rtol=0.1)
assert scatter[2] > 7 * scatter[1]
