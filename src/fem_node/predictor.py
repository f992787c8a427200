"""Which model answers the node: the full one for every pose, or the live one with a library about expected poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fem_node.earlier import bags_of, pass_earlier
from fem_node.live import LivePredictor
from fem_node.mesh_cache import default_cache_dir
from fem_node.model import PhantomModel
from livedeform_common.experiment import Experiment
from livedeform_common.recording import load_recording


def make_predictor(
    experiment: Experiment, live: bool, expected: str, after: str, start_ns: int, progress: Callable[[str], None]
) -> PhantomModel | LivePredictor:
    """``expected`` is a recording whose poses the library is trained along; empty: it grows as poses come.

    ``after``: the recordings that the body went through before (`fem_node.earlier`). ``start_ns``: the recording's
    start; 0: the first stamp.
    """
    model = PhantomModel.from_experiment(experiment, progress=progress)
    predictor: PhantomModel | LivePredictor = model
    if live:
        predictor = LivePredictor(model, progress=progress)
        if expected:
            predictor.train(load_recording(Path(expected)).poses, default_cache_dir().parent / "live")
    model.reset(start_ns or None)
    pass_earlier(model, bags_of(after), start_ns, progress)
    return predictor


def full_model(predictor: PhantomModel | LivePredictor) -> PhantomModel:
    """The full model behind a predictor."""
    return predictor.model if isinstance(predictor, LivePredictor) else predictor
