"""The last runs of a model, kept: fits of one candidate from one start, what a fit ends with and what is screened after
it ask for the same."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, ForwardModel, Run
from livedeform.common.types import EffectValues

LARGEST = 2**28  # bytes of all that is kept, but that the last answer is kept in any case


@dataclass(frozen=True)
class _Answer:
    """The ``runs`` of all recordings, whose derivatives are for ``columns``."""

    columns: tuple[Hashable, ...]
    runs: list[Run]

    @property
    def nbytes(self) -> int:
        """Return its size in bytes."""
        return sum(a.nbytes for r in self.runs for a in (r.points, r.forces, r.d_points, r.d_forces) if a is not None)

    @property
    def whole(self) -> bool:
        """Tell whether nothing was lost: what was may be found from what is known later."""
        return all(run.whole and not run.aside for run in self.runs)

    def of(self, wanted: Sequence[Hashable]) -> list[Run]:
        """Return the runs with the ``wanted`` columns alone, which are among its own."""
        if tuple(wanted) == self.columns:
            return self.runs
        place = {key: i for i, key in enumerate(self.columns)}
        pick = [place[key] for key in wanted]
        return [_with_columns(run, pick) for run in self.runs]


class Remembered:
    """A `ForwardModel` that remembers its last answers, for any thread that asks."""

    def __init__(self, forward: ForwardModel) -> None:
        self._forward = forward
        self.processes = forward.processes
        self._answers: dict[Hashable, _Answer] = {}  # what was asked last is last
        self._lock = threading.Lock()

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        """See `ForwardModel`."""
        question = tuple(_of_effect(e) for e in effects), tuple(_of_recording(o) for o in observations)
        wanted = tuple(_of_column(c) for c in columns)
        known = self._known(question, wanted)
        if known is None:
            known = _Answer(wanted, self._forward.run(effects, observations, columns))
            self._keep(question, known)
        return known.of(wanted)

    def _known(self, question: Hashable, wanted: Sequence[Hashable]) -> _Answer | None:
        """Return an answer that has the ``wanted`` columns."""
        with self._lock:
            known = self._answers.get(question)
            if known is None or not set(wanted) <= set(known.columns):
                return None
            self._answers[question] = self._answers.pop(question)
            return known

    def _keep(self, question: Hashable, answer: _Answer) -> None:
        if not answer.whole:
            return
        with self._lock:
            self._answers.pop(question, None)
            self._answers[question] = answer
            while len(self._answers) > 1 and sum(a.nbytes for a in self._answers.values()) > LARGEST:
                del self._answers[next(iter(self._answers))]


def _of_effect(effect: EffectValues) -> Hashable:
    return effect.name, tuple((name, value.shape, value.tobytes()) for name, value in sorted(effect.values.items()))


def _of_recording(o: Observation) -> Hashable:
    """Return what tells a recording, or a part of it, from the others of one diagnosis."""
    before = None if o.before is None else _of_recording(o.before)
    ends = tuple((p.stamp_ns, *p.position, *p.orientation_xyzw) for p in (*o.path[:1], *o.path[-1:]))
    return o.name, o.start_ns, o.stamps_ns.tobytes(), len(o.path), ends, o.forces is None, o.patience, before


def _of_column(column: Column) -> Hashable:
    form = column.candidate.form
    return column.candidate.name, "" if form is None else form.name, column.z, column.coordinate


def _with_columns(run: Run, pick: list[int]) -> Run:
    d_forces = None if run.d_forces is None else run.d_forces[..., pick]
    return replace(run, d_points=run.d_points[..., pick], d_forces=d_forces, rough=run.rough and bool(pick))
