"""Cameras of a stereo pair: projection, its inverse, and the rig's geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livedeform.common.errors import CalibrationError
from livedeform.common.frames import apply, transform
from livedeform.common.types import Array, CameraCalibration
from livedeform.stereo_node.camera.calibration_file import checked
from livedeform.stereo_node.camera.lens import lens_of, to_pixels, to_rays

__all__ = ["StereoRig", "make_rig", "project", "undistort"]

MAX_BASELINE = 10.0  # m; a longer one is a calibration in millimetres
MIN_BASELINE = 1e-3  # m


def project(camera: CameraCalibration, points: Array) -> tuple[Array, Array]:
    """Project points (n, 3) m in the camera's optical frame: raw (distorted) pixels (n, 2) and their derivative (n, 2,
    3).

    Points behind the camera give NaN.
    """
    pixels, J = to_pixels(*lens_of(camera), np.ascontiguousarray(points, float))
    return pixels, J


def undistort(camera: CameraCalibration, pixels: Array) -> tuple[Array, Array]:
    """Undistort raw pixels (n, 2): ideal image points (n, 2) at depth 1 and the derivative (n, 2, 2).

    A pixel that the lens model cannot produce gives NaN.
    """
    rays, J = to_rays(*lens_of(camera), np.ascontiguousarray(pixels, float))
    return rays, J


@dataclass(frozen=True)
class StereoRig:
    """Two calibrated cameras; points are in the left camera's optical frame, metres.

    The right camera's place follows from rectification and projection matrices: X_right = R_r^T (R_l X_left + (t_x,
    0, 0)) with t_x = projection_right[0, 3] / projection_right[0, 0] = -baseline (ROS CameraInfo).
    """

    left: CameraCalibration
    right: CameraCalibration

    def __post_init__(self) -> None:
        for camera in (self.left, self.right):
            checked(camera)
        both = f"{self.left.name} / {self.right.name}"
        if (self.left.width, self.left.height) != (self.right.width, self.right.height):
            raise CalibrationError(
                f"left is {self.left.width}x{self.left.height}, right is {self.right.width}x{self.right.height}",
                where=both,
                remedy="calibrate the pair at one picture size",
            )
        if self.baseline <= MIN_BASELINE:
            swapped = self.left.projection[0, 3] < 0 or self.baseline < -MIN_BASELINE
            raise CalibrationError(
                f"the baseline is {self.baseline * 1e3:.3f} mm",
                where=both,
                remedy="exchange left and right" if swapped else "use the files of a stereo (not a single) calibration",
            )
        if self.baseline > MAX_BASELINE:
            raise CalibrationError(
                f"the baseline is {self.baseline:.1f} m",
                where=both,
                remedy="the square's size was given in millimetres: calibrate again with it in metres",
            )

    @property
    def baseline(self) -> float:
        """Distance of the right camera to the right of the left one, m."""
        left, right = self.left.projection, self.right.projection
        return float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])

    @cached_property
    def T_right_left(self) -> Array:
        """(4, 4): left optical frame to right optical frame (both unrectified)."""
        R = self.right.rectification.T @ self.left.rectification
        return transform(R, self.right.rectification.T @ np.array([-self.baseline, 0.0, 0.0]))

    @cached_property
    def essential(self) -> Array:
        """(3, 3): x_right^T E x_left = 0 for ideal image points."""
        R, t = self.T_right_left[:3, :3], self.T_right_left[:3, 3]
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        return cross @ R

    def project(self, points: Array) -> tuple[Array, Array, Array, Array]:
        """Project points (n, 3) m in the left frame: left pixels (n, 2), right pixels, and derivatives (n, 2, 3) of
        both."""
        left, J_left = project(self.left, points)
        right, J_right = project(self.right, apply(self.T_right_left, points))
        return left, right, J_left, J_right @ self.T_right_left[:3, :3]


def make_rig(
    left: tuple[str, int, int, Array, Array, str],
    right: tuple[str, int, int, Array, Array, str],
    T_right_left: Array,
) -> StereoRig:
    """Make a rig of two cameras (name, width, height, camera_matrix, dist_coeffs, distortion_model) and T_right_left
    (4, 4).

    The rectifying rotations share the turn between the cameras equally and put x along the baseline (Fusiello 2000; the
    same construction as Bouguet's toolbox).
    """
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    centre = -R.T @ t  # right camera in the left frame
    if not np.linalg.norm(centre) > 0:
        raise CalibrationError(
            "the baseline is zero", where=f"{left[0]} / {right[0]}", remedy="use pictures of two cameras"
        )
    x = centre / np.linalg.norm(centre)
    z = R[2] + np.array([0.0, 0.0, 1.0])  # mean viewing direction
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    rectify_left = np.stack([x, y, np.cross(x, y)])
    rectify_right = rectify_left @ R.T
    f = float(np.mean([left[3][0, 0], left[3][1, 1], right[3][0, 0], right[3][1, 1]]))
    projection = np.array([[f, 0, left[1] / 2, 0], [0, f, left[2] / 2, 0], [0, 0, 1.0, 0]])
    projection_right = projection.copy()
    projection_right[0, 3] = -f * float(np.linalg.norm(centre))

    def build(c: tuple[str, int, int, Array, Array, str], rectification: Array, P: Array) -> CameraCalibration:
        return CameraCalibration(c[0], c[1], c[2], c[3], np.asarray(c[4], float).ravel(), rectification, P, c[5])

    return StereoRig(build(left, rectify_left, projection), build(right, rectify_right, projection_right))
