"""Choose the model that answers the node: the full one for every pose, or the live one with a library about expected
poses; and how it works on what is asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Prediction
from livedeform.fem_node.live.latest_only import AnswerOrLearn, InTurn, LatestOnly
from livedeform.fem_node.live.live_model import LivePredictor
from livedeform.fem_node.live.triggers import Moment
from livedeform.fem_node.mesh.cache import default_cache_dir
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.load_history import bags_of, pass_earlier


def make_predictor(
    experiment: Experiment, live: bool, expected: str, after: str, start_ns: int, progress: Callable[[str], None]
) -> PhantomModel | LivePredictor:
    """Make the predictor; ``expected`` is a recording whose poses the library is trained along; empty: it grows as
    poses come.

    ``after``: the recordings that the body went through before (`fem_node.path.load_history`). ``start_ns``: the
    recording's start; 0: the first stamp.
    """
    model = PhantomModel.from_experiment(experiment, progress=progress)
    predictor: PhantomModel | LivePredictor = model
    if live:
        predictor = LivePredictor(model, progress=progress)
        if expected:
            predictor.train(load_recording(Path(expected)).poses, default_cache_dir().parent / "live")
            predictor.warm_up()
    model.reset(start_ns or None)
    pass_earlier(model, bags_of(after), start_ns, progress)
    return predictor


Worker = InTurn[Moment, Prediction] | LatestOnly[Moment, Prediction] | AnswerOrLearn[Moment, Prediction]


def make_worker(predictor: PhantomModel | LivePredictor, newest_only: bool, wake: Callable[[], None]) -> Worker:
    """Make what works on the requested moments: each in its turn, or, with ``newest_only``, as many as can be had.

    A live predictor answers in one thread and learns in another; a model that has to solve every pose works on the
    newest. ``wake`` is called from these threads when a prediction is there.
    """
    if not newest_only:
        return InTurn(lambda moment: predictor.predict(*moment))
    if isinstance(predictor, PhantomModel) or predictor.why_not:
        return LatestOnly(lambda moment: predictor.predict(*moment), wake)
    live = predictor
    return AnswerOrLearn(
        answer=lambda moment: live.answer(*moment),
        learn=lambda moment: live.learn(*moment),
        is_known=lambda moment: live.knows(moment[0]),
        wake=wake,
    )


def full_model(predictor: PhantomModel | LivePredictor) -> PhantomModel:
    """Return the full model behind a predictor."""
    return predictor.model if isinstance(predictor, LivePredictor) else predictor
