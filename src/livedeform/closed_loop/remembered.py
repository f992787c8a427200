"""The last runs of a model, kept: fits of one candidate from one start, what a fit ends with and what is screened after
it ask for the same."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, ForwardModel, Run
from livedeform.common.types import EffectValues

MOST_RUNS = 16  # two of each start of the leaders, and what a fit ends with
LARGEST = 2**27  # bytes of derivatives beyond which a run is not kept


@dataclass(frozen=True)
class _Answer:
    """The ``runs`` of all recordings, whose derivatives are for ``columns``."""

    columns: tuple[Hashable, ...]
    runs: list[Run]

    def of(self, wanted: Sequence[Hashable]) -> list[Run]:
        """Return the runs with the ``wanted`` columns alone, which are among its own."""
        if tuple(wanted) == self.columns:
            return self.runs
        place = {key: i for i, key in enumerate(self.columns)}
        pick = [place[key] for key in wanted]
        return [_with_columns(run, pick) for run in self.runs]


class Remembered:
    """A `ForwardModel` that remembers its last answers."""

    def __init__(self, forward: ForwardModel) -> None:
        self._forward = forward
        self.processes = forward.processes
        self._answers: dict[Hashable, _Answer] = {}  # the newest last

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """See `ForwardModel`."""
        question = tuple(_of_effect(e) for e in effects), tuple(_of_recording(o) for o in observations)
        wanted = tuple(_of_column(c) for c in columns)
        known = self._answers.get(question)
        if known is not None and set(wanted) <= set(known.columns):
            return known.of(wanted)
        answer = _Answer(wanted, self._forward.run(effects, observations, columns))
        self._keep(question, answer)
        return answer.runs

    def _keep(self, question: Hashable, answer: _Answer) -> None:
        if sum(run.d_points.nbytes for run in answer.runs) > LARGEST:
            return
        self._answers.pop(question, None)
        self._answers[question] = answer
        for old in list(self._answers)[:-MOST_RUNS]:
            self._answers.pop(old, None)


def _of_effect(effect: EffectValues) -> Hashable:
    return effect.name, tuple((name, value.shape, value.tobytes()) for name, value in sorted(effect.values.items()))


def _of_recording(o: Observation) -> Hashable:
    """Return what tells a recording, or a part of it, from the others of one diagnosis."""
    return o.name, o.start_ns, o.stamps_ns.tobytes(), len(o.path), o.before is None, o.patience


def _of_column(column: Column) -> Hashable:
    form = column.candidate.form
    return column.candidate.name, "" if form is None else form.name, column.z, column.coordinate


def _with_columns(run: Run, pick: list[int]) -> Run:
    d_forces = None if run.d_forces is None else run.d_forces[..., pick]
    return replace(run, d_points=run.d_points[..., pick], d_forces=d_forces)
