"""Compiles what would be compiled at its first use; the Makefile does it once, after the installation.

A pair of pictures and two poses of the shipped phantom go through markers, contact (also with friction) and model.
The kernels are kept beside the sources, or in the user's cache where those cannot be written.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import EffectValues
from livedeform.fem_node.model import PhantomModel
from livedeform.shipped import BREAST, shipped
from livedeform.stereo_node.pipeline import StereoTracker

EFFECTS = (
    EffectValues("strain_stiffening", {"b": np.array(1.0)}),
    EffectValues("viscoelasticity", {"g": np.array([0.2]), "tau": np.array([1.0])}),
    EffectValues("skin", {"thickness": np.array(0.004), "ratio": np.array(2.0)}),
)
RUBS = EffectValues("probe_friction", {"mu": np.array(0.3)})
PRESSED = 0.3  # of the way to the deepest pose: the probe touches, which is all that a kernel needs


def compile_kernels() -> None:
    """Runs each kernel of tracking and prediction once."""
    folder = shipped(BREAST)
    experiment = load_experiment(folder / "experiment")
    recording = load_recording(folder / "bags" / "a", experiment)
    first = recording.poses[0]
    away = np.array([np.linalg.norm(pose.position - first.position) for pose in recording.poses])
    pressed = recording.poses[int(np.argmax(away > PRESSED * away.max()))]
    for effects in ((), EFFECTS, (RUBS,)):
        model = PhantomModel.from_experiment(experiment, effects=effects)
        rest = model.predict(first).markers
        model.predict(pressed)
    tracker = StereoTracker.from_experiment(experiment, None, rest)
    tracker.process(next(recording.left), next(recording.right))
