"""The cameras of an experiment or a recording: which rig, and where it stands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livedeform.common.experiment.schema import Experiment
from livedeform.common.types import CameraCalibration, Pose
from livedeform.stereo_node.camera.calibration_file import read_camera
from livedeform.stereo_node.camera.rig import StereoRig

__all__ = ["declared_camera_pose", "rig_of"]

NO_CAMERAS: Mapping[str, CameraCalibration] = {}


def rig_of(experiment: Experiment, recorded: Mapping[str, CameraCalibration] = NO_CAMERAS) -> StereoRig | None:
    """Return the rig of the experiment's calibration files, or of the calibrations ``recorded`` as "left" and "right".

    None where neither says how the cameras see; ``CalibrationError`` for a calibration that cannot be right.
    """
    stereo = experiment.stereo
    if stereo is not None and stereo.left is not None and stereo.right is not None:
        return StereoRig(read_camera(stereo.left), read_camera(stereo.right))
    if {"left", "right"} <= set(recorded):
        return StereoRig(recorded["left"], recorded["right"])
    return None


def declared_camera_pose(experiment: Experiment) -> Pose | None:
    """Return T_phantom_left where the experiment gives it in numbers; None where it is registered to the markers."""
    stereo = experiment.stereo
    if stereo is None or isinstance(stereo.pose, str):
        return None
    return Pose(0, np.array(stereo.pose.position, float), np.array(stereo.pose.orientation_xyzw, float))
