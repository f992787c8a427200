"""Propagate the calibration's own uncertainty to the markers: an error that all pictures share, and that no averaging
lessens.

It is not in the points' covariances, which are of the pixels' noise. ``livedeform calibrate`` writes the covariance of
lens and rig parameters into ``calibration.json`` beside the cameras' files.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.types import Array
from livedeform.stereo_node.calibrate.bundle import FREE, Bundle, Lens
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.triangulate import triangulate

FILE_NAME = "calibration.json"
STEP = 0.1  # sigmas, of numerical derivatives
LEAST = 1e-12  # of the largest: principal variances
AGREES = 1e-4  # relative: the JSON's focal lengths are those of the cameras' files


@dataclass(frozen=True)
class CalibrationUncertainty:
    """One-sigma displacement of markers by the calibration's uncertainty, root mean square over them, m: as measured in
    the left camera's frame, and what a registration of the cameras to the markers leaves of it; and of lengths,
    relative."""

    in_left_frame: float
    registered: float
    of_lengths: float


def read_bundle(left_file: Path, rig: StereoRig) -> Bundle | None:
    """Return the calibration whose ``calibration.json`` lies beside the left camera's file; None where there is none,
    or where it is another calibration's."""
    path = Path(left_file).parent / FILE_NAME
    try:
        document = json.loads(path.read_text())
        values = {name: float(entry["value"]) for name, entry in document["parameters"].items()}
        covariance = np.array(document["rig_covariance"]["matrix"], float)
        model = str(document["distortion_model"])
        names = list(document["rig_covariance"]["names"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if model not in FREE or covariance.shape != (len(names), len(names)):
        return None
    empty = Lens(np.ones(4), np.zeros(8))
    bundle = Bundle(model, empty, empty, np.zeros(6), np.zeros((0, 6)), covariance, 0.0, (), np.zeros((0, 3)))
    if list(bundle.names) != names or any(name not in values for name in names):
        return None
    bundle = bundle.with_values(np.array([values[name] for name in names]))
    focal = bundle.left.intrinsics[0], bundle.right.intrinsics[0], float(np.linalg.norm(bundle.rig_pose[3:]))
    used = rig.left.camera_matrix[0, 0], rig.right.camera_matrix[0, 0], rig.baseline
    return bundle if np.allclose(focal, used, rtol=AGREES) else None


def calibration_uncertainty(bundle: Bundle, rig: StereoRig, points: Array) -> CalibrationUncertainty:
    """Compute what the calibration's uncertainty does to markers at ``points`` (n, 3) m in the left frame."""
    left, right, _, _ = rig.project(points)
    J = parameter_sensitivity(bundle, (rig.left.width, rig.left.height), left, right)
    middle = points.mean(axis=0)
    arms = points - middle
    rigid = np.zeros((len(points), 3, 6))
    for k, axis in enumerate(np.eye(3)):
        rigid[:, :, k] = np.cross(axis, arms)
        rigid[:, k, 3 + k] = 1.0
    A, flat = rigid.reshape(-1, 6), J.reshape(-1, J.shape[2])
    rest = flat - A @ np.linalg.lstsq(A, flat, rcond=None)[0]
    # lengths: the part of the displacement that goes with the distance from the middle
    stretch = arms.ravel() @ rest / (arms**2).sum()

    def rms(D: Array) -> float:
        return float(np.sqrt(np.einsum("np,pq,nq->", D, bundle.covariance, D) / len(points)))

    return CalibrationUncertainty(rms(flat), rms(rest), float(np.sqrt(stretch @ bundle.covariance @ stretch)))


def parameter_sensitivity(bundle: Bundle, size: tuple[int, int], left: Array, right: Array) -> Array:
    """Return (n, 3, p): derivative of the points triangulated from ``left``, ``right`` (n, 2) px with respect to the
    lens and rig parameters, in the board's gauge-free left frame.

    By central differences along the principal axes of their covariance: a coefficient alone, moved by its own sigma
    without those that go with it, may be a lens that gives no points at all.
    """
    sigma = principal_axes(bundle.covariance)
    ends = np.empty((len(left), 3, len(sigma)))
    for k, axis in enumerate(sigma.T):
        moved = [
            triangulate(bundle.with_values(bundle.values + sign * STEP * axis).rig(size), left, right).points
            for sign in (1, -1)
        ]
        ends[:, :, k] = (moved[0] - moved[1]) / (2 * STEP)
    scale = np.sqrt(np.diag(bundle.covariance))
    per_axis = np.linalg.solve((sigma / scale[:, None]).T, ends.reshape(-1, len(sigma)).T)
    out: Array = np.asarray(per_axis, float).T.reshape(ends.shape) / scale
    return out


def principal_axes(covariance: Array) -> Array:
    """Return (p, p): the principal axes of a ``covariance`` (p, p) as columns, each one sigma long."""
    scale = np.sqrt(np.diag(covariance))
    value, axes = np.linalg.eigh(covariance / scale[:, None] / scale)
    out: Array = scale[:, None] * axes * np.sqrt(np.maximum(value, LEAST * value.max()))
    return out
